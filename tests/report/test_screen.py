"""Text and tables on screens of any width, and in any letters: nothing is cut, and columns stay columns."""

import re

import pytest
from rich.console import Console

from gacrl.report import screen
from gacrl.report.letters import PLAIN_LETTERS, in_letters_of
from gacrl.report.screen import Pace, duration, folded
from gacrl.report.tables import print_table

COLUMNS = ("", "return", "coverage 0.1", "all covered", "collisions")
ROWS = [
    ["greedy", "-22.168 ± 241.797", "0.167 ± 0.001", "0.000 ± 0.003", "1.500 ± 22.236"],
    ["sampled", "-23.184 ± 16.045", "0.021 ± 0.020", "0.010 ± 0.005", "1.250 ± 3.177"],
]
TITLE = "/tmp/a/path/that/is/longer/than/the/narrowest/screen: 320 episodes of 25 steps"


def printed(
    width: int, columns: tuple[str, ...] = COLUMNS, rows: list[list[str]] = ROWS, keys: int = 1
) -> list[str]:
    console = Console(highlight=False, markup=False, width=width, no_color=True)
    with console.capture() as said:
        print_table(console, columns, rows, TITLE, keys)
    return [line.rstrip() for line in said.get().splitlines()]


@pytest.mark.parametrize(("width", "tables"), [(130, 1), (80, 1), (60, 2), (40, 4)])
def test_a_narrow_screen_folds_the_columns_and_cuts_no_number(width: int, tables: int):
    title, *lines = printed(width)
    assert title == TITLE, "which is to be copied"
    assert max(map(len, lines)) <= width
    said = "\n".join(lines)
    assert "…" not in said
    assert all(said.count(cell) == 1 for row in ROWS for cell in row[1:])
    assert said.count("greedy") == said.count("sampled") == tables, "each table says whose its rows are"
    assert all(said.count(word) == 1 for word in ("return", "coverage", "covered", "collisions")), (
        "each caption once"
    )


def test_where_no_column_has_room_each_row_is_a_block():
    rows = [["runs/" + "x" * 60, *ROWS[0][1:]]]
    assert printed(40, rows=rows)[1:] == [
        *("", "runs/" + "x" * 60),
        *(f"  {caption:12}  {cell}" for caption, cell in zip(COLUMNS[1:], ROWS[0][1:], strict=True)),
        "",
    ]


def test_every_fold_has_all_the_keys():
    said = "\n".join(printed(45, ("episode", *COLUMNS), [["50", *row] for row in ROWS], keys=2))
    assert said.count("episode\n") + len(re.findall("episode +", said)) == said.count("50   ") / 2 == 4


def test_lines_fold_at_their_spaces_and_columns_stay_columns():
    text = (
        "A paragraph of several words, one of them a/path/that/is/longer/than/the/line, folds.\n"
        "gacrl-112k    GACRL that solves the task, on a budget\n"
        "  gacrl train --preset paper --num-seeds 2     a seed on each core\n"
        "  gacrl train --preset paper --episodes 100 --out runs/quick"
    )
    assert folded(text, 200) == text
    assert folded(text, 30).splitlines() == [
        "A paragraph of several words,",
        "one of them",
        "a/path/that/is/longer/than/the/line,",
        "folds.",
        "gacrl-112k    GACRL that",
        "              solves the task,",
        "              on a budget",
        "  gacrl train --preset paper --num-seeds 2",
        "      a seed on each core",
        "  gacrl train --preset paper --episodes 100 --out runs/quick",
    ], "a command stays whole, since it is to be copied"


def test_a_screen_that_is_none_is_as_wide_as_it_is_told(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.delenv("COLUMNS", raising=False)
    assert screen.console().width == screen.terminal_width() == 130
    for width in (40, 60, 80):
        monkeypatch.setenv("COLUMNS", str(width))
        assert screen.console().width == screen.terminal_width() == width


def test_times_in_words(monkeypatch: pytest.MonkeyPatch):
    said = [duration(seconds) for seconds in (0.4, 119, 150, 7_199, 9_000, float("nan"))]
    assert said == ["0 s", "119 s", "2 min", "120 min", "2.5 h", "?"]
    now = [100.0]
    monkeypatch.setattr(screen.time, "monotonic", lambda: now[0])
    pace = Pace(12)
    assert pace.left(0) == ""
    now[0] = 130.0
    assert pace.left(3) == "90 s left", "three parts of twelve took 30 s"


def test_letters_that_an_encoding_has_not_are_written_in_plain_ones():
    text = "−7.3 ± 0.1, ε₀ → θ; “Läufe” … ━╌ ∞ 漢"
    assert in_letters_of("ascii", text) == '-7.3 +/- 0.1, epsilon0 -> theta; "Laufe" ... -- infinity ?'
    assert in_letters_of("cp1252", text) == "-7.3 ± 0.1, epsilon0 -> theta; “Läufe” … -- infinity ?"
    assert in_letters_of("utf-8", text) == text
    assert "r\udcfcn".encode("utf-8", PLAIN_LETTERS) == b"r\xfcn", "a file's name that is no text stays what it is"


def test_plain_letters_keep_columns_straight():
    console = Console(highlight=False, markup=False, width=130, no_color=True)
    type(console).encoding  # noqa: B018 what the console asks its file for
    with pytest.MonkeyPatch.context() as patch, console.capture() as said:
        patch.setattr(type(console), "encoding", "ascii")
        print_table(console, COLUMNS, ROWS)
    lines = said.get().splitlines()
    assert {len(line) for line in lines if line.strip()} == {len(lines[1])}
    assert "-22.168 +/- 241.797" in said.get()
