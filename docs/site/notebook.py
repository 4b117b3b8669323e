"""Runs a notebook's cells, without Jupyter: a test does, and the site shows what they give."""

import ast
import base64
import contextlib
import io
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt


class Shown(NamedTuple):
    """A cell, and what it gave."""

    kind: str
    source: str
    text: str = ""
    pictures: tuple[bytes, ...] = ()


def cells(path: Path) -> Iterator[tuple[str, str]]:
    """Yield the kind (`code` or `markdown`) and the source of each cell."""
    for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
        yield cell["cell_type"], "".join(cell["source"])


def run(path: Path, names: dict[str, Any]) -> Iterator[Shown]:
    """Run the cells one after the other, in these names and the folder of the process. Raises what a cell raises.

    As in Jupyter, what a cell prints is shown, then the value of its last line, then its figures (PNG).
    """
    for kind, source in cells(path):
        if kind != "code":
            yield Shown(kind, source)
            continue
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed):
            value = _value(source, names)
        text = printed.getvalue() + ("" if value is None else f"{value!r}\n")
        yield Shown(kind, source, text, tuple(_figures()))


def _value(source: str, names: dict[str, Any]) -> Any:
    """Run a cell and return the value of its last line, None where that is no expression or ends in a semicolon."""
    body = ast.parse(source).body
    last = ast.Expression(body.pop().value) if body and isinstance(body[-1], ast.Expr) else None
    exec(compile(ast.Module(body, []), "<cell>", "exec"), names)
    value = None if last is None else eval(compile(last, "<cell>", "eval"), names)
    return None if source.rstrip().endswith(";") else value


def _figures() -> Iterator[bytes]:
    """Yield the figures that are open, and close them."""
    for figure in map(plt.figure, plt.get_fignums()):
        kept = io.BytesIO()
        figure.savefig(kept, dpi=120, bbox_inches="tight")
        yield kept.getvalue()
    plt.close("all")


def page(shown: list[Shown]) -> str:
    """Return a page in Markdown, its pictures inside."""
    parts = []
    for cell in shown:
        if cell.kind != "code":
            parts.append(cell.source)
            continue
        parts.append(f"```python\n{cell.source}\n```")
        if cell.text:
            parts.append(f"```text\n{cell.text.rstrip()}\n```")
        for picture in cell.pictures:
            data = base64.b64encode(picture).decode()
            parts.append(f'<img alt="the figure of the cell above" src="data:image/png;base64,{data}">')
    return "\n\n".join(parts) + "\n"
