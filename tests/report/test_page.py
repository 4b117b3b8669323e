"""Pages and figures: complete, escaped, the same every time."""

import re
from collections.abc import Callable
from html.parser import HTMLParser
from itertools import pairwise
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from gacrl.errors import UserError
from gacrl.report import figures, figures_labels
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


def test_an_algorithm_has_one_colour_in_all_figures():
    looks = figures.looks(["a", "b", "c"], {"a": "qmix", "b": "gacrl", "c": "own"})
    assert (looks["a"].color, looks["b"].color) == (figures.COLORS["qmix"], figures.COLORS["gacrl"])
    assert figures.looks(["GACRL", "mine"])["GACRL"].color == looks["b"].color
    assert looks["c"].color in set(figures.PALETTE) - {looks["a"].color, looks["b"].color}
    assert figures.looks(["x"], {"x": "gacrl"})["x"].color == looks["b"].color


@pytest.mark.parametrize("kinds", [["gacrl"], ["gacrl", "vdn"], [f"own {k}" for k in range(40)]])
def test_no_two_lines_look_alike(kinds: list[str]):
    """Neighbours differ in dash and shape as well, for print without colours."""
    names = [str(k) for k in range(40)]
    looks = list(figures.looks(names, {name: kinds[k % len(kinds)] for k, name in enumerate(names)}).values())
    assert len({(look.color, str(look.dash)) for look in looks}) == 40
    for first, second in pairwise(looks):
        assert first.dash != second.dash and first.shape != second.shape


def markers(svg: str, name: str = "gacrl") -> int:
    """How many markers of that algorithm are drawn; that in its label's sample is one."""
    return len(re.findall(rf"<use [^>]*{figures.COLORS[name].lower()}", svg))


def test_a_curve_of_a_single_evaluation_has_a_marker_and_its_interval():
    other = {"vdn": (X, [1, 2, 3], None, None, None)}
    assert markers(figures.curves({"gacrl": ([1000], [2.0], None, None, None), **other}, "x", "y")) == 2
    with_seeds = figures.curves({"gacrl": ([1000], [2.0], [1.0], [3.0], [[1.0], [3.0]]), **other}, "x", "y")
    assert markers(with_seeds) == 2 + 2, "the seeds are points"
    assert with_seeds.count('id="LineCollection') == 1, "a band has no width there"


def test_an_interval_between_gaps_is_drawn():
    low, high = [0.0, np.nan, 2.0], [2.0, np.nan, 4.0]
    lonely = figures.curves({"gacrl": (X, [1, 2, 3], low, high, None)}, "x", "y")
    assert len(re.findall(r"<path [^>]*", lonely.split('id="LineCollection')[1].split("</g>")[0])) == 2


def test_an_end_before_the_others_is_marked_and_nothing_is_carried_on():
    def drawn(seeds: object, **more: object) -> int:
        return markers(figures.curves({"gacrl": (X, [1, 2, 3], None, None, seeds)}, "x", "y", **more))

    everywhere = drawn([[1, 2, 3], [1, 2, 3]])
    assert everywhere == 3 + 1
    assert drawn([[1, 2, 3], [1, 2, np.nan], [1, 2, np.nan]]) == everywhere + 1, "a cross where two end"
    assert drawn([[1, 2, 3], [1, np.nan, np.nan], [1, 2, np.nan]]) == everywhere + 3, (
        "and a seed that is one point"
    )
    assert drawn(None, stopped=["gacrl"]) == everywhere + 1


def test_the_last_evaluation_of_a_long_curve_is_marked():
    """So that the shape beside its label is found in the figure."""
    many = list(range(100))
    assert markers(figures.curves({"gacrl": (many, many, None, None, None)}, "x", "y")) == 2


def words_at(svg: str) -> list[tuple[str, float, float]]:
    """Every text with the place where it is written."""
    found: list[tuple[str, float, float]] = []
    for text in ElementTree.fromstring(svg).iter("{http://www.w3.org/2000/svg}text"):
        x, y = text.get("x"), text.get("y")
        if x is None or y is None:
            x, y = re.findall(r"-?[\d.]+", text.get("transform", ""))[:2]
        found.append((text.text or "", float(x), float(y)))
    return found


def test_labels_do_not_lie_on_each_other():
    """Thirty lines that end at one height, and references there too: each label has a line of its own."""
    series = {f"run {k}": (X, [0, 0, 1 + k / 1e6], None, None, None) for k in range(30)}
    lines = {"random": 1.0, "noop": 1.0, "oracle": 1.0}
    words = words_at(figures.curves(series, "x", "y", lines))
    heights = sorted(y for text, _, y in words if text in series or text in lines)
    assert len(heights) == 33
    assert min(np.diff(heights)) >= 9

    names = [
        (x, y) for text, x, y in words_at(figures.dots({"a": [1, 2]}, {"a": None}, "x", lines)) if text in lines
    ]
    assert len({y for _, y in names}) == 3, "at one place: above each other"
    names = [
        y
        for text, _, y in words_at(figures.dots({"a": [1, 9]}, {"a": None}, "x", {"low": 1.0, "high": 9.0}))
        if text in ("low", "high")
    ]
    assert len(set(names)) == 1, "far apart: side by side"


@pytest.mark.parametrize("wanted", [[5.0, 5.0, 5.0], [0.0, 1.0, 98.0, 99.0, 100.0], [50.0, 52.0, 20.0], []])
def test_labels_are_spread_as_little_as_it_takes(wanted: list[float]):
    tall = np.full(len(wanted), 10.0)
    found = figures_labels.spread(wanted, tall, 0.0, 100.0)
    assert (np.diff(np.sort(found)) >= 10.0 - 1e-9).all()
    assert ((found >= 5.0 - 1e-9) & (found <= 95.0 + 1e-9)).all()
    assert [wanted[k] for k in np.argsort(found, kind="stable")] == sorted(wanted), "in the order of their lines"


def test_a_row_without_seeds_says_that_it_diverged():
    words = [text for text, _, _ in words_at(figures.dots({"a": [1, 2], "b": []}, {"a": None, "b": None}, "x"))]
    assert words.count("diverged") == 1


def test_drawing_leaves_the_users_settings_alone():
    import matplotlib as mpl

    before = mpl.rcParams.copy()
    DRAWINGS["dots"]()
    assert {name for name in before if name != "backend" and mpl.rcParams[name] != before[name]} == set()
