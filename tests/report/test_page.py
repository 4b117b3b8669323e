"""Pages and figures: complete, escaped, the same every time."""

from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from gacrl.errors import UserError
from gacrl.report import figures
from gacrl.report.page import Page

SVG = '<?xml version="1.0"?>\n<svg xmlns="http://www.w3.org/2000/svg"><defs><path id="p" d="M0 0"/></defs><g clip-path="url(#p)"/><use href="#p"/></svg>\n'


def a_page() -> Page:
    page = Page("Runs <1> & 2")
    page.heading("First *part*")
    page.text("- x < y | z, snake_case_name stays")
    page.code("gacrl compare a b")
    page.table(["name", "a|b"], [["<script>", "1"], ["two", "2"]], caption="# of runs")
    page.figure(SVG, 'A "figure"', "one")
    page.heading("Second", level=3)
    page.figure(SVG, "Another", "two")
    return page


class Outline(HTMLParser):
    """Tags in their order, text, ids; a tag that is left open, or closed wrongly, is an error."""

    def __init__(self, text: str):
        super().__init__()
        self.tags: list[str] = []
        self.texts: list[str] = []
        self.ids: list[str] = []
        self._open: list[str] = []
        self.feed(text)
        assert self._open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.ids += [value or "" for name, value in attrs if name == "id"]
        if tag != "meta":
            self._open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attrs)
        self._open.pop()

    def handle_endtag(self, tag: str) -> None:
        assert self._open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.texts.append(data)


def test_html_holds_everything_in_order_and_escaped():
    text = a_page().html()
    outline = Outline(text)
    found = [tag for tag in outline.tags if tag in ("h1", "h2", "h3", "p", "pre", "table", "svg")]
    assert found == ["h1", "h2", "p", "pre", "table", "svg", "h3", "svg"]
    for said in ("Runs <1> & 2", "First *part*", "- x < y | z, snake_case_name stays", "<script>", "a|b"):
        assert said in outline.texts
    assert "script" not in outline.tags
    assert 'aria-label="A &quot;figure&quot;"' in text


def test_html_needs_nothing_else():
    text = a_page().html()
    for reaching_out in ("<script", "<link", "<img", "src=", "@import", "http:", "https:"):
        assert reaching_out not in text.replace('xmlns="http://www.w3.org/2000/svg"', "")


def test_figures_of_a_page_do_not_share_ids():
    text = a_page().html()
    assert Outline(text).ids == ["one-p", "two-p"]
    assert "url(#one-p)" in text
    assert 'href="#two-p"' in text


def test_markdown_says_the_same():
    assert a_page().markdown("figs").split("\n\n") == [
        "# Runs &lt;1&gt; &amp; 2",
        r"## First \*part\*",
        r"\- x &lt; y \| z, snake_case_name stays",
        "```\ngacrl compare a b\n```",
        r"\# of runs",
        "| name | a\\|b |\n| --- | --- |\n| &lt;script&gt; | 1 |\n| two | 2 |",
        '![A "figure"](figs/one.svg)',
        '*A "figure"*',
        "### Second",
        "![Another](figs/two.svg)",
        "*Another*\n",
    ]


def test_a_page_is_written_with_its_figures_beside_it(tmp_path: Path):
    written = a_page().write(tmp_path / "new" / "folder", "runs")
    assert written == tmp_path / "new" / "folder" / "runs.html"
    assert written.read_text(encoding="utf-8") == a_page().html()
    assert (written.parent / "runs.md").read_text(encoding="utf-8") == a_page().markdown("runs-figures")
    assert (written.parent / "runs-figures" / "two.svg").read_text(encoding="utf-8") == SVG
    assert len(list(written.parent.rglob("*"))) == 5


def test_a_page_without_figures_makes_no_folder_for_them(tmp_path: Path):
    Page("Empty").write(tmp_path, "empty")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["empty.html", "empty.md"]


def test_a_place_that_cannot_be_written_is_said(tmp_path: Path):
    (tmp_path / "file").touch()
    with pytest.raises(UserError, match=r"cannot write runs.html into .*file: .*; choose another --out"):
        a_page().write(tmp_path / "file", "runs")


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [
        (lambda page: page.heading("x", level=1), "level 2 to 4, not 1"),
        (lambda page: page.table(["a", "b"], [["1"]]), "a row has 1 cells under 2 columns"),
        (lambda page: page.figure(SVG, "", "one"), "there is a figure 'one' already"),
        (lambda page: page.figure(SVG, "", "../x"), "letters, digits"),
        (lambda page: page.figure("<b>", "", "three"), "not SVG"),
    ],
)
def test_a_builders_mistakes_raise(wrong: Callable[[Page], None], sentence: str):
    with pytest.raises(ValueError, match=sentence):
        wrong(a_page())


def test_code_may_hold_backticks():
    page = Page("x")
    page.code("a ``` b")
    assert "````\na ``` b\n````" in page.markdown("")


X = [1000, 2000, 3000]
DRAWINGS = {
    "curves": lambda: figures.curves(
        {
            "vdn, $5 <x> $6": (X, [1, 2, 3], [0, 1, 2], [2, 3, 4], [[1, 2, 3], [0, 2, 4]]),
            "one seed": (X, [1, 1, 1], None, None, None),
        },
        "environment steps",
        "return",
        {"random": 0.5},
    ),
    "dots": lambda: figures.dots(
        {"vdn, $5 <x> $6": [1, 2], "one seed": [3]},
        {"vdn, $5 <x> $6": (1.5, 1.0, 2.0), "one seed": None},
        "return",
        {"random": 0.5},
    ),
    "profile": lambda: figures.profile(
        {"vdn, $5 <x> $6": (X, [1, 0.5, 0], [1, 0, 0], [1, 1, 0]), "one seed": (X, [1, 1, 0], None, None)},
        "return",
    ),
    "heat": lambda: figures.heat(
        np.where(np.arange(12).reshape(3, 2, 2) == 5, np.nan, np.arange(12).reshape(3, 2, 2) / 7),
        ("torso", ["mlp", "graph", "vdn, $5 <x> $6"]),
        ("rows", ["a", "b"]),
        ("columns", ["c", "one seed"]),
        "return",
    ),
}


@pytest.mark.parametrize("name", DRAWINGS)
def test_a_figure_is_svg_with_its_words_and_always_the_same(name: str):
    drawn = DRAWINGS[name]()
    root = ElementTree.fromstring(drawn)
    assert root.tag == "{http://www.w3.org/2000/svg}svg"
    words = " | ".join(element.text or "" for element in root.iter("{http://www.w3.org/2000/svg}text"))
    for said in ("vdn", "<x>", "$6", "one seed", "return"):
        assert said in words
    assert "date" not in drawn.lower()
    assert DRAWINGS[name]() == drawn


def test_a_curve_has_a_band_and_a_line_for_each_seed():
    def lines(svg: str) -> int:
        return svg.count('id="line2d_')

    with_seeds = figures.curves({"a": (X, [1, 2, 3], [0, 1, 2], [2, 3, 4], [[1, 2, 3]] * 4)}, "x", "y")
    without = figures.curves({"a": (X, [1, 2, 3], None, None, None)}, "x", "y")
    assert with_seeds.count("FillBetweenPolyCollection") == 1
    assert "FillBetweenPolyCollection" not in without
    assert lines(with_seeds) >= lines(without) + 4


def test_a_grid_writes_every_number_but_empty_cells():
    root = ElementTree.fromstring(DRAWINGS["heat"]())
    words = [element.text for element in root.iter("{http://www.w3.org/2000/svg}text")]
    assert all(f"{k / 7:.3g}" in words for k in range(12) if k != 5)
    with pytest.raises(ValueError, match=r"shape \[2, 2\] has labels for \[1, 2, 2\]"):
        figures.heat(np.zeros((2, 2)), ("p", ["a"]), ("r", ["a", "b"]), ("c", ["a", "b"]), "x")


def test_colours_and_dashes_tell_many_apart():
    looks = {figures._look(k) for k in range(28)}
    assert len(looks) == 28


def test_drawing_leaves_the_users_settings_alone():
    import matplotlib as mpl

    before = mpl.rcParams.copy()
    DRAWINGS["dots"]()
    assert {name for name in before if name != "backend" and mpl.rcParams[name] != before[name]} == set()
