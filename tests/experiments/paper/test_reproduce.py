"""`gacrl reproduce`: verdicts on made-up data with known answers, a report that has every claim, runs that resume."""

import html
import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gacrl import tasks
from gacrl.algorithms.actions import choices
from gacrl.cli.main import main
from gacrl.config import presets
from gacrl.config.presets import GACRL_PARAMETERS
from gacrl.config.run import CurriculumConfig
from gacrl.experiments.paper import claims as claim_data
from gacrl.experiments.paper import reproduce
from gacrl.experiments.paper import tables as paper_tables
from gacrl.experiments.paper import verdicts as comparisons
from gacrl.experiments.paper.claims import Claim, Reading, claims, measures
from gacrl.experiments.paper.evidence import Evidence, Reference, Series, blocks
from gacrl.experiments.paper.reproduce import at_paper_budget, plan
from gacrl.experiments.paper.verdicts import judge, judge_all
from gacrl.experiments.study import Planned
from gacrl.networks.agent import acting_parameters, matched
from gacrl.tasks.spread.settings import METRICS, SpreadSettings
from gacrl.training.recorder import RunFolder

pytestmark = [pytest.mark.usefixtures("quick_start"), pytest.mark.xdist_group("runs")]

SEEDS, STRETCHES = 5, 30
FOUR = ("GACRL", "QMIX", "MAPPO", "IPPO")
RANDOM = {  # as a random policy scores, rounded
    "reward_shaped": (9.0, 3.6),
    "reward_raw": (-1.25, 0.35),
    "distance_agent_landmark": (1.02, 0.3),
    "distance_landmark_agent": (0.83, 0.2),
    "coverage_mean_0.1": (0.011, 0.016),
}
ORACLE = {"reward_shaped": (34.0, 2.0), "reward_raw": (-0.13, 0.05), "distance_agent_landmark": (0.1, 0.08)}


def levels(base: Mapping[str, tuple[float, float]] = RANDOM) -> dict[str, tuple[float, float]]:
    """(mean, standard deviation of an episode) of every metric."""
    return {**dict.fromkeys(METRICS, (0.1, 0.05)), **RANDOM, **base}


def series(shift: Mapping[str, float] | None = None, preset: str = "paper") -> Series:
    """Seeds that score what random does, plus the shift, in every stretch and evaluation."""
    shift, jitter = shift or {}, np.linspace(-0.02, 0.02, SEEDS)
    center = {name: mean + shift.get(name, 0.0) for name, (mean, _) in levels().items()}
    seen = {name: np.outer(mean + jitter * levels()[name][1], np.ones(STRETCHES)) for name, mean in center.items()}
    sd = {name: np.full((SEEDS, STRETCHES), spread) for name, (_, spread) in levels().items()}
    final = {name: values[:, -1] for name, values in seen.items()}
    return Series(
        config=replace(reproduce.in_column(at_paper_budget(preset), "paper"), num_seeds=SEEDS),
        episodes=50 * np.arange(1, STRETCHES + 1),
        counted=np.full(STRETCHES, 50),
        mean=seen,
        sd=sd,
        last=seen,
        tasks=({"local_ratio": 0.5, "coverage_threshold": 0.5},) * STRETCHES,
        final={"greedy": final, "sampled": final},
        scripted={},
        seconds=300.0,
    )


def played(base: Mapping[str, tuple[float, float]], seed: int = 0) -> dict[str, np.ndarray]:
    """320 episodes of a scripted policy, with exactly that mean."""
    rng = np.random.default_rng(seed)
    drawn = {name: (mean, spread, rng.normal(size=320)) for name, (mean, spread) in levels(base).items()}
    return {name: mean + spread * (noise - noise.mean()) for name, (mean, spread, noise) in drawn.items()}


def made_up(shifts: Mapping[str, Mapping[str, float]] | None = None) -> Evidence:
    """Four algorithms that differ from random by a shift each; noop is as random."""
    shifts = shifts or {}
    references = {who: played(base) for who, base in (("random", RANDOM), ("noop", RANDOM), ("oracle", ORACLE))}
    return Evidence(
        {(column, who): series(shifts.get(who)) for column in ("paper", "mpe2") for who in FOUR},
        {
            (column, who): Reference((episodes,) * STRETCHES, episodes)
            for column in ("paper", "mpe2")
            for who, episodes in references.items()
        },
    )


def ask(kind: str, evidence: Evidence, reading: Reading | None = None, **settings: Any) -> str:
    claim = Claim("it", "I", "so it is", kind, settings, ())
    return comparisons.KINDS[kind](claim, reading or Reading(), evidence).verdict


# Verdicts


@pytest.mark.parametrize(
    ("gacrl", "others", "verdict"),
    [
        (10.0, 5.0, "holds"),
        (5.0, 10.0, "does not hold"),
        (0.0, 0.0, "cannot be told apart from random"),
        (5.0, 5.0, "cannot be decided with these seeds"),
    ],
)
def test_an_order_holds_when_every_interval_is_on_its_side(gacrl: float, others: float, verdict: str):
    evidence = made_up({"GACRL": {"reward_shaped": gacrl}, "QMIX": {"reward_shaped": others}})
    assert ask("order", evidence, measure="shaped", better_than=["QMIX"]) == verdict


def test_an_order_minds_which_way_is_better_and_who_is_said_to_be_ahead():
    evidence = made_up({"GACRL": {"distance_agent_landmark": -0.3}, "MAPPO": {"distance_agent_landmark": -0.5}})
    assert ask("order", evidence, measure="distance", better_than=["QMIX"], worse_than=["MAPPO"]) == "holds"
    assert ask("order", evidence, measure="distance", better_than=["QMIX", "MAPPO"]) == "does not hold"
    assert ask("order", evidence, measure="distance", better_than=["QMIX"], worse_than=["IPPO"]) == "does not hold"


@pytest.mark.parametrize(
    ("gacrl", "verdict"),
    [(9.0, "holds"), (4.0, "does not hold"), (0.0, "does not hold")],
)
def test_competitive_is_behind_by_no_more_than_the_margin(gacrl: float, verdict: str):
    """The margin is a tenth of the 25 from random to the oracle."""
    evidence = made_up({"GACRL": {"reward_shaped": gacrl}, "QMIX": {"reward_shaped": 10.0}})
    assert ask("competitive", evidence, measure="shaped", others=["QMIX"], margin=0.1) == verdict


def test_competitive_with_others_that_do_as_random_does_is_no_merit():
    assert ask("competitive", made_up(), measure="shaped", others=["QMIX"], margin=0.1) == (
        "cannot be told apart from random"
    )


@pytest.mark.parametrize(("other", "verdict"), [(0.05, "holds"), (0.4, "does not hold")])
def test_similar_is_an_equivalence_test(other: float, verdict: str):
    """The margin is a tenth of the 1.12 from random to the oracle."""
    evidence = made_up({"QMIX": {"reward_raw": other}})
    assert ask("similar", evidence, measure="raw", others=["QMIX"], margin=0.1) == verdict


@pytest.mark.parametrize(
    ("printed", "verdict"),
    [
        (9.5, "cannot be told apart from random"),  # random's 50-episode means: 9.0 ± 1.0
        (19.0, "holds"),  # what QMIX does here
        (14.0, "not reproducible"),
    ],
)
def test_a_printed_mean_is_sought_in_random_and_in_ours(printed: float, verdict: str):
    evidence = made_up({"QMIX": {"reward_shaped": 10.0}})
    assert ask("value", evidence, cells=[["QMIX", "shaped", printed]]) == verdict


def test_an_interval_that_has_all_of_randoms_decides_nothing():
    """One seed that ran away makes the next one's interval so wide that any printed number is in it."""
    evidence = made_up()
    ran_away = evidence.trained("paper", "QMIX")
    for metrics in (ran_away.mean, ran_away.final["greedy"]):
        metrics["reward_shaped"][0] -= 200.0
    assert ask("value", evidence, cells=[["QMIX", "shaped", 30.0]]) == "cannot be decided with these seeds"


def test_a_row_of_table_2_is_one_episode_or_the_mean_of_fifty():
    """13.42 and 0.73 are ordinary single episodes of random, and no means of 50; −0.08 is neither."""
    evidence = made_up()
    claim = next(claim for claim in claims() if claim.id == "table-2-50")
    judged = judge(claim, evidence)
    assert judged.base.verdict == "not reproducible"
    assert "shaped reward 13.42" in judged.base.because
    sayings = [part for part in judged.base.because.split("; ") if "neither" in part]
    assert [part.split()[1:3] for part in sayings] == [["raw", "reward"]]
    stretch = next(outcome for outcome in judged.alternatives if outcome.reading.row == "stretch")
    assert sum("neither" in part for part in stretch.because.split("; ")) > 1


def test_an_episode_that_was_not_logged_is_not_tested():
    claim = Claim("it", "I", "so", "value", {"episode": 75}, ())
    assert judge(claim, made_up()).base.verdict == "not tested here"


def test_a_peak_is_beside_the_best_of_as_many_lines_of_random():
    """The best of 30 episodes of random: about 9 + 2 × 3.6 = 16.3."""
    evidence = made_up()
    low, high = comparisons.best_of_random(measures()["shaped"], Reading(), evidence)
    assert 13 < low < 16.3 < high < 22
    settings = {"measure": "shaped", "episode": 1400}
    assert ask("peak", evidence, printed=17.65, **settings) == "cannot be told apart from random"
    assert ask("peak", evidence, printed=30.0, **settings) == "not reproducible"
    assert ask("peak", made_up({"GACRL": {"reward_shaped": 21.0}}), printed=30.0, **settings) == "holds"
    assert ask("peak", evidence, Reading(row="stretch"), printed=17.65, **settings) == "not reproducible"
    low, high = comparisons.best_of_random(measures()["distance"], Reading(), evidence)
    assert low < 0.45 < high < 0.8, "the best distance is the smallest"


@pytest.mark.parametrize(
    ("late", "direction", "verdict"),
    [
        (3.0, "better", "holds"),
        (-3.0, "better", "does not hold"),
        (0.0, "better", "cannot be told apart from random"),
        (-3.0, "worse", "holds"),
        (-3.0, "not worse", "does not hold"),
        (0.0, "not worse", "holds"),
    ],
)
def test_a_trend_is_what_random_does_not_show(late: float, direction: str, verdict: str):
    """The task grows harder by 2 on the way, for random too."""
    evidence, harder = made_up(), np.linspace(0.0, -2.0, STRETCHES)
    own = evidence.series["paper", "GACRL"]
    curve = own.mean["reward_shaped"] + harder + late * np.linspace(0.0, 1.0, STRETCHES)
    curve += np.linspace(-0.01, 0.01, SEEDS)[:, None] * np.linspace(-1.0, 1.0, STRETCHES)
    random = evidence.references["paper", "random"]
    moved = tuple(
        {**episodes, "reward_shaped": episodes["reward_shaped"] + drop}
        for episodes, drop in zip(random.stretches, harder, strict=True)
    )
    evidence = replace(
        evidence,
        series={**evidence.series, ("paper", "GACRL"): replace(own, mean={**own.mean, "reward_shaped": curve})},
        references={**evidence.references, ("paper", "random"): replace(random, stretches=moved)},
    )
    settings = {"measure": "shaped", "from": 0.0, "direction": direction, "margin": 0.1}
    assert ask("trend", evidence, **settings) == verdict


def test_raw_rewards_that_no_positions_give():
    """Within θ of the moment, three rows of Table II are impossible; within 0.1 the first one is."""
    claim = next(claim for claim in claims() if claim.kind == "possible")
    judged = judge(claim, made_up())
    assert judged.base.verdict == "not reproducible"
    assert [
        episode for episode in (50, 350, 650, 950, 1250, 1500) if f"episode {episode}:" in judged.base.because
    ] == [
        50,
        350,
        650,
    ]
    assert "at most -0.67, printed -0.08" in judged.base.because  # 0.5 · 3 · (1 − 0.085) · 0.49
    (within,) = judged.alternatives
    assert within.because == "raw rewards that no positions give: episode 50: at most -0.14, printed -0.08"


def test_what_the_paper_itself_decides():
    evidence = made_up()
    assert ask("formula", evidence, near=0.0, far=5.0, theta=0.5) == "does not hold"  # 13 and 22.5
    assert ask("formula", evidence, near=0.0, far=2.0, theta=0.5) == "holds"
    assert ask("stated_once", evidence, stated={"here": [0.5, 0.5], "there": [0.5, 0.2]}) == "does not hold"
    assert ask("stated_once", evidence, stated={"here": [0.5, 0.2], "there": [0.5, 0.2]}) == "holds"
    assert ask("duration", evidence, hours=4.0) == "not reproducible"  # 300 s for five seeds
    assert ask("duration", evidence, hours=1 / 60) == "holds"
    assert ask("elsewhere", evidence, reason="not here") == "not tested here"
    claim = next(claim for claim in claims() if claim.id == "highest-shaped")
    assert comparisons.in_print(claim) == "no: GACRL is number 3 of 4 in Table III"


# Readings


def test_a_reading_changes_who_is_compared_how():
    """GACRL is ahead on the paper's reward alone; on MPE2's it diverged; mixed, it meets the others' MPE2 runs."""
    evidence = made_up({"GACRL": {"reward_shaped": 10.0}, "QMIX": {"reward_shaped": 5.0}})
    trained = {**evidence.series, ("mpe2", "QMIX"): series({"reward_shaped": 20.0})}
    del trained["mpe2", "GACRL"]
    evidence = replace(evidence, series=trained, diverged={("mpe2", "GACRL"): "loss is nan by step 9"})
    claim = Claim(
        "it",
        "I",
        "so",
        "order",
        {"measure": "shaped", "better_than": ["QMIX"]},
        (Reading(column="mpe2"), Reading(column="mixed", play="sampled"), Reading(play="greedy")),
    )
    judged = judge(claim, evidence)
    assert judged.base.verdict == "holds"
    assert [outcome.verdict for outcome in judged.alternatives] == ["not reproducible", "does not hold", "holds"]
    assert "GACRL diverged on MPE2's reward: loss is nan by step 9" in judged.alternatives[0].because
    assert judged.hangs_on == judged.alternatives[:2]


def test_a_swapped_measure_is_a_weighted_sum_of_metrics():
    """−r·(collisions) − (1 − r)·3·(distance from landmarks), from the same reward at r = 0.5."""
    collisions, distance = 0.3, 0.8
    metrics = {
        "reward_raw": np.array(-0.5 * collisions - 1.5 * distance),
        "distance_landmark_agent": np.array(distance),
    }
    measure = Reading(swap=("raw", "raw_end")).measure("raw")
    total = sum(weight * float(metrics[name]) for name, weight in measure.weights.items())
    assert total == pytest.approx(-0.1 * collisions - 0.9 * 3 * distance)
    assert Reading(swap=("raw", "raw_end")).measure("shaped") == measures()["shaped"]


def test_the_claims_are_sound_data():
    assert len({claim.id for claim in claims()}) == len(claims()) > 35
    for claim in claims():
        assert claim.kind in comparisons.KINDS
        for reading in claim.readings:
            assert reading != Reading()
            assert reading.describe() != Reading().describe()
            if reading.swap:
                assert set(reading.swap) <= set(measures())
    assert {name for measure in measures().values() for name in measure.weights} <= set(METRICS)
    assert all(entry["setting"] and entry["place"] for entry in claim_data.untrained())
    verdicts = {judged.claim.id: judged.base.verdict for judged in judge_all(made_up())}
    assert verdicts["table-3-gacrl"] == "cannot be told apart from random"
    assert "cannot be decided with these seeds" not in verdicts.values(), "all do here what random does"


# The runs


def test_every_run_has_the_papers_steps_and_logs_each_50_episodes(tmp_path: Path):
    runs = plan(tmp_path, seeds=5)
    assert len(runs) == 8
    for (column, _), run in runs.items():
        config = run.config
        assert config.num_updates * config.steps_per_update == 112_500
        assert config.updates_per_chunk * config.steps_per_update == 3_750
        assert (config.env.max_cycles, config.num_seeds) == (75, 5)
        moves = config.env.local_ratio_end is not None and config.env.coverage_threshold_end is not None
        assert moves == (config.env == presets.preset("paper").env) == (column == "paper")
    gacrl = {run.config.algorithm for (_, who), run in runs.items() if who == "GACRL"}
    assert gacrl == {presets.preset("paper").algorithm}


def test_the_extended_runs_differ_by_the_algorithm_alone(tmp_path: Path):
    runs = {
        who: run.config for (column, who), run in plan(tmp_path, 5, extended=True).items() if column == "extended"
    }
    assert set(runs) == {"GACRL", "QMIX", "VDN", "MAPPO", "IPPO"}
    sizes: list[int] = []
    for config in runs.values():
        algorithm: Any = config.algorithm
        assert (config.env, config.curriculum, config.seeds) == (
            SpreadSettings(reward="coverage"),
            CurriculumConfig(),
            (0, 1, 2, 3, 4),
        )
        assert config.num_updates * config.steps_per_update == 150_000
        assert (algorithm.network.torso, algorithm.augment, algorithm.symmetric_play) == ("graph", True, False)
        env = tasks.find(config.task).make(config.env)
        num_actions = choices(env).size
        sizes.append(acting_parameters(env, matched(env, algorithm.network, num_actions), num_actions))
    assert sizes[0] == GACRL_PARAMETERS
    assert max(sizes) < 1.06 * min(sizes)


def test_blocks_are_means_of_fifty_episodes_or_of_halves():
    np.testing.assert_allclose(blocks(np.arange(320.0)), 24.5 + 50 * np.arange(6))
    np.testing.assert_allclose(blocks(np.array([1.0, 3.0, 5.0, 9.0, 100.0])), [2.0, 7.0])


def test_the_last_fifty_episodes_are_pooled_from_as_many_stretches_as_hold_them():
    seen = series()
    mean, sd, count = seen.closing
    assert count == 50
    np.testing.assert_allclose(mean["reward_shaped"], seen.mean["reward_shaped"][:, -1])
    shorter = replace(
        seen,
        episodes=np.array([45, 75]),
        counted=np.array([45, 30]),
        mean={"m": np.array([[0.0, 5.0]])},
        sd={"m": np.array([[1.0, 2.0]])},
    )
    mean, sd, count = shorter.closing
    assert count == 75
    assert mean["m"] == pytest.approx([2.0])  # (45 · 0 + 30 · 5) / 75
    assert sd["m"] == pytest.approx([np.sqrt((45 * 1 + 30 * (4 + 25)) / 75 - 4)])


# The whole command, on runs that are there already


def pretend(run: Planned, shift: float) -> None:
    """A finished run folder of made-up numbers."""
    folder = RunFolder.create(run.folder, run.config)
    seen = series({"reward_shaped": shift})
    rows = [
        {
            "seed": seed,
            "env_steps": 3_750 * (k + 1),
            "episodes_done": 50 * (k + 1),
            "train": {
                "episodes": 50,
                **{
                    what: {name: float(values[member, k]) for name, values in getattr(seen, source).items()}
                    for what, source in (("mean", "mean"), ("sd", "sd"), ("last_episode", "last"))
                },
            },
            "task": seen.tasks[k],
        }
        for k in range(STRETCHES)
        for member, seed in enumerate(run.config.seeds)
    ]
    folder.append_metrics(rows)
    members = len(run.config.seeds)
    final = {
        name: {"values": [float(v) for v in values[:members]]} for name, values in seen.final["greedy"].items()
    }
    scripted = {who: dict.fromkeys(final, 0.0) for who in ("random", "noop", "oracle")}
    folder.write_summary(
        {"final": {"greedy": final, "sampled": final}, "references": scripted, "wall_seconds": 60.0}
    )


def test_the_command_writes_a_report_that_has_every_claim(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    played_by = {"random": played(RANDOM), "noop": played(RANDOM), "oracle": played(ORACLE)}
    monkeypatch.setattr(paper_tables, "_play_scripted", lambda name, *task: played_by[name])
    out = tmp_path / "out"
    out.mkdir()
    (out / "reproduce.json").write_text('{"seeds": 2, "episodes": 1500}', encoding="utf-8")
    for (column, who), run in plan(out, seeds=2, extended=True).items():
        if (column, who) == ("mpe2", "GACRL"):
            RunFolder.create(run.folder, run.config).write_diverged("loss is nan")
        else:
            pretend(run, 5.0 if who == "MAPPO" else 0.0)
    assert main(["reproduce", "--seeds", "2", "--extended", "--out", str(out), "--json"]) == 0
    said = capsys.readouterr().out.splitlines()
    assert any(line.endswith("GACRL, the paper's reward: there already") for line in said)
    answer = json.loads(said[-1])
    assert answer["claims"]["superior-shaped"] == "does not hold"  # MAPPO is ahead
    assert list(answer["claims"]) == [claim.id for claim in claims()]
    page = Path(answer["report"]).read_text(encoding="utf-8")
    for claim in claims():
        assert html.escape(claim.quote) in page
    for text in (
        "were chosen because they fit",
        "GACRL diverged when trained on MPE2&#x27;s reward (loss is nan)",
        "16 of the 16 printed means",
        "env.reset_on_collision",
        "The same with equal switches",
        "17.65, 0.16, 0.6",
    ):
        assert text in page, text
    assert page.count("<figure>") > 10
    assert "does not hold" in (out / "report.md").read_text(encoding="utf-8")
    results = json.loads((out / "results.json").read_text(encoding="utf-8"))
    assert [entry["id"] for entry in results] == [claim.id for claim in claims()]
    assert all(len(entry["readings"]) == len(c.readings) for entry, c in zip(results, claims(), strict=True))


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--seeds", "1"], "--seeds must be at least 2, not 1: with one there is no interval over seeds"),
        (["--episodes", "0"], "--episodes must be at least 1, not 0"),
        (["--out", "{tmp}/other"], "{tmp}/other exists and holds no reproduction: choose another --out"),
        (["--out", "{tmp}/mine"], "{tmp}/mine holds a reproduction with --seeds 3 and --episodes 9: ask for the same, or choose another --out"),
        (["--out", "{tmp}/cut"], "{tmp}/cut/reproduce.json is damaged: choose another --out"),
        (["--seed", "3"], "unrecognized option --seed: did you mean --seeds?"),
    ],
)  # fmt: skip
def test_mistakes_end_in_one_sentence(
    words: list[str], sentence: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "letter.txt").write_text("dear", encoding="utf-8")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "reproduce.json").write_text('{"seeds": 3, "episodes": 9}', encoding="utf-8")
    (tmp_path / "cut").mkdir()
    (tmp_path / "cut" / "reproduce.json").write_text('{"seeds": 3', encoding="utf-8")
    words = [word.format(tmp=tmp_path) for word in words]
    where = [] if "--out" in words else ["--out", str(tmp_path / "new")]
    assert main(["reproduce", *words, *where]) == 2
    assert capsys.readouterr().err == f"gacrl: {sentence.format(tmp=tmp_path)}\n"


def test_a_run_with_other_settings_is_not_mixed_in(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    out = tmp_path / "out"
    out.mkdir()
    (out / "reproduce.json").write_text('{"seeds": 2, "episodes": 1500}', encoding="utf-8")
    run = list(plan(out, seeds=2).values())[3]
    RunFolder.create(run.folder, replace(run.config, seed=4))
    assert main(["reproduce", "--seeds", "2", "--out", str(out)]) == 2
    assert f"{run.folder} was trained with other settings than this version plans" in capsys.readouterr().err
