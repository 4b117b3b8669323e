"""Numbers that the README and docs/results.md print are those of the files they name, and files keep to the rules."""

import importlib.util
import json
import re
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from gacrl.config import files, presets
from gacrl.errors import UserError
from gacrl.evaluation.statistics import estimate

ROOT = Path(__file__).parent.parent
RETURN, COVERED, TOUCHED = "return_agent_mean", "coverage_final_0.1", "collisions"


def data(name: str) -> dict[str, Any]:
    return json.loads((ROOT / "docs" / "data" / f"{name}.json").read_text(encoding="utf-8"))


def row(page: str, start: str, after: str = "") -> list[str]:
    """The cells of the first table row that begins like this, behind a mark in the page."""
    text = (ROOT / page).read_text(encoding="utf-8")
    line = next(line for line in text[text.index(after) :].splitlines() if line.startswith(start))
    return [cell.strip().strip("*") for cell in line.strip("|").split("|")]


def agrees(printed: str, *exact: float) -> None:
    """Every printed number is the exact one to its last digit."""
    seen = re.findall(r"-?\d*\.?\d+", printed.replace("−", "-"))
    assert len(seen) == len(exact), printed
    for shown, number in zip(seen, exact, strict=True):
        digit = 10.0 ** -len(shown.partition(".")[2])
        assert abs(float(shown) - number) <= 0.5 * digit * (1 + 1e-6), (printed, exact)


README, RESULTS = "README.md", "docs/results.md"
GRAPH = "The same four presets with an entity graph"
INTERVALS = [
    (README, "| VDN |", "## Results", {3: RETURN, 4: COVERED}, "vdn-5-seeds"),
    (README, "| QMIX |", "## Results", {3: RETURN, 4: COVERED}, "qmix-5-seeds"),
    (README, "| IPPO |", "## Results", {3: RETURN, 4: COVERED}, "ippo-5-seeds"),
    (README, "| MAPPO |", "## Results", {3: RETURN, 4: COVERED}, "mappo-5-seeds"),
    (README, "| **`gacrl`** |", "## Results", {3: RETURN, 4: COVERED}, "gacrl-10-seeds"),
    *((RESULTS, f"| `{who}` |", "## The baselines", {2: RETURN, 3: COVERED}, f"{who}-5-seeds") for who in ("mappo", "ippo", "vdn", "qmix")),
    *((RESULTS, f"| `{who}` |", GRAPH, {1: RETURN, 3: COVERED}, f"{who}-graph-torso-5-seeds") for who in ("mappo", "ippo", "vdn", "qmix")),
    (RESULTS, "| final coverage 0.1 |", "Inside the paper's budget", {2: COVERED}, "gacrl-112k-4-seeds"),
    (RESULTS, "| final coverage 0.1 |", "Inside the paper's budget", {3: COVERED}, "gacrl-112k-10-seeds"),
    (RESULTS, "| return (mean per agent) |", "Inside the paper's budget", {2: RETURN}, "gacrl-112k-4-seeds"),
    (RESULTS, "| return (mean per agent) |", "Inside the paper's budget", {3: RETURN}, "gacrl-112k-10-seeds"),
    (RESULTS, "| touching pairs an episode |", "Inside the paper's budget", {2: TOUCHED}, "gacrl-112k-4-seeds"),
]  # fmt: skip


@pytest.mark.parametrize(
    ("page", "start", "after", "columns", "file"), INTERVALS, ids=lambda value: str(value)[:24]
)
def test_intervals_are_those_of_their_file(page: str, start: str, after: str, columns: dict[int, str], file: str):
    cells, final = row(page, start, after), data(file)["final"]["greedy"]
    for column, metric in columns.items():
        agrees(cells[column], *estimate(final[metric]["values"]))


@pytest.mark.parametrize("who", ["random", "oracle"])
def test_references_are_those_of_their_file(who: str):
    found = data("gacrl-10-seeds")["references"][who]
    cells = row(README, f"| {who} |", "interquartile mean")
    agrees(cells[3], found[RETURN])
    agrees(cells[4], found[COVERED])


@pytest.mark.parametrize(
    ("start", "file"),
    [
        ("| `speaker_listener` |", "talk-speaker_listener-10-seeds"),
        ("| `reference` |", "talk-reference-10-seeds"),
        ("| `colours`, ring |", "talk-colours-10-seeds"),
        ("| `colours`, ring, unnamed |", "talk-colours-unnamed-10-seeds"),
        ("| `colours`, full graph |", "talk-colours-full-10-seeds"),
    ],
)
def test_successes_are_every_seeds(start: str, file: str):
    cells, found = row(README, start), data(file)
    agrees(cells[2].partition(":")[0], *found["final"]["greedy"]["success_final_0.1"]["values"])
    assert found["env_steps"] == pytest.approx(int(cells[1].replace(",", "")), rel=0.02)


def test_the_summary_of_the_reproduction_is_that_of_its_file():
    """Counts by test, and both axes."""
    found = json.loads((ROOT / "docs" / "reproduction" / "results.json").read_text(encoding="utf-8"))
    tests = [claim for claim in found["claims"] if claim["id"] == claim["test"]]
    text = (ROOT / RESULTS).read_text(encoding="utf-8")
    assert f"The {len(found['claims'])} claims rest on {len(tests)} tests" in text
    for start, agreement in (("agree", "agrees"), ("disagree", "disagrees"), ("undecided", "undecided")):
        told = ["told from random", "not told from random", "equivalent to random", ""]
        counts = [sum((t["agreement"], t["random"]) == (agreement, chance) for t in tests) for chance in told]
        assert [int(cell) for cell in row(RESULTS, f"| {start} |", "## Every claim")[1:]] == counts


@pytest.fixture(scope="module")
def keep() -> ModuleType:
    spec = importlib.util.spec_from_file_location("keep", ROOT / "benchmarks" / "keep.py")
    assert spec is not None and spec.loader is not None
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    return script


CLEAN, OTHER = "c0ffee" * 6 + "c0ff", "decade" * 6 + "deca"


@pytest.mark.parametrize(
    ("begun", "summary", "refused"),
    [
        (CLEAN, {}, ""),
        (OTHER, {}, "was begun by commit decade.* and ended by c0ffee"),
        (None, {}, "knows no commit"),
        (f"{CLEAN}-dirty", {"versions": {"git_commit": f"{CLEAN}-dirty"}}, "with changes beside commit c0ffee"),
        (CLEAN, {"seeds": [0, 2]}, r"holds seeds \[0, 2\], where \[0, 1\] were planned"),
        (CLEAN, {"final": {"greedy": {"x": {"values": [1.0]}}}}, r"lacks a finite value of x \(greedy\)"),
        (CLEAN, {"final": {"greedy": {"x": {"values": [1.0, float("nan")]}}}}, "lacks a finite value"),
    ],
)
def test_only_what_one_clean_commit_made_is_kept(
    keep: ModuleType, tmp_path: Path, begun: str | None, summary: dict[str, Any], refused: str
):
    whole = {
        "seeds": [0, 1],
        "final": {"greedy": {"x": {"values": [1.0, 2.0]}}},
        "versions": {"git_commit": CLEAN},
        **summary,
    }
    config = files.from_dict({"num_seeds": 2}, presets.preset("gacrl"))
    (tmp_path / "config.json").write_text(files.dumps(config), encoding="utf-8")
    (tmp_path / "origin.json").write_text(json.dumps({"versions": {"git_commit": begun}}), encoding="utf-8")
    with pytest.raises(UserError, match="is no finished run"):
        keep.kept_summary(tmp_path, "gacrl train")
    (tmp_path / "summary.json").write_text(json.dumps(whole), encoding="utf-8")
    if refused:
        with pytest.raises(UserError, match=refused):
            keep.kept_summary(tmp_path, "gacrl train")
        return
    assert keep.kept_summary(tmp_path, "gacrl train") == {"command": "gacrl train", **whole}
    (tmp_path / "diverged.json").write_text("{}", encoding="utf-8")
    with pytest.raises(UserError, match="diverged"):
        keep.kept_summary(tmp_path, "gacrl train")
