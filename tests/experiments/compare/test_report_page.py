"""The report of a run: its episodes are those of the closing evaluation, and the page plays them."""

import json
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from browsing import Visit
from conftest import TinyRun

from gacrl.cli.main import main
from gacrl.experiments.compare import exploring, replays
from gacrl.experiments.compare.compare import compare
from gacrl.experiments.compare.pages import write_page

pytestmark = pytest.mark.xdist_group("runs")


@pytest.fixture(scope="module")
def report(tiny_run: TinyRun, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("report") / "all of it.html"
    assert main(["compare", str(tiny_run.folder), "--label", "</script><b>one", "--out", str(out)]) == 0
    return out


def shown(report: Path) -> dict[str, Any]:
    data = re.search(r'id="live-data">(.*?)</script>', report.read_text(encoding="utf-8"), re.DOTALL)
    assert data is not None
    return json.loads(data[1])


def test_its_episodes_are_those_of_the_closing_evaluation(tiny_run: TinyRun, report: Path):
    """Sixteen of them: all are shown, so that their returns are each seed's in the summary."""
    (group,) = shown(report)["groups"]
    values = [episode["value"] for episode in group["episodes"]]
    assert group["name"] == "</script><b>one" and len(values) == 16
    best, median, *worst = values
    assert best == max(values) and median == sorted(values)[7] and worst == sorted(worst)
    summary = json.loads((tiny_run.folder / "summary.json").read_text())
    for seed, closing in zip(
        summary["seeds"], summary["final"]["greedy"]["return_agent_mean"]["values"], strict=True
    ):
        mine = [episode["value"] for episode in group["episodes"] if episode["seed"] == seed]
        assert len(mine) == 8 and np.mean(mine) == pytest.approx(closing, abs=2e-3)


def test_of_many_episodes_the_best_the_median_and_the_twenty_worst_are_shown():
    returns = np.random.default_rng(0).permutation(60).reshape(3, 20).astype(float)
    found = {place.rank: returns[place.seed, place.number] for place in replays.chosen(returns)}
    assert found == {"best": 59.0, "median": 29.0, **{f"worst {k + 1}": float(k) for k in range(20)}}
    assert [place.rank for place in replays.chosen(np.array([[1.0]]))] == ["best"]


def test_it_says_all_that_belongs_to_a_report(tiny_run: TinyRun, report: Path):
    text = report.read_text(encoding="utf-8")
    config = tiny_run.folder / "config.json"
    for said in (
        "Exploration against progress",
        f"gacrl train --config {config}",
        "every metric of the task",
        "jaxlib",
    ):
        assert said in text
    assert f"gacrl compare {tiny_run.folder} --label" in text
    assert "<b>one" not in text, "what a user writes is text"
    assert list(report.parent.iterdir()) == [report], "one file"


def test_exploration_is_drawn_against_progress_where_its_rule_looks_at_it(tiny_run: TinyRun):
    (group,) = compare([tiny_run.folder]).groups
    rows = [json.loads(line) for line in (tiny_run.folder / "metrics.jsonl").read_text().splitlines()]
    progress, level = exploring.ways(group, "greedy")[1]
    mine = [row for row in rows if row["seed"] == group.seeds[1]]
    assert exploring.progress_metric(group.config) in mine[0]["greedy"]
    np.testing.assert_array_equal(level, [row["update"]["epsilon"] for row in mine])
    np.testing.assert_array_equal(progress, [row["greedy"]["coverage_final_0.2"] for row in mine])


def test_a_run_without_a_scene_says_why_nothing_plays(
    tiny_run: TinyRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    found = compare([tiny_run.folder])
    monkeypatch.setattr(replays, "open_run", lambda *given: SimpleNamespace(trainer=None))
    (gallery,) = replays.record(found, lambda sentence: None)
    page = write_page(found, tmp_path / "page.html", "", [gallery]).read_text(encoding="utf-8")
    assert gallery.shown == [] and "no episodes to play, since spread lives in Python" in page
    assert "live-data" not in page and "script-src &#x27;none&#x27;" in page


def test_the_page_plays_them(report: Path, browser: Any):
    visit = Visit(browser, report, name="gacrlReport")
    now = "[gacrlReport.still.episode, Math.floor(gacrlReport.still.t), gacrlReport.still.playing]"
    assert visit(now) == [0, 0, False]
    visit.focus("live-canvas")
    visit.press(".", ".", ",", "n")
    assert visit(now) == [1, 0, False]
    visit.press(" ")
    visit.until("gacrlReport.still.t > 2")
    visit.press(" ", "r", ".", "a")
    assert visit(now) == [1, 1, False] and visit.page.locator("#live h3").inner_text() == "Agent 1"
    visit.page.get_by_label("Episode").select_option("2")
    visit.page.get_by_label("Step", exact=True).focus()
    visit.press("End")
    assert visit(now) == [2, 15, False]
    value = shown(report)["groups"][0]["episodes"][2]["value"]
    told = visit.page.locator("#live .told").inner_text().replace("\u2212", "-")
    assert told.startswith("worst 1: return ") and f"Return so far {value:.2f}; " in told
    box = visit.page.locator("#live-canvas").bounding_box()
    x, y = visit(
        "gacrlReport.view.place(...Object.values(gacrlReport.still.frames[15].scene.agents[2]).slice(0, 2)).map(p => p / gacrlReport.view.size)"
    )
    visit.page.mouse.click(box["x"] + x * box["width"], box["y"] + y * box["height"])
    assert visit.page.locator("#live h3").inner_text() == "Agent 2"
    visit.page.set_viewport_size({"width": 390, "height": 800})
    assert visit("document.documentElement.scrollWidth") <= 390
    visit.close()
