"""Sphinx's settings for the site that `make docs` builds."""

import re
from typing import Any

from gacrl import versions

project = "gacrl"
author = "The gacrl authors"
release = versions.version()
extensions = ["myst_parser", "sphinx.ext.autodoc"]
exclude_patterns = ["conf.py"]

myst_heading_anchors = 3
# Reports that the program writes have heads of the third level under the first.
suppress_warnings = ["myst.header"]

autodoc_typehints = "signature"
autodoc_typehints_format = "short"
default_role = "code"
nitpicky = True
# Names of other packages, axes of jaxtyping, and what the package does not export: they have no entry to link to.
nitpick_ignore_regex = [
    ("py:.*", r"(?!gacrl\.).*"),
    ("py:class", r"gacrl\.(?!(api|play)\.|tasks\.task\.(Task|Metric)).*"),
]

html_theme = "furo"
html_title = f"gacrl {release}"
html_static_path = ["static"]
html_css_files = ["site.css"]
html_extra_path = ["../whole"]
html_copy_source = html_show_copyright = False
pygments_style, pygments_dark_style = "friendly", "native"


def plain(app: Any, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Docstrings are plain text with code in backticks: nothing else in them is markup."""
    for number, line in enumerate(lines):
        parts = re.split(r"(`[^`]*`)", line)
        lines[number] = "".join(part if part[:1] == "`" else re.sub(r"([*|_])", r"\\\1", part) for part in parts)


def setup(app: Any) -> None:
    """Register what is done to docstrings."""
    app.connect("autodoc-process-docstring", plain)
