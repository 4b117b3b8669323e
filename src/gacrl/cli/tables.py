"""Tables that fit any screen: columns where there is room, else a block for each row. No number is ever cut.

A leaf, so that every room that prints may use it.
"""

import re
from collections.abc import Sequence

from rich import box
from rich.cells import cell_len, set_cell_size
from rich.console import Console
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from gacrl.report.letters import in_letters_of

_PADDING = 3
"""Columns of the screen that rich puts between two columns of a table."""
_LINES = 3
"""Of a cell; one that would take more turns the table into blocks."""


def print_table(console: Console, columns: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print rows under their columns; where they do not fit, each row as a block of lines "column  cell".

    Words wrap at spaces; a cell without letters, such as a number with its interval, stays on one line.
    """
    columns, *rows = [[in_letters_of(console.encoding, text) for text in row] for row in (columns, *rows)]
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
