"""Modules, style, text and data as one page that needs no other file and may load none.

The modules are plain ES modules in `page/`. A page is opened from disk, where modules cannot import each other, so they
stand one after the other in a single script: imports and the word `export` are taken out, and nothing else.
"""

import html
import re
from collections.abc import Mapping, Sequence
from importlib import resources
from types import MappingProxyType
from typing import Any

from gacrl.report.safe import digest, embedded
from gacrl.report.theme import theme

_IMPORT = re.compile(r'^import \{[^}]*\} from "\./([\w-]+\.js)";\n', re.MULTILINE)
_EXPORT = re.compile(r"^export (?=(?:class|const|function|let) )", re.MULTILINE)
_NAME = re.compile(r"^(?:class|const|let|(?:async )?function\*?) (\w+)", re.MULTILINE)


def source(name: str) -> str:
    """Read a file of the page."""
    return (resources.files("gacrl.export") / "page" / name).read_text(encoding="utf-8")


def script(main: str, texts: Mapping[str, str] = MappingProxyType({})) -> str:
    """Return a module and all that it imports, what is imported first.

    texts: of modules that are not the page's own. Raises ValueError where two modules have a name in common, or import
    each other.
    """
    placed: dict[str, str] = {}
    _place(main, texts, placed, ())
    owner: dict[str, str] = {}
    for module, text in placed.items():
        for name in _NAME.findall(text):
            if name in owner:
                raise ValueError(f"{module} and {owner[name]} both have {name}")
            owner[name] = module
    return "\n".join(f"// --- {module}\n{text}" for module, text in placed.items())


def _place(module: str, texts: Mapping[str, str], placed: dict[str, str], above: tuple[str, ...]) -> None:
    if module in above:
        raise ValueError(f"{module} imports itself by way of others")
    if module in placed:
        return
    text = texts[module] if module in texts else source(module)
    for imported in _IMPORT.findall(text):
        _place(imported, texts, placed, (*above, module))
    placed[module] = _EXPORT.sub("", _IMPORT.sub("", text))


MADE_BY = (
    "Made by <code>gacrl export --format html</code>. "
    "It runs in your browser alone: nothing is loaded, nothing is sent."
)
"""What an exported page says of itself."""


def page(
    title: str,
    data: Mapping[str, Any],
    texts: Mapping[str, str] = MappingProxyType({}),
    connects: Sequence[str] = (),
    made_by: str = MADE_BY,
) -> str:
    """Return the page. Its policy lets it run its own script and style, and load nothing; texts are escaped.

    texts: of modules that stand in for the page's own. connects: where it may connect to. made_by: HTML of our own.
    """
    code, style = script("main.js", texts), theme() + source("page.css")
    allowed = (
        "default-src 'none'",
        f"script-src '{digest(code)}'",
        f"style-src '{digest(style)}'",
        *((f"connect-src {' '.join(connects)}",) if connects else ()),
        "base-uri 'none'",
        "form-action 'none'",
    )
    parts = {
        "policy": html.escape("; ".join(allowed), quote=True),
        "title": html.escape(title),
        "style": style,
        "data": embedded(data),
        "script": code,
        "made_by": made_by,
    }
    return re.sub(r"\{\{(\w+)\}\}", lambda found: parts[found[1]], source("page.html"))
