"""`gacrl compare` on small run folders made by hand: what is grouped, computed, noted and refused."""

import json
import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gacrl.cli.main import main
from gacrl.config import files as configuration
from gacrl.config import presets
from gacrl.config.run import RunConfig
from gacrl.evaluation import statistics
from gacrl.experiments.compare.compare import Comparison, Pair, compare
from gacrl.experiments.compare.data import to_dict, to_marl_eval
from gacrl.experiments.compare.marl_eval import from_marl_eval

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
    assert (vdn.name, vdn.seeds, mappo.name) == ("vdn", (0, 1, 2, 3, 4), "mappo")
    assert vdn.runs == (str(paths[0]), str(paths[1]))
    np.testing.assert_array_equal(vdn.final["return_agent_mean"], HIGH)
    np.testing.assert_array_equal(vdn.along["return_agent_mean"][4], np.array([-10.5, -9.5, -8.5]))


def test_the_numbers_are_those_of_the_statistics(make_run: MakeRun):
    found = compare([make_run("a", VDN, HIGH), make_run("b", MAPPO, LOW)], ["return_agent_mean"])
    assert found.groups[0].estimate("return_agent_mean") == statistics.estimate(HIGH)
    assert found.groups[0].point("return_agent_mean") == -8.0  # without the best and the worst seed
    (pair,) = found.pairs
    assert (pair.a, pair.b, pair.point, pair.verdict, pair.claimed) == ("vdn", "mappo", 7.0, "higher", "vdn")
    assert pair.difference == statistics.difference(HIGH, LOW)
    assert pair.better == (1.0, 1.0, 1.0)
    curve = found.groups[1].curve("return_agent_mean")
    assert curve is not None
    np.testing.assert_allclose(curve.point, [-17.0, -16.0, -15.0])


def test_where_lower_is_better_the_lower_one_improves(make_run: MakeRun):
    found = compare([make_run("a", VDN, HIGH), make_run("b", MAPPO, LOW)], ["collisions"])
    assert found.pairs[0].verdict == "lower"
    assert found.pairs[0].claimed == "vdn"


def test_a_margin_tests_for_equivalence(
    make_run: MakeRun, refused: Callable[..., str], capsys: pytest.CaptureFixture[str]
):
    runs = make_run("a", VDN, HIGH), make_run("b", MAPPO, [value + 0.1 for value in HIGH])
    assert refused(*runs, "--margin", 2) == "a margin is in the units of a metric: name one with --metric"
    unusable = (runs[0], "--metric", "return_agent_mean", "--margin", -1)
    assert refused(*unusable) == "the margin of an equivalence must be positive, not -1.0"
    for margin, told in (
        (2.0, "; equivalent within 2 (p = "),
        (0.2, "; not shown to be equivalent within 0.2 (p = "),
    ):
        words = ("--metric", "return_agent_mean", "--margin", str(margin), "--json")
        assert main(["compare", *map(str, runs), *words]) == 0
        said = capsys.readouterr().out
        expected = statistics.equivalent(HIGH, np.array(HIGH) + 0.1, margin)
        assert json.loads(said.splitlines()[-1])["pairs"][0]["equivalence"]["p_value"] == pytest.approx(
            expected.p_value
        )
        assert told.strip("; ").split(" (")[0] in " ".join(said.split())


def test_few_seeds_give_no_verdict(make_run: MakeRun):
    found = compare([make_run("a", VDN, HIGH[:2]), make_run("b", MAPPO, LOW[:3])], ["return_agent_mean"])
    assert found.pairs[0].difference is not None
    assert found.pairs[0].difference.low > 0
    assert (found.pairs[0].verdict, found.pairs[0].claimed) == ("too few seeds to tell", None)
    assert "much too narrow to tell groups apart (vdn 2, mappo 3)" in " ".join(found.notes)


def test_a_single_seed_is_shown_without_an_interval(make_run: MakeRun):
    found = compare([make_run("a", VDN, HIGH[:1]), make_run("b", MAPPO, LOW)])
    assert found.groups[0].estimate("return_agent_mean") is None
    assert found.groups[0].curve("return_agent_mean") is None
    assert found.pairs[0] == Pair("vdn", "mappo", "return_agent_mean", 7.0, None, None, 1)
    assert "a single seed has no interval: vdn" in found.notes
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
        "not at equal switches (algorithm.network.torso: mlp | graph; algorithm.augment: false | true)"
        in noted(found)
    )
    assert found.config_differences["training.num_envs"] == (32, 8)
    assert [group.name for group in found.groups] == ["vdn, plain", "vdn, turned"]


def test_what_an_algorithm_lacks_is_no_switch_that_is_on(make_run: MakeRun):
    paper = replace(presets.preset("paper"), env=VDN.env, training=VDN.training, curriculum=VDN.curriculum)
    assert paper.env.reward == "mpe2"
    vdn = replace(VDN, algorithm=replace(VDN.algorithm, n_step=1))
    switches = compare([make_run("a", vdn, HIGH), make_run("b", paper, LOW)]).unequal_switches
    assert "algorithm.augment" not in switches
    assert "algorithm.n_step" not in switches


def test_groups_are_named_by_what_sets_them_apart(make_run: MakeRun):
    other = replace(VDN, algorithm=replace(VDN.algorithm, n_step=1))
    found = compare([make_run("a", VDN, HIGH), make_run("b", other, LOW)])
    assert [group.name for group in found.groups] == ["vdn, n step 3", "vdn, n step 1"]


def test_a_training_horizon_may_differ_where_the_evaluation_is_the_same(make_run: MakeRun):
    long = replace(VDN, env=replace(VDN.env, max_cycles=75), evaluation=replace(VDN.evaluation, horizon=25))
    found = compare([make_run("a", VDN, HIGH), make_run("b", long, LOW, horizon=25)])
    assert "env.max_cycles" in found.unequal_switches


def test_other_measurements_are_noted(make_run: MakeRun):
    run = make_run("b", MAPPO, LOW, episodes=64, versions={"gacrl": "0.2.0", "mpe2": "1.1.1"})
    said = noted(compare([make_run("a", VDN, HIGH), run]))
    assert "the closing evaluations have 64 and 320 episodes: not the same starts" in said
    assert "made by different versions of gacrl" in said
    assert "fewer than 10 seeds a side: this indicates" in said


def test_seeds_evaluated_unequally_often_share_a_curve_where_they_can(make_run: MakeRun):
    runs = [make_run("a", VDN, HIGH), make_run("b", VDN, LOW, seed=5, evaluated_at=(1000, 3000))]
    found = compare(runs)
    assert found.groups[0].evaluated_at == (1000, 3000)
    assert found.groups[0].along["return_agent_mean"].shape == (10, 2)
    assert "3 times: seeds 0, 1, 2, 3, 4; 2 times: seeds 5, 6, 7, 8, 9" in noted(found)
    assert "its curve is over the 2 environment steps that all its seeds share" in noted(found)


def test_a_line_that_a_crash_cut_off_is_dropped_with_a_warning(
    make_run: MakeRun, capsys: pytest.CaptureFixture[str]
):
    run = make_run("a", VDN, HIGH)
    metrics = run / "metrics.jsonl"
    metrics.write_text(metrics.read_text()[:-20])
    assert main(["compare", str(run), "--json"]) == 0
    said = capsys.readouterr()
    assert said.err == f"gacrl: the last line of {metrics}, line 15, is cut off: compared without it\n"
    assert json.loads(said.out.splitlines()[-1])["groups"][0]["env_steps"] == [1000, 2000]


def test_marl_eval_has_every_seed(make_run: MakeRun):
    found = compare([make_run("a", VDN, HIGH), make_run("b", MAPPO, LOW[:2])])
    runs = from_marl_eval(to_marl_eval(found))
    assert [(run.algorithm, run.run) for run in runs[4:6]] == [("vdn", "seed_4"), ("mappo", "seed_0")]
    assert {(run.environment, run.task) for run in runs} == {("spread", "3_agents_25_steps")}
    assert runs[0].env_steps == list(EVALUATED_AT)
    assert runs[0].metrics["return_agent_mean"] == [[-10.0], [-9.0], [-8.0]]
    assert runs[0].absolute["return_agent_mean"] == [-8.0]


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
    for said in ("Closing evaluations, greedy: 320 episodes of 25 steps", "-15.000 [", "higher", "note: "):
        assert said in text
    page = (out / "comparison.html").read_text(encoding="utf-8")
    assert page.count("<figure>") == 6
    assert r"-15.000 \[" in (out / "comparison.md").read_text(encoding="utf-8")
    assert {path.stem for path in (out / "comparison-figures").iterdir()} == {
        f"{metric}-{kind}"
        for metric in ("return_agent_mean", "coverage_final_0-1")
        for kind in ("curves", "dots", "profile")
    }
    assert len(from_marl_eval(json.loads(marl.read_text()))) == 11

    assert main(words) == 2
    assert f"{out / 'comparison.html'} exists" in capsys.readouterr().err
    assert main([*words, "--overwrite"]) == 0
    assert (out / "comparison.html").read_text(encoding="utf-8") == page


def test_a_page_of_single_seeds(make_run: MakeRun, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    runs = [str(make_run("a", VDN, [-8.0])), str(make_run("b", MAPPO, [-8.0], evaluated_at=()))]
    assert main(["compare", *runs, "--metric", "collisions", "--out", str(tmp_path / "page")]) == 0
    assert "8.000 (one seed: no interval)" in capsys.readouterr().out
    assert (tmp_path / "page" / "comparison.html").read_text(encoding="utf-8").count("<figure>") == 3


# Refusals.


def env_of(config: RunConfig, **changes: Any) -> RunConfig:
    return replace(config, env=replace(config.env, **changes))


@pytest.mark.parametrize(
    ("config", "summary", "metric", "sentence"),
    [
        (env_of(MAPPO, max_cycles=75), {}, "collisions", "evaluated over 25 steps, .* over 75, and returns"),
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
