"""Tables on screens of any width: columns where they fit, else blocks; words and numbers stay whole."""

import io

import pytest
from rich.console import Console

from gacrl.report.tables import print_table

COLUMNS = ("who", "difference", "what the seeds say")
ROWS = [
    ("gacrl", "-31.123 [-46.123, -26.123]", "cannot be told apart"),
    ("vdn", "0.001 [-0.100, 0.102]", "too few seeds to tell"),
]


def printed(width: int, rows: list[tuple[str, ...]] = ROWS, columns: tuple[str, ...] = COLUMNS) -> list[str]:
    console = Console(file=io.StringIO(), width=width, highlight=False, markup=False)
    print_table(console, columns, rows)
    return [line.rstrip() for line in console.file.getvalue().splitlines()]  # pyright: ignore[reportAttributeAccessIssue]


@pytest.mark.parametrize("width", [30, 40, 52, 60, 80, 130])
def test_numbers_and_words_stay_whole(width: int):
    lines = printed(width)
    assert max(map(len, lines)) <= width
    for row in ROWS:
        assert any(row[1] in line for line in lines), "a number stays beside its interval"
    assert " ".join(" ".join(lines).split()).count("[-46.123, -26.123]") == 1
    assert {"cannot", "apart", "few", "seeds"} <= set(" ".join(lines).split())


def test_a_wide_screen_has_a_table():
    assert "  gacrl   -31.123 [-46.123, -26.123]   cannot be told apart" in printed(80)


def test_a_narrow_screen_has_blocks_and_leaves_out_what_is_empty():
    rows = [(*ROWS[0],), ("oracle", "-5.520", "")]
    assert printed(30, rows) == [
        *("", "gacrl", "  difference", "    -31.123 [-46.123, -26.123]", "  what the seeds say"),
        *("    cannot be told apart", "oracle", "  difference  -5.520", ""),
    ]


def test_what_is_longer_than_the_screen_goes_on_in_the_next_line():
    name = "a/path/" * 8
    assert "".join(line.strip() for line in printed(30, [("x", name)], ("who", "where"))).endswith(name)
