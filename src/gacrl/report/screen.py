"""Text for a terminal of any width: what does not fit is folded.

It imports Rich only for a console.
"""

import os
import re
import shutil
import sys
import textwrap
import time
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console

WIDTH = 130
"""Columns where nothing is known of a terminal: a log can hold such lines."""
_NARROWEST = 20
_BELOW = 6
"""How far in stands what has no room beside its line."""


def terminal_width() -> int:
    """Return the columns of the terminal; COLUMNS, where it is set, goes before what the terminal says."""
    asked = os.environ.get("COLUMNS", "")
    if asked.isdecimal() and int(asked) > 0:
        return int(asked)
    alive = sys.stdout is not None and sys.stdout.isatty()
    return shutil.get_terminal_size((WIDTH, 24)).columns if alive else WIDTH


def console(quiet: bool = False) -> "Console":
    """Open the screen: colours and the terminal's width on a terminal; elsewhere lines that a log can hold."""
    from rich.console import Console

    screen = Console(highlight=False, markup=False, emoji=False, quiet=quiet)
    if not screen.is_terminal:  # a terminal may be made wider and narrower as it goes
        screen.width = terminal_width()
    return screen


def say(screen: "Console", line: str) -> None:
    """Print a line, folded where the screen has a width; in a log it stays one line."""
    knows_width = screen.is_terminal or "COLUMNS" in os.environ
    screen.print(folded(line, screen.width) if knows_width else line, soft_wrap=True)


def duration(seconds: int | float) -> str:
    """Write a time in words: 7 s, 12 min, 3.5 h; a question mark for one that nobody knows yet."""
    if seconds != seconds:
        return "?"
    if seconds < 120:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"


def folded(text: str, width: int) -> str:
    """Break lines that are wider at their spaces, so that columns (two spaces or more apart) stay columns.

    The last column goes on under its first word, or under the line where it begins too far to the right. What stands
    indented before it, as a command to copy, stays whole, and so does a word that is wider than the line, as a path.
    """
    return "\n".join(_folded_line(line, max(width, _NARROWEST)) for line in text.splitlines())


class Pace:
    """How long what is left will take, where every part takes as long as those before did."""

    def __init__(self, parts: int | float) -> None:
        self._parts, self._begun = parts, time.monotonic()

    def left(self, done: int | float) -> str:
        """Write the time to the end, after so many parts of them: "12 min left", or nothing before anything is done."""
        took = time.monotonic() - self._begun
        return f"{duration(took / done * (self._parts - done))} left" if done > 0 else ""


def _folded_line(line: str, width: int) -> str:
    if len(line) <= width:
        return line
    gaps = list(re.finditer(r"(?<=\S) {2,}", line))
    if not gaps:
        return line if line.startswith(" ") else _filled(line, width)
    gap = gaps[-1]
    if gap.end() <= width // 2:
        return _filled(line, width, gap.end())
    head, below = line[: gap.start()], line[gap.end() :]
    return f"{head}\n{_filled(' ' * _BELOW + below, width, _BELOW)}"


def _filled(text: str, width: int, indent: int = 0) -> str:
    filler = textwrap.TextWrapper(
        width, subsequent_indent=" " * indent, break_long_words=False, break_on_hyphens=False, expand_tabs=False
    )
    return filler.fill(text)
