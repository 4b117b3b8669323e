"""`gacrl compare` on small run folders made by hand: what is grouped, computed, noted and refused."""

import csv
import json
import os
import re
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gacrl import tasks
from gacrl.cli.main import main
from gacrl.config import files as configuration
from gacrl.config import presets
from gacrl.config.run import RunConfig
from gacrl.evaluation import statistics
from gacrl.evaluation.statistics import with_interval
from gacrl.experiments.compare.compare import Comparison, Pair, compare
from gacrl.experiments.compare.data import to_dict, to_marl_eval
from gacrl.experiments.compare.pages import write_page

REFERENCES = {
    who: {"return_agent_mean": value, "coverage_final_0.1": coverage, "collisions": 1.0}
    for who, value, coverage in (("random", -26.0, 0.0), ("noop", -24.0, 0.0), ("oracle", -6.0, 1.0))
}
VDN = presets.preset("vdn")
MAPPO = presets.preset("mappo")
EVALUATED_AT = (1000, 2000, 3000)

MakeRun = Callable[..., Path]


@pytest.fixture
def make_run(tmp_path: Path) -> MakeRun:
    """Writes a run folder as training does: the closing returns of its seeds, and a few evaluations before."""

    def make(
        name: str,
        config: RunConfig,
        returns: Sequence[float],
        seed: int = 0,
        evaluated_at: Sequence[int] = EVALUATED_AT,
        **summary: Any,
    ) -> Path:
        folder = tmp_path / name
        folder.mkdir()
        config = replace(config, seed=seed, num_seeds=len(returns))
        (folder / "config.json").write_text(configuration.dumps(config))
        final = {
            "return_agent_mean": list(returns),
            "coverage_final_0.1": [(value + 26) / 20 for value in returns],
            "score_return_agent_mean": [(value + 26) / 20 for value in returns],
            "collisions": [-value for value in returns],
        }
        values = {metric: {"mean": 0.0, "interval": None, "values": v} for metric, v in final.items()}
        written = {
            "seeds": list(config.seeds),
            "final": {"greedy": values, "sampled": values},
            "references": REFERENCES,
            "episodes": 320,
            "horizon": config.env.max_cycles,
            "versions": {"gacrl": "0.1.0", "mpe2": "1.1.1", "git_commit": "abc"},
        }
        (folder / "summary.json").write_text(json.dumps({**written, **summary}))
        rows: list[dict[str, Any]] = []
        for step in evaluated_at:
            for k, value in enumerate(returns):
                now = {"return_agent_mean": value - 3 + step / 1000, "coverage_final_0.1": 0.5, "collisions": 1.0}
                rows.append({"seed": seed + k, "env_steps": step, "greedy": now, "sampled": now})
        (folder / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
        return folder

    return make


@pytest.fixture
def refused(capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Compares what cannot be compared, and gives the one sentence."""

    def run(*words: object) -> str:
        capsys.readouterr()
        assert main(["compare", *map(str, words)]) == 2
        said = capsys.readouterr()
        assert said.out == ""
        assert said.err.startswith("gacrl: ")
        assert said.err.count("\n") == 1
        return said.err.removeprefix("gacrl: ").strip()

    return run


HIGH = (-8.0, -7.0, -9.0, -7.5, -8.5)
LOW = (-15.0, -16.0, -14.0, -15.5, -14.5)


def test_runs_that_differ_in_the_seed_alone_are_one_group(make_run: MakeRun):
    paths = [
        make_run("a", VDN, HIGH[3:], seed=3),
        make_run("b", replace(VDN, preset="paper"), HIGH[:3]),
        make_run("c", MAPPO, LOW),
    ]
    paths[1].joinpath("config.json").write_text(configuration.dumps(replace(VDN, num_seeds=3)))
    vdn, mappo = compare(paths).groups
    assert (vdn.name, vdn.seeds, mappo.name) == ("a + b", (0, 1, 2, 3, 4), "c")
    assert vdn.runs == (str(paths[0]), str(paths[1]))
    np.testing.assert_array_equal(vdn.final["return_agent_mean"], HIGH)
    np.testing.assert_array_equal(vdn.along["return_agent_mean"][4], np.array([-10.5, -9.5, -8.5]))


def test_the_numbers_are_those_of_the_statistics(make_run: MakeRun):
    found = compare([make_run("a", VDN, HIGH), make_run("b", MAPPO, LOW)], ["return_agent_mean"])
    assert found.groups[0].estimate("return_agent_mean") == statistics.estimate(HIGH)
    assert found.groups[0].point("return_agent_mean") == -8.0  # without the best and the worst seed
    (pair,) = found.pairs
    assert (pair.a, pair.b, pair.point, pair.verdict, pair.claimed) == ("a", "b", 7.0, "higher", "a")
    assert pair.difference == statistics.difference(HIGH, LOW)
    assert pair.better == (1.0, 1.0, 1.0)
    curve = found.groups[1].curve("return_agent_mean")
    np.testing.assert_allclose(curve.point, [-17.0, -16.0, -15.0])
    np.testing.assert_array_equal(curve, statistics.sample_efficiency(found.groups[1].along["return_agent_mean"]))


def test_where_lower_is_better_the_lower_one_improves(make_run: MakeRun):
    found = compare([make_run("a", VDN, HIGH), make_run("b", MAPPO, LOW)], ["collisions"])
    assert found.pairs[0].verdict == "lower"
    assert found.pairs[0].claimed == "a"


def test_a_margin_tests_for_equivalence(
    make_run: MakeRun, refused: Callable[..., str], capsys: pytest.CaptureFixture[str]
):
    runs = make_run("a", VDN, HIGH), make_run("b", MAPPO, [value + 0.1 for value in HIGH])
    assert refused(*runs, "--margin", 2) == "a margin is in the units of a metric: name one with --metric"
    unusable = (runs[0], "--metric", "return_agent_mean", "--margin", -1)
    assert refused(*unusable) == "the margin of an equivalence must be positive, not -1.0"
    for margin, told in ((2.0, "yes"), (0.2, "not shown")):
        words = ("--metric", "return_agent_mean", "--margin", str(margin), "--json")
        assert main(["compare", *map(str, runs), *words]) == 0
        said = capsys.readouterr().out
        expected = statistics.equivalent(HIGH, np.array(HIGH) + 0.1, margin)
        assert json.loads(said.splitlines()[-1])["pairs"][0]["equivalence"]["p_value"] == pytest.approx(
            expected.p_value
        )
        assert told in said and f"(p={expected.p_value:.2g})" in said
        assert f"\nequivalent within {margin:g}: whether two one-sided tests show" in said, (
            "explained where it stands"
        )


def test_few_seeds_give_no_verdict(make_run: MakeRun):
    found = compare([make_run("a", VDN, HIGH[:2]), make_run("b", MAPPO, LOW[:3])], ["return_agent_mean"])
    assert found.pairs[0].difference is not None
    assert found.pairs[0].difference.low > 0
    assert (found.pairs[0].verdict, found.pairs[0].claimed) == ("too few seeds to tell", None)
    assert "much too narrow to tell groups apart (a 2, b 3)" in " ".join(found.notes)


def test_a_single_seed_is_shown_without_an_interval(make_run: MakeRun):
    found = compare([make_run("a", VDN, HIGH[:1]), make_run("b", MAPPO, LOW)])
    assert found.groups[0].estimate("return_agent_mean") is None
    curve = found.groups[0].curve("return_agent_mean")
    np.testing.assert_array_equal(curve.point, [-10.0, -9.0, -8.0])
    assert np.isnan([curve.low, curve.high]).all()
    assert found.pairs[0] == Pair("a", "b", "return_agent_mean", 7.0, None, None, 1)
    assert "a single seed has no interval: a" in found.notes
    data = to_dict(found)
    assert data["groups"][0]["metrics"]["return_agent_mean"]["interval"] is None
    assert data["pairs"][0]["verdict"] is None


def test_a_score_along_the_way_comes_from_the_references(make_run: MakeRun):
    (group,) = compare([make_run("a", VDN, HIGH)], ["score_return_agent_mean"]).groups
    np.testing.assert_allclose(group.along["score_return_agent_mean"][0], [0.8, 0.85, 0.9])


def noted(found: Comparison) -> str:
    return " ".join(found.notes)


def test_unequal_switches_are_named(make_run: MakeRun):
    graph = replace(VDN.algorithm, augment=True, network=replace(VDN.algorithm.network, torso="graph"))
    other = replace(VDN, algorithm=graph, training=replace(VDN.training, num_envs=8))
    found = compare([make_run("plain", VDN, HIGH), make_run("turned", other, LOW)])
    assert found.unequal_switches == ("algorithm.network.torso", "algorithm.augment")
    assert (
        "settings that a fair comparison has equal (algorithm.network.torso: mlp | graph; algorithm.augment: false | true)"
        in noted(found)
    )
    assert found.config_differences["training.num_envs"] == (32, 8)
    assert [group.name for group in found.groups] == ["plain", "turned"]


def test_what_an_algorithm_lacks_is_no_switch_that_is_on(make_run: MakeRun):
    paper = replace(presets.preset("paper"), env=VDN.env, training=VDN.training, curriculum=VDN.curriculum)
    assert paper.env.reward == "mpe2"
    vdn = replace(VDN, algorithm=replace(VDN.algorithm, n_step=1))
    switches = compare([make_run("a", vdn, HIGH), make_run("b", paper, LOW)]).unequal_switches
    assert "algorithm.augment" not in switches
    assert "algorithm.n_step" not in switches


def names_of(found: Comparison) -> list[str]:
    return [group.name for group in found.groups]


def test_groups_are_named_by_their_folders(make_run: MakeRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """With as much of the path as tells them apart; of many runs the first names the group."""
    other = replace(VDN, algorithm=replace(VDN.algorithm, n_step=1))
    (tmp_path / "old").mkdir()
    (tmp_path / "new").mkdir()
    runs = [make_run("old/vdn", VDN, HIGH), make_run("new/vdn", other, LOW), make_run("mappo-1", MAPPO, HIGH)]
    runs += [make_run(f"mappo-{k}", MAPPO, HIGH, seed=5 * k) for k in (2, 3)]
    assert names_of(compare(runs)) == ["old/vdn", "new/vdn", "mappo-1 + 2 more"]
    monkeypatch.chdir(runs[0])
    assert names_of(compare([Path(), Path("../../new/vdn"), runs[2]])) == ["old/vdn", "new/vdn", "mappo-1"]
    assert names_of(compare([Path()])) == ["vdn"]


def test_labels_name_the_runs_or_the_groups(
    make_run: MakeRun, refused: Callable[..., str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    runs = [make_run("a", VDN, HIGH), make_run("b", MAPPO, LOW), make_run("c", VDN, LOW, seed=5)]
    assert names_of(compare(runs, labels=["VDN", "MAPPO"])) == ["VDN", "MAPPO"]
    assert names_of(compare(runs, labels=["VDN", "MAPPO", "again"])) == ["VDN + again", "MAPPO"]
    words = [*map(str, runs), "--out", str(tmp_path / "page"), "--label", "the best", "--label", "MAPPO", "--json"]
    assert main(["compare", *words]) == 0
    said = capsys.readouterr().out.splitlines()
    assert [group["name"] for group in json.loads(said[-1])["groups"]] == ["the best", "MAPPO"]
    page = (tmp_path / "page" / "comparison.html").read_text(encoding="utf-8")
    assert "<h1>Comparison of the best, MAPPO</h1>" in page
    for figure in (tmp_path / "page" / "comparison-figures").iterdir():
        assert ">the best<" in figure.read_text(encoding="utf-8"), figure.name
    assert refused(*runs, "--label", "x") == (
        "--label has 1 names for 3 runs in 2 groups (a + c; b): give one for each run, or one for each group"
    )
    assert (
        refused(*runs, "--label", "x", "x")
        == "--label 'x' stands for a + c and for b: give each a name of its own"
    )


def test_a_training_horizon_may_differ_where_the_evaluation_is_the_same(make_run: MakeRun):
    long = replace(VDN, env=replace(VDN.env, max_cycles=75), evaluation=replace(VDN.evaluation, horizon=25))
    found = compare([make_run("a", VDN, HIGH), make_run("b", long, LOW, horizon=25)])
    assert "env.max_cycles" in found.unequal_switches


def test_other_measurements_are_noted(make_run: MakeRun):
    run = make_run(
        "b", MAPPO, LOW, episodes=64, versions={"gacrl": "0.2.0", "mpe2": "1.1.1", "git_commit": "abc-dirty"}
    )
    said = noted(compare([make_run("a", VDN, HIGH), run]))
    assert "the closing evaluations have 64 and 320 episodes: not the same starts" in said
    assert "made by different versions of gacrl" in said
    assert f"the sources had changes when {run} ended: no commit has the code that made these numbers" in said
    assert "fewer than 10 seeds a side: this indicates" in said


def test_seeds_evaluated_unequally_often_share_a_curve_where_they_can(make_run: MakeRun):
    runs = [make_run("a", VDN, HIGH), make_run("b", VDN, LOW, seed=5, evaluated_at=(1000, 3000))]
    found = compare(runs)
    assert found.groups[0].evaluated_at == (1000, 3000)
    assert found.groups[0].along["return_agent_mean"].shape == (10, 2)
    assert "3 times: seeds 0, 1, 2, 3, 4; 2 times: seeds 5, 6, 7, 8, 9" in noted(found)
    assert "its curve has 2 points, each over the seeds that trained so far" in noted(found)


def test_a_curve_goes_on_with_the_seeds_that_trained_so_far(make_run: MakeRun):
    """The interval is of those alone, and there is none of a single one; nothing is carried on behind an end."""
    runs = [
        make_run("a", VDN, HIGH[:1], evaluated_at=(1000, 2000, 3000)),
        make_run("b", VDN, HIGH[1:3], seed=1, evaluated_at=(1000, 2000)),
        make_run("c", VDN, HIGH[3:], seed=3, evaluated_at=(1000,)),
    ]
    (group,) = compare(runs).groups
    assert group.evaluated_at == (1000, 2000, 3000)
    assert group.reached().tolist() == [5, 3, 1]
    curve = group.curve("return_agent_mean")
    for k, left in enumerate((HIGH, HIGH[:3])):
        expected = statistics.estimate(np.array(left) - 3 + (k + 1))
        assert (curve.point[k], curve.low[k], curve.high[k]) == pytest.approx(expected)
    assert curve.point[2] == HIGH[0] and np.isnan([curve.low[2], curve.high[2]]).all()
    assert compare([*runs, make_run("d", VDN, HIGH, seed=9, evaluated_at=())]).groups[0].seeds[-1] == 13


# Runs that diverged.


def diverge(
    run: Path, because: str = "seed 3 diverged between environment steps 2000 and 3000: loss is nan"
) -> Path:
    (run / "summary.json").unlink()
    (run / "diverged.json").write_text(json.dumps({"because": because}))
    return run


def test_a_run_that_diverged_says_so_beside_the_others(
    make_run: MakeRun, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    lost = diverge(make_run("wild", MAPPO, LOW, evaluated_at=(1000, 2000)))
    out, table = tmp_path / "page", tmp_path / "values.csv"
    words = ["compare", str(lost), str(make_run("calm", VDN, HIGH)), "--out", str(out), "--csv", str(table)]
    assert main([*words, "--json"]) == 0
    said = capsys.readouterr().out
    data = json.loads(said.splitlines()[-1])
    assert data["groups"][0]["seeds"] == [] and data["groups"][0]["lost_seeds"] == [0, 1, 2, 3, 4]
    assert data["groups"][0]["metrics"]["return_agent_mean"]["point"] is None
    assert data["groups"][0]["metrics"]["return_agent_mean"]["along"][0] == [-17.0, -16.0]
    assert data["pairs"] == []
    note = f"wild diverged and has no closing evaluation ({lost}: seed 3 diverged between environment steps 2000 and 3000"
    assert note in data["notes"][-1]
    assert re.search(r"wild +5 \(5 in a run that diverged\) +diverged +diverged", said)
    page = (out / "comparison.html").read_text(encoding="utf-8")
    assert "Wild diverged and has no closing evaluation" in page and "<td>diverged</td>" in page
    assert ">diverged<" in (out / "comparison-figures" / "return_agent_mean-dots.svg").read_text(encoding="utf-8")
    rows = [line.split(",") for line in table.read_text().splitlines()]
    assert [str(lost), "wild", "4", "2000", "diverged", "return_agent_mean", "nan"] in rows
    seeds = to_marl_eval(compare([Path(word) for word in words[1:3]]))["spread"]["3_agents_25_steps"]
    assert {name: len(runs) for name, runs in seeds.items()} == {"calm": 5}


def test_a_group_that_lost_seeds_says_so_and_is_not_claimed_to_be_better(make_run: MakeRun):
    runs = [make_run("a", VDN, HIGH), make_run("b", MAPPO, LOW)]
    assert compare(runs, ["return_agent_mean"]).pairs[0].claimed == "a"
    more = [*runs, diverge(make_run("c", VDN, [0.0, 0.0], seed=5, evaluated_at=(1000,)))]
    found = compare(more, ["return_agent_mean"])
    assert found.pairs[0].claimed is None
    assert found.groups[0].lost == (5, 6) and found.groups[0].reached().tolist() == [7, 5, 5]
    assert "2 of the 7 seeds of a + c are in a run that diverged" in noted(found)
    swapped = compare([runs[0], runs[1], diverge(make_run("d", MAPPO, [0.0], seed=5))], ["return_agent_mean"])
    assert swapped.pairs[0].claimed == "a", "the worse one lost seeds"


def test_a_run_that_diverged_at_once_or_over_another_horizon_has_no_curve(make_run: MakeRun, tmp_path: Path):
    long = replace(MAPPO, env=replace(MAPPO.env, max_cycles=75))
    runs = [
        make_run("a", VDN, HIGH),
        diverge(make_run("b", long, LOW)),
        diverge(make_run("c", MAPPO, LOW, evaluated_at=())),
    ]
    found = compare(runs)
    assert [group.evaluated_at for group in found.groups] == [EVALUATED_AT, (), ()]
    page = write_page(found, tmp_path / "page", "").read_text(encoding="utf-8")
    assert page.count("Without evaluations along training: b, c.") == 2 * 2, (
        "in text and for screen readers, two metrics"
    )


def test_where_all_diverged_there_is_nothing_to_compare(make_run: MakeRun, refused: Callable[..., str]):
    run = diverge(make_run("a", VDN, HIGH), "loss is nan")
    assert refused(run) == f"none of these runs came to its end: {run}: loss is nan"
    (run / "diverged.json").write_text("{")
    assert refused(run).startswith(f"{run / 'diverged.json'} is damaged")


def test_a_line_that_a_crash_cut_off_is_dropped_with_a_warning(
    make_run: MakeRun, capsys: pytest.CaptureFixture[str]
):
    run = make_run("a", VDN, HIGH)
    metrics = run / "metrics.jsonl"
    metrics.write_text(metrics.read_text()[:-20])
    assert main(["compare", str(run), "--json"]) == 0
    said = capsys.readouterr()
    assert said.err == f"gacrl: the last line of {metrics}, line 15, is cut off: compared without it\n"
    data = json.loads(said.out.splitlines()[-1])
    assert data["groups"][0]["env_steps"] == [1000, 2000, 3000]
    assert data["groups"][0]["metrics"]["return_agent_mean"]["along"][4] == [-10.5, -9.5, None]
    assert "3 times: seeds 0, 1, 2, 3; 2 times: seeds 4" in data["notes"][-1]


def test_marl_eval_has_every_seed(make_run: MakeRun):
    found = compare([make_run("a", VDN, HIGH), make_run("b", MAPPO, LOW[:2])])
    data = to_marl_eval(found)
    assert list(data) == ["spread"] and list(data["spread"]) == ["3_agents_25_steps"]
    runs = data["spread"]["3_agents_25_steps"]
    assert {name: list(seeds) for name, seeds in runs.items()} == {
        "a": [f"seed_{k}" for k in range(5)],
        "b": ["seed_0", "seed_1"],
    }
    *steps, closing = runs["a"]["seed_0"].values()
    assert [step["step_count"] for step in steps] == list(EVALUATED_AT)
    assert [step["return_agent_mean"] for step in steps] == [[-10.0], [-9.0], [-8.0]]
    assert closing["return_agent_mean"] == [-8.0]


# The command.


def test_the_command_prints_and_writes_everything(
    make_run: MakeRun, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    runs = [str(make_run("a", VDN, HIGH)), str(make_run("b", MAPPO, LOW)), str(make_run("c", VDN, [-9.0], seed=9))]
    out, marl = tmp_path / "page", tmp_path / "marl.json"
    words = ["compare", *runs, "--out", str(out), "--marl-eval", str(marl), "--json"]
    assert main(words) == 0
    lines = capsys.readouterr().out.splitlines()
    data = json.loads(lines[-1])
    assert data["groups"][0]["metrics"]["return_agent_mean"]["values"] == [*HIGH, -9.0]
    assert data["references"]["oracle"] == {"return_agent_mean": -6.0, "coverage_final_0.1": 1.0}
    text = "\n".join(lines)
    for said in (
        "Closing evaluations, greedy: 320 episodes of 25 steps",
        "-15.000 [",
        "a + c is better",
        "note: ",
    ):
        assert said in text
    for column in ("first less second", "would show from", "chance first is better", "shown better"):
        assert f"\n{column}: " in text, "explained where it stands"
    page = (out / "comparison.html").read_text(encoding="utf-8")
    assert page.count("<figure class=") == 6
    assert r"-15.000 \[" in (out / "comparison.md").read_text(encoding="utf-8")
    assert {path.stem for path in (out / "comparison-figures").iterdir()} == {
        f"{metric}-{kind}"
        for metric in ("return_agent_mean", "coverage_final_0-1")
        for kind in ("curves", "dots", "profile")
    }
    (runs,) = json.loads(marl.read_text())["spread"].values()
    assert {name: len(seeds) for name, seeds in runs.items()} == {"a + c": 6, "b": 5}

    assert main(words) == 2
    assert f"{out / 'comparison.html'} exists" in capsys.readouterr().err
    assert main([*words, "--overwrite"]) == 0
    assert (out / "comparison.html").read_text(encoding="utf-8") == page


def test_the_table_of_values_is_tidy(make_run: MakeRun, tmp_path: Path):
    """Every metric, not only those compared, at every evaluation and at the end; scores along training as at the end."""
    runs = [make_run("a", VDN, HIGH[:2]), make_run("b", MAPPO, LOW[:1], evaluated_at=(1000,))]
    table = tmp_path / "values.csv"
    words = ["--metric", "collisions", "--csv", str(table), "--label", "VDN, plain", "MAPPO"]
    assert main(["compare", *map(str, runs), *words]) == 0
    with table.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert tuple(rows[0]) == ("run", "label", "seed", "env_steps", "stage", "metric", "value")
    found = {
        (row["run"], row["seed"], int(row["env_steps"]), row["stage"], row["metric"]): float(row["value"])
        for row in rows
    }
    assert len(found) == len(rows) == 2 * (3 * 5 + 4) + (5 + 4)
    a, end = str(runs[0]), VDN.num_updates * VDN.steps_per_update
    assert found[a, "1", 2000, "training", "return_agent_mean"] == -8.0
    assert found[a, "1", 2000, "training", "score_return_agent_mean"] == pytest.approx(0.9)
    assert found[a, "1", end, "closing", "return_agent_mean"] == -7.0
    assert found[a, "1", end, "closing", "collisions"] == 7.0
    assert {row["label"] for row in rows} == {"VDN, plain", "MAPPO"}
    assert main(["compare", *map(str, runs), *words]) == 2, "it exists"


@pytest.mark.parametrize("columns", [40, 60, 80, 130])
def test_no_number_is_cut_on_a_narrow_screen(
    make_run: MakeRun, columns: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    """Every number of the comparison is on some line, whole, and no line is wider than the screen."""
    monkeypatch.setenv("COLUMNS", str(columns))
    runs = [
        make_run(name, config, values) for name, config, values in (("first", VDN, HIGH), ("second", MAPPO, LOW))
    ]
    assert main(["compare", *map(str, runs)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= columns
    text = "\n".join(lines)
    assert "…" not in text
    found = compare(runs)
    for group in found.groups:
        for metric in found.metrics:
            estimate = group.estimate(metric)
            assert estimate is not None and with_interval(estimate) in text
    for pair in found.pairs:
        assert pair.difference is not None and pair.better is not None
        assert with_interval(pair.difference) in text and with_interval(pair.better, ".2f") in text
        assert re.search(rf"(?<![\d.]){pair.difference.detectable:.3f}(?![\d.])", text)


def command(*words: object, **env: str) -> "subprocess.Popen[bytes]":
    """The command in a process of its own, which loads no jax."""
    return subprocess.Popen(
        [sys.executable, "-m", "gacrl", "compare", "--no-replays", *map(str, words)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env={**os.environ, **env},
    )


def test_the_page_survives_output_that_is_ascii_only(make_run: MakeRun, tmp_path: Path):
    runs = make_run("a", VDN, HIGH), make_run("b", MAPPO, LOW)
    done = command(*runs, "--out", tmp_path / "page", "--label", "ε", "b", PYTHONIOENCODING="ascii")
    said, wrong = done.communicate(timeout=60)
    assert (done.returncode, wrong) == (0, b"")
    assert b"| epsilon | 5     | -8.000 [" in said
    assert "ε" in (tmp_path / "page" / "comparison.html").read_text(encoding="utf-8")


def test_the_page_survives_a_closed_pipe(make_run: MakeRun, tmp_path: Path):
    runs = make_run("a", VDN, HIGH), make_run("b", MAPPO, LOW)
    running = command(*runs, "--out", tmp_path / "page", "--csv", tmp_path / "values.csv", PYTHONUNBUFFERED="1")
    assert running.stdout is not None and running.stderr is not None
    running.stdout.close()
    assert (running.stderr.read(), running.wait(timeout=60)) == (b"", 0)
    running.stderr.close()
    assert (tmp_path / "page" / "comparison.html").is_file() and (tmp_path / "values.csv").is_file()


def test_a_comparison_loads_no_more_than_it_needs(make_run: MakeRun):
    """Ten runs take well below three seconds: no jax, no scipy.stats, and matplotlib for a page alone."""
    facts = tasks.find(VDN.task).facts(VDN.env, list(REFERENCES["random"]))
    run = make_run("a", VDN, HIGH, task=facts)
    code = (
        "import sys; from gacrl.cli.main import main; main(sys.argv[1:]);"
        "print([name for name in ('jax', 'scipy.stats', 'scipy.optimize', 'matplotlib') if name in sys.modules])"
    )
    words = [sys.executable, "-c", code, "compare", str(run)]
    done = subprocess.run(words, capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout.splitlines()[-1] == "[]"


def test_the_axes_of_figures_are_words_with_units(make_run: MakeRun, tmp_path: Path):
    facts = tasks.find(VDN.task).facts(VDN.env, list(REFERENCES["random"]))
    run, out = make_run("a", VDN, HIGH, task=facts), tmp_path / "page"
    words = [
        word
        for name in ("return_agent_mean", "coverage_final_0.1", "score_return_agent_mean")
        for word in ("--metric", name)
    ]
    assert main(["compare", str(run), *words, "--out", str(out)]) == 0
    for file, axis in (
        ("return_agent_mean-curves", "return (reward per agent and episode)"),
        ("coverage_final_0-1-profile", "coverage 0.1 (share of landmarks)"),
        ("score_return_agent_mean-dots", "score of return (0: random, 1: oracle)"),
    ):
        assert f">{axis}<" in (out / "comparison-figures" / f"{file}.svg").read_text(encoding="utf-8")
    curves = (out / "comparison-figures" / "return_agent_mean-curves.svg").read_text(encoding="utf-8")
    assert ">environment steps of each seed<" in curves
    assert (
        "The first evaluation is after 1,000 steps: before training there was none."
        in (out / "comparison.md").read_text()
    )


def test_a_page_of_single_seeds(make_run: MakeRun, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    runs = [str(make_run("a", VDN, [-8.0])), str(make_run("b", MAPPO, [-8.0], evaluated_at=()))]
    assert main(["compare", *runs, "--metric", "collisions", "--out", str(tmp_path / "page")]) == 0
    assert "8.000 (one seed: no interval)" in capsys.readouterr().out
    assert (tmp_path / "page" / "comparison.html").read_text(encoding="utf-8").count("<figure class=") == 3


# Refusals.


def env_of(config: RunConfig, **changes: Any) -> RunConfig:
    return replace(config, env=replace(config.env, **changes))


@pytest.mark.parametrize(
    ("config", "summary", "metric", "sentence"),
    [
        (
            env_of(MAPPO, max_cycles=75),
            {},
            "collisions",
            "over 25 steps, .* over 75, and returns .*: --horizon 25 plays",
        ),
        (env_of(MAPPO, num_agents=5), {}, "collisions", "different tasks, env.num_agents is 3 in one and 5"),
        (env_of(MAPPO, arena_scale=2.0), {}, "collisions", "env.arena_scale is 1.0 in one and 2.0"),
        (MAPPO, {"versions": {"mpe2": "1.0.0"}}, "collisions", "measured with MPE2 1.1.1, .* with 1.0.0"),
        (MAPPO, {}, "colisions", "unknown metric 'colisions': did you mean 'collisions'?"),
        (MAPPO, {"seeds": [7]}, "collisions", r"summary.json is damaged: it is of seeds \[7\]"),
        (MAPPO, {"references": None}, "collisions", "summary.json is damaged: it lacks"),
    ],
)
def test_what_cannot_be_compared_is_refused(
    make_run: MakeRun,
    refused: Callable[..., str],
    config: RunConfig,
    summary: dict[str, Any],
    metric: str,
    sentence: str,
):
    runs = [make_run("a", VDN, HIGH), make_run("b", config, LOW, **summary)]
    said = refused(*runs, "--metric", metric)
    assert re.search(sentence, said), said


def test_a_metric_that_settings_define_is_refused_where_they_differ(
    make_run: MakeRun, refused: Callable[..., str]
):
    runs = [make_run("a", VDN, HIGH), make_run("b", env_of(MAPPO, coverage_threshold=0.2), LOW)]
    for run in runs:
        path = run / "summary.json"
        path.write_text(path.read_text().replace('"collisions"', '"reward_shaped"'))
    assert "reward_shaped is measured with env.coverage_threshold, which is 0.5 in" in refused(
        *runs, "--metric", "reward_shaped"
    )


def test_a_seed_counts_once(make_run: MakeRun, refused: Callable[..., str]):
    run = make_run("a", VDN, HIGH)
    assert refused(run, run).startswith(f"seed 0 of the same settings is in {run} and in {run}: ")


def test_a_run_that_has_not_ended_is_refused(make_run: MakeRun, refused: Callable[..., str]):
    run = make_run("a", VDN, HIGH)
    (run / "summary.json").unlink()
    assert refused(run) == f"{run} has not ended, and has no summary.json: `gacrl resume {run}` ends it"
    steps = VDN.num_updates * VDN.steps_per_update
    extended = make_run("b", VDN, HIGH, env_steps=steps - 10)  # its end was moved, and not reached
    assert refused(extended) == (
        f"{extended} has trained {steps - 10} of {steps} environment steps, and was measured then: "
        f"`gacrl resume {extended}` ends it"
    )


@pytest.mark.parametrize(
    ("file", "spoil", "sentence"),
    [
        ("metrics.jsonl", lambda t: t.replace("-9.0", "NaN", 1), "line 2 of {file} has nan as return_agent_mean"),
        (
            "metrics.jsonl",
            lambda t: t.replace("-9.0", "null", 1),
            "line 2 of {file} is not an evaluation with greedy",
        ),
        ("metrics.jsonl", lambda t: "{\n" + t, "line 1 of {file} is damaged: "),
        ("metrics.jsonl", lambda t: "3\n" + t, "line 1 of {file} is damaged: it is not an object"),
        ("metrics.jsonl", lambda t: None, "cannot read {file}: No such file or directory"),
        ("summary.json", lambda t: t.replace("-8.0", "NaN", 1), "{file} has nan as return_agent_mean of seed 0"),
        ("summary.json", lambda t: t.replace("-8.0, ", "", 1), "{file} has no greedy return_agent_mean of seed 4"),
        ("summary.json", lambda t: t[:40], "{file} is damaged: "),
        ("summary.json", lambda t: "[]", "{file} is damaged: "),
        (
            "summary.json",
            lambda t: json.dumps({**json.loads(t), "final": {"greedy": {}, "sampled": None}}),
            "{file} is damaged: it lacks a closing evaluation",
        ),
        ("config.json", lambda t: t[:40], "{file} is not JSON: "),
    ],
)
def test_damage_is_named_by_file_and_line(
    make_run: MakeRun,
    refused: Callable[..., str],
    file: str,
    spoil: Callable[[str], str | None],
    sentence: str,
):
    path = make_run("a", VDN, HIGH) / file
    text = spoil(path.read_text())
    path.unlink()
    if text is not None:
        path.write_text(text)
    assert refused(path.parent).startswith(sentence.format(file=path))


def test_bytes_that_are_no_text_are_refused(make_run: MakeRun, refused: Callable[..., str]):
    run = make_run("a", VDN, HIGH)
    (run / "metrics.jsonl").write_bytes(b"\xff\xfe")
    assert refused(run).startswith(f"a file of {run} is damaged, it is not text")


def test_words_that_make_no_sense(make_run: MakeRun, refused: Callable[..., str], tmp_path: Path):
    assert refused() == "name at least one run folder: `gacrl compare RUN RUN`"
    assert refused(tmp_path / "none").startswith(f"there is no run {tmp_path / 'none'}")
    assert "--metrics" in refused(tmp_path, "--metrics", "x")
    run = make_run("a", VDN, HIGH)
    (tmp_path / "file").touch()
    assert (
        refused(run, "--marl-eval", tmp_path / "file")
        == f"{tmp_path / 'file'} exists: choose another place, or say --overwrite"
    )
