"""Tables that fit any screen: their columns folded into several where one has no room, else a block for each row.

No number is ever cut.
"""

import re
from collections.abc import Collection, Sequence

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
"""Of a cell; a column that would need more has no room."""


def print_table(
    console: Console,
    columns: Sequence[str],
    rows: Sequence[Sequence[str]],
    title: str = "",
    keys: int = 1,
    sections: Collection[int] = (),
) -> None:
    """Print rows under their columns and a title, however narrow the screen is.

    Words wrap at spaces; a cell without letters, such as a number with its interval, stays on one line. Where that is
    not enough, the columns are folded into several tables, each with the first `keys` again; where one of them has no
    room, each row is a block of lines "column  cell". sections: rows with a gap after them.
    """
    if title:
        console.print(title, soft_wrap=True)
    columns, *rows = [[in_letters_of(console.encoding, text) for text in row] for row in (columns, *rows)]
    folds = _folds(columns, rows, console.width - 1, keys)
    for shown, widths in folds:
        table = Table(box=box.SIMPLE_HEAD)
        for column, width in zip(shown, widths, strict=True):
            table.add_column(columns[column], width=width, overflow="fold")
        for number, row in enumerate(rows):
            table.add_row(*(row[column] for column in shown), end_section=number in sections)
        console.print(table)
    if not folds:
        _print_blocks(console, columns, rows, keys)


_Fold = tuple[list[int], list[int]]
"""Columns of a table, and their widths."""


def _folds(columns: Sequence[str], rows: Sequence[Sequence[str]], room: int, keys: int) -> list[_Fold]:
    """The columns of each table; none where some column has no room beside the keys."""
    texts = list(zip(columns, *rows, strict=True))

    def fitted(shown: list[int]) -> _Fold | None:
        widths = _fitted([texts[column] for column in shown], room)
        return None if widths is None else (shown, widths)

    whole = fitted(list(range(len(columns))))
    if whole is not None:
        return [whole]
    folds: list[_Fold] = []
    for column in range(keys, len(columns)):
        wider = fitted([*folds[-1][0], column]) if folds else None
        alone = fitted([*range(keys), column])
        if wider is not None:
            folds[-1] = wider
        elif alone is not None:
            folds.append(alone)
        else:
            return []
    return folds


def _fitted(texts: Sequence[Sequence[str]], room: int) -> list[int] | None:
    """The width of each column, the widest narrowed until all fit; None where they cannot."""
    widths = [max(map(cell_len, column)) for column in texts]
    least = [max(_narrowest(text) for text in column) for column in texts]
    room -= _PADDING * len(texts)
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


def _print_blocks(console: Console, columns: Sequence[str], rows: Sequence[Sequence[str]], keys: int) -> None:
    console.print()
    for row in rows:
        console.print(" ".join(row[:keys]), soft_wrap=True)
        cells = [(name, cell) for name, cell in zip(columns[keys:], row[keys:], strict=True) if cell]
        names = max((cell_len(name) for name, _ in cells), default=0)
        for name, cell in cells:
            if cell_len(cell) <= console.width - names - 4:
                console.print(f"  {set_cell_size(name, names)}  {cell}")
            else:
                console.print(Padding(Text(name, overflow="fold"), (0, 0, 0, 2), expand=False))
                console.print(Padding(Text(cell, overflow="fold"), (0, 0, 0, 4), expand=False))
    console.print()
