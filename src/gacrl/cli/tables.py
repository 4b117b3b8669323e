"""Tables that fit any screen: columns where there is room, else a block for each row. No number is ever cut.

A leaf, so that every room that prints may use it.
"""

import io
import os
import re
import sys
from collections.abc import Sequence

from rich import box
from rich.cells import cell_len, set_cell_size
from rich.console import Console
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

WIDTH = 130
"""Columns of what is no terminal, where COLUMNS does not say: a log can hold them."""
_PADDING = 3
"""Columns of the screen that rich puts between two columns of a table."""
_LINES = 3
"""Of a cell; one that would take more turns the table into blocks."""


class Screen(Console):
    """Standard output, plain: characters that it cannot encode are written as escapes; a closed pipe is an error."""

    def __init__(self) -> None:
        if isinstance(sys.stdout, io.TextIOWrapper) and sys.stdout.errors == "strict":
            sys.stdout.reconfigure(errors="backslashreplace")
        super().__init__(highlight=False, markup=False, emoji=False)
        if not self.is_terminal and not os.environ.get("COLUMNS", "").isdigit():
            self.width = WIDTH

    def on_broken_pipe(self) -> None:
        """Raises BrokenPipeError, which the command line knows; rich would exit with 1."""
        raise BrokenPipeError


def print_table(console: Console, columns: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print rows under their columns; where they do not fit, each row as a block of lines "column  cell".

    Words wrap at spaces; a cell without letters, such as a number with its interval, stays on one line.
    """
    columns, *rows = [[_encodable(console, text) for text in row] for row in (columns, *rows)]
    widths = _fitted(columns, rows, console.width - 1)
    if widths is None:
        _print_blocks(console, columns, rows)
        return
    table = Table(box=box.SIMPLE_HEAD)
    for name, width in zip(columns, widths, strict=True):
        table.add_column(name, width=width, overflow="fold")
    for row in rows:
        table.add_row(*row)
    console.print(table)


def _encodable(console: Console, text: str) -> str:
    """The text as it will stand on the screen, so that its width is known."""
    return text.encode(console.encoding, "backslashreplace").decode(console.encoding)


def _fitted(columns: Sequence[str], rows: Sequence[Sequence[str]], room: int) -> list[int] | None:
    """The width of each column, the widest narrowed until all fit; None where they cannot."""
    texts = list(zip(columns, *rows, strict=True))
    widths = [max(map(cell_len, column)) for column in texts]
    least = [max(_narrowest(text) for text in column) for column in texts]
    room -= _PADDING * len(columns)
    while sum(widths) > room:
        spare = [width - low for width, low in zip(widths, least, strict=True)]
        if not any(spare):
            return None
        widest = max((k for k, left in enumerate(spare) if left), key=lambda k: widths[k])
        widths[widest] -= 1
    return widths


def _narrowest(text: str) -> int:
    """The narrowest column of a table that shows this text whole, on about _LINES lines."""
    return max(_unbroken(text), -(-cell_len(text) // _LINES))


def _unbroken(text: str) -> int:
    """The width of its longest part that stays on one line: a word, or a number with its interval."""
    if not re.search(r"[^\W\d_]", text):
        return cell_len(text)
    return max((cell_len(word) for word in text.split()), default=0)


def _print_blocks(console: Console, columns: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    console.print()
    for row in rows:
        console.print(row[0], overflow="fold")
        cells = [(name, cell) for name, cell in zip(columns[1:], row[1:], strict=True) if cell]
        names = max((cell_len(name) for name, _ in cells), default=0)
        for name, cell in cells:
            if cell_len(cell) <= console.width - names - 4:
                console.print(f"  {set_cell_size(name, names)}  {cell}")
            else:
                console.print(Padding(Text(name, overflow="fold"), (0, 0, 0, 2), expand=False))
                console.print(Padding(Text(cell, overflow="fold"), (0, 0, 0, 4), expand=False))
    console.print()
