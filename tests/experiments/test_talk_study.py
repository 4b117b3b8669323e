"""`gacrl talk` without a task: who learns, scores by hand, resumption, and learners that were trained before."""

import html
import json
import shlex
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from gacrl import tasks
from gacrl.cli.main import main
from gacrl.config import files as configuration
from gacrl.config.run import RunConfig
from gacrl.experiments import scoring, talk
from gacrl.experiments.talking import cells, kinds, known
from gacrl.experiments.talking import study as of_all
from gacrl.tasks import own
from gacrl.tasks.task import HEADLINE
from gacrl.training import session
from gacrl.training.divergence import Diverged
from gacrl.training.recorder import RunFolder
from gacrl.training.watching import Watcher

PRESET = configuration.preset("gacrl")
CASE = tasks.find("reference").cases["reference"]
STEPS = (100, 200, 300, 400)
RETURNS = {"none": -18.0, "told": -8.0, "discrete": -9.0, "tarmac": -30.0}
"""Of the learners, by their messages: the seeds lie around it by 0.1."""
ROOT = Path(__file__).parents[2]
KNOWN = ROOT / "docs" / "data" / "talk-reference-study.json"


@pytest.fixture(scope="module")
def settings() -> dict[str, RunConfig]:
    """The learners of `reference`."""
    shared = kinds.base(configuration.on_task(PRESET, "reference"), CASE, 3, 1.0)
    made = {name: kind.settings(shared) for name, kind in kinds.kinds().items()}
    return {name: config for name, config in made.items() if config is not None}


def test_learners_differ_by_what_they_hear_and_are_about_as_large(settings: dict[str, RunConfig]):
    assert "none-recurrent" not in settings, "nobody sees what others do"
    whole = kinds.num_parameters(settings["discrete"])
    for name in ("dial", "mappo"):
        assert abs(kinds.num_parameters(settings[name]) - whole) < 0.05 * whole, name
    critics = {name: getattr(config.algorithm, "critic", None) for name, config in settings.items()}
    assert [name for name, critic in critics.items() if critic == "told"] == [
        *("discrete", "soft", "commnet", "tarmac", "ic3net")
    ]
    dial = settings["dial"].algorithm
    assert dial.sequence_length * dial.batch_size == PRESET.algorithm.batch_size, "as many steps are replayed"
    for name in ("mappo", "qmix"):
        network = settings[name].algorithm.network
        assert (network.symbols, network.heard_slope, settings[name].algorithm.temperature) == ("soft", 0.1, 0.1)
    assert settings["actions"].env.talk == "actions"
    assert {config.training.env_steps for name, config in settings.items() if name != "mappo-10x"} == {40_000}
    assert settings["mappo-10x"].training.env_steps == 400_000


def test_silent_agents_have_a_memory_too_where_they_see_what_others_do():
    case = tasks.find("colours").cases["colours-full"]
    shared = kinds.base(configuration.on_task(PRESET, "colours"), case, 2, 0.5)
    config = kinds.kinds()[kinds.REMEMBERING].settings(shared)
    assert config is not None and config.algorithm.network.recurrent and config.env.graph == "full"
    assert (config.algorithm.sequence_length, config.training.env_steps) == (8, 60_000)
    assert kinds.kinds()[kinds.UTTERED].settings(shared) is None, "nobody has utterances there"


@pytest.fixture
def trained(monkeypatch: pytest.MonkeyPatch) -> list[RunConfig]:
    """Runs end at once with made-up numbers: the faster they learn the better, and DIAL diverges."""
    started: list[RunConfig] = []

    def start(config: RunConfig, out: Path, watcher: Watcher) -> session.Ended:
        started.append(config)
        folder = RunFolder.create(out, config)
        talks = config.algorithm.network.communication
        if talks == "dial":
            folder.write_diverged("seed 0 diverged: loss is nan")
            raise Diverged("seed 0 diverged: loss is nan; try less")
        seeds = {HEADLINE: np.array([-0.1, 0.0, 0.1]) + RETURNS[talks], CASE.reached: np.array([0.9, 1.0, 0.8])}
        # reached by the first seed at the second look, by the next at the first, by the last for a moment
        along = dict(zip(config.seeds, ([0, 0.9, 0.9, 1], [1, 1, 0, 0], [0, 1, 0, 1]), strict=False))
        worth = 100 * config.algorithm.learning_rate - 20.0  # along training: the faster the better
        folder.append_metrics(
            [
                {"seed": seed, "env_steps": step, "greedy": {HEADLINE: worth, CASE.reached: along[seed][place]}}
                for place, step in enumerate(STEPS)
                for seed in config.seeds
            ]
        )
        summary = {
            "seeds": list(config.seeds),
            "final": {"greedy": {name: {"values": values.tolist()} for name, values in seeds.items()}},
        }
        folder.write_summary(summary)
        return session.Ended(out, config, STEPS[-1], summary)

    def play(run: str, episodes: int, *_: object, **__: object) -> dict[str, np.ndarray]:
        return {HEADLINE: np.full((3, episodes), -20.0), CASE.reached: np.zeros((3, episodes))}

    scripted = {"random": -28.0, "silent": -17.0, "told": -9.5}
    monkeypatch.setattr(session, "start", start)
    monkeypatch.setattr(scoring, "play", play)
    monkeypatch.setattr(
        cells.references, "play_scripted", lambda who, *_: {HEADLINE: scripted[who], CASE.reached: 0.0}
    )
    return started


def test_scores_run_from_the_best_silent_policy_to_the_best_told_one(
    trained: list[RunConfig], tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    out = tmp_path / "study"
    words = ["talk", "--tasks", "reference", "--kinds", "discrete", "dial", "--seeds", "3", "--out", str(out)]
    assert main([*words, "--json"]) == 0
    answer = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert answer == json.loads((out / "summary.json").read_text(encoding="utf-8"))
    [(name, case)] = answer["cases"].items()
    assert name == "reference" and list(case["kinds"]) == ["none", "told", "discrete", "dial"]
    assert case["floor"] == {"who": "scripted silent", "value": -17.0}, "better than the one that was trained"
    assert case["ceiling"] == {"who": "told", "value": -8.0}, "better than the scripted one"
    spoken = case["kinds"]["discrete"]
    assert spoken["score"] == pytest.approx([8 / 9, 7.9 / 9, 8.1 / 9], abs=1e-6)
    assert spoken["better_than_silence"] == [1.0, 1.0, 1.0]
    assert spoken["steps_to_.9"] == [200, 100, None]
    assert spoken["bits"] == 2 * 4, "two rounds of sixteen symbols"
    assert spoken["caught"]["scrambled"][HEADLINE] == [-20.0] * 3
    assert case["kinds"]["none"]["caught"] == {}, "there is nothing to catch"
    assert case["kinds"]["dial"]["diverged"] == "seed 0 diverged: loss is nan"
    page = (out / "report.html").read_text(encoding="utf-8")
    assert "0.89 [0.88, 0.90]" in page and "150 (2 of 3)" in page and "diverged" in page
    assert "gacrl talk --preset gacrl --seeds 3 --seed 0 --tasks reference --kinds none told discrete dial" in page

    before = len(trained)
    assert main([*words[:4], "tarmac", "--seeds", "3", "--out", str(out)]) == 0
    assert [config.algorithm.network.communication for config in trained[before:]] == ["tarmac"], "one cell is new"
    kept = json.loads((out / "summary.json").read_text(encoding="utf-8"))["cases"]["reference"]["kinds"]
    assert list(kept) == ["none", "told", "discrete", "dial", "tarmac"], "the report shows all that are there"
    assert main([*words[:4], "qmix", "mappo-10x", "--seeds", "3", "--out", str(out)]) == 0
    drawn = (out / "report-figures" / "case-reference.svg").read_text(encoding="utf-8")
    assert all(f">{kind}<" in drawn for kind in ("none", "discrete", "qmix")), "a curve each"
    assert "mappo-10x" not in drawn, "whose curve is ten times as long"
    assert main(["talk", "--seeds", "4", "--out", str(out)]) == 2
    assert "holds another study" in capsys.readouterr().err

    config = configuration.from_dict(case["config"])
    found = known.read(out / "summary.json", config)
    assert found.finals["told"][HEADLINE].tolist() == [-8.1, -8.0, -7.9] and "3 seeds from 0" in found.says


@pytest.mark.soak
def test_every_learner_may_try_as_many_learning_rates(trained: list[RunConfig], tmp_path: Path):
    """On seeds of their own; the best one trains on the seeds of the study, and nothing is tried again."""
    out = tmp_path / "tuned"
    done = of_all.study(PRESET, out, trials=3, cases=["reference"], kinds=["none"])
    assert done is not None
    rate = PRESET.algorithm.learning_rate
    for learner in (trained[:4], trained[4:]):
        assert [config.algorithm.learning_rate for config in learner] == pytest.approx(
            [rate, rate / 3, 3 * rate, 3 * rate]
        )
        assert [config.seeds[0] for config in learner] == [1000, 1000, 1000, 0]
    assert len({config.training.env_steps for config in trained}) == 1
    again = of_all.study(PRESET, out, trials=3, cases=["reference"], kinds=["none"])
    assert again is not None and len(trained) == 8 and again.to_dict() == done.to_dict()
    learners = done.cases["reference"].learners
    assert {learner.config.algorithm.learning_rate for learner in learners.values()} == {3 * rate}
    assert "best of 3 learning rates" in done.report.read_text(encoding="utf-8")


def test_what_was_trained_before_is_read_and_not_trained(trained: list[RunConfig], tmp_path: Path):
    """The committed study of ten seeds stands in for the silent and the told learner of three new seeds."""
    held = json.loads(KNOWN.read_text(encoding="utf-8"))
    config = configuration.on_task(PRESET, "reference")
    done = talk.talk(config, tmp_path / "one", 3, 40_000, known=KNOWN)
    assert done is not None
    assert [config.algorithm.network.communication for config in trained] == ["discrete"]
    assert done.returns["told"].tolist() == held["returns"]["told"] and len(done.returns["talking"]) == 3
    assert done.further["success 0.1"]["silent"].tolist() == held["further"]["success 0.1"]["silent"]
    assert done.answer.worth.point == pytest.approx(held["worth"][0])
    written = done.report.read_text(encoding="utf-8")
    command = html.escape(f"--known {shlex.quote(str(KNOWN))}")
    assert "10 seeds from 0, 512 episodes" in written and command in written


def test_the_committed_study_of_a_task_of_ones_own_is_read():
    """Its measures have no metrics: the tables show them by their own names."""
    own.bring(f"{ROOT / 'examples' / 'own_task.py'}:Beacon")
    file = ROOT / "docs" / "data" / "talk-beacon-study.json"
    held = json.loads(file.read_text(encoding="utf-8"))
    found = known.read(file, configuration.from_dict(held["config"]))
    assert found.finals["told"][HEADLINE].tolist() == held["returns"]["told"]
    for label, measured in held["further"].items():
        assert found.finals["silent"][label].tolist() == measured["silent"]


def test_no_score_runs_from_a_good_silent_policy_down_to_a_worse_told_one():
    """The junction's scripted ends are those that never brake, and those that know where all cars are."""

    def scores(gas: float, yielder: float) -> object:
        scripted = {
            who: {"success": worth} for who, worth in (("random", 0.0), ("gas", gas), ("yielder", yielder))
        }
        junction = tasks.find("traffic_junction")
        return cells.Played("", junction, junction.cases["traffic_junction"], scripted, {}).scores(np.array([0.6]))

    assert scores(0.2, 1.0) == pytest.approx([0.5])
    assert scores(0.3, 0.2) is None


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--tasks", "refrence"], "unknown task of the study 'refrence': did you mean 'reference'?"),
        (["--kinds", "tarmak"], "unknown kind of communication 'tarmak': did you mean 'tarmac'?"),
        (["--seeds", "1"], "--seeds must be at least 2, not 1"),
        (["--scale", "0"], "--scale must be above 0 and at most 100, not 0"),
        (["--trials", "9"], "--trials must be between 1 and 5, not 9"),
        (["--preset", "paper"], "--preset paper has a network of its own"),
        (["--env-steps", "100"], "--env-steps is for one task: name it with --env, or say --scale"),
        (["--env.graph", "full"], "--env.graph is a setting of one task: name that with --env"),
        (["--known", "some.json"], "--known is for one task: name it with --env"),
        (["--env", "reference", "--kinds", "dial"], "--kinds is for the study of all tasks: leave --env out"),
        (["--env", "reference", "--known", "none.json"], "cannot read none.json"),
        (["--env", "reference", "--known", str(KNOWN), "--env-steps", "10"], "only of reference (40,000 steps)"),
        (
            ["--env", "reference", "--env.talk", "actions"],
            "reference has words among its actions there, and no messages",
        ),
        (["--env", "spread", "--env.num-agents", "1"], "spread has a single agent: nobody is there to talk to"),
    ],
)
def test_mistakes_end_in_one_sentence(
    words: list[str], sentence: str, said: Callable[..., tuple[int, str]], tmp_path: Path
):
    code, error = said("talk", *words, "--out", tmp_path / "out")
    assert code == 2 and sentence in error and len(error.splitlines()) == 1
    assert not (tmp_path / "out").exists()


def test_every_case_has_what_is_to_be_reached():
    for name, (task, case) in of_all.all_cases().items():
        assert case.reached in tasks.find(task).metrics, name
        configuration.changed(tasks.default_settings(task), {**case.settings, **(case.utterances or {})})
