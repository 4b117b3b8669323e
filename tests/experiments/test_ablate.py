"""`gacrl ablate`: what is taken away and nothing else, levels replayed, a table and figures, resumption."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gacrl import tasks
from gacrl.cli.main import main
from gacrl.config import files as configuration
from gacrl.config import presets
from gacrl.config.algorithms import GacrlConfig
from gacrl.config.run import RunConfig
from gacrl.experiments import ablate
from gacrl.experiments.ablate import FULL, plan
from gacrl.experiments.parts import YOKED, parts_of, usual_preset
from gacrl.experiments.study import Planned
from gacrl.experiments.worth import remarkable, worths
from gacrl.tasks.spread.settings import METRICS
from gacrl.tasks.task import HEADLINE
from gacrl.training import session
from gacrl.training.divergence import Diverged
from gacrl.training.recorder import RunFolder
from gacrl.training.watching import Watcher

pytestmark = pytest.mark.usefixtures("quick_start")

PARTS = parts_of(presets.preset("gacrl-112k"))
"""Of every task, and of spread."""
SCORE = HEADLINE
STEPS = (100, 200, 300, 400)
EPSILON = np.array([[0.3, 0.16, 0.09, 0.02], [0.3, 0.16, 0.09, 0.02]])
"""With ε from 0.3 to 0.02: coverages 0, 1 − √½, ½, 1."""


@pytest.fixture(scope="module")
def planned(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Planned]:
    config = presets.preset("gacrl-112k")
    return {run.name: run for run in plan(config, tmp_path_factory.mktemp("plan"), list(PARTS))}


def test_each_run_differs_from_the_whole_in_its_part_alone(planned: dict[str, Planned]):
    assert list(planned) == [FULL, *PARTS]
    whole = planned[FULL].config
    for name, part in PARTS.items():
        config = planned[name].config
        assert config != whole
        back = configuration.from_dict(configuration.to_dict(whole), config)
        assert back == whole
        changed = {
            key
            for key, value in configuration.to_dict(config)["algorithm"].items()
            if value != configuration.to_dict(whole)["algorithm"][key]
        }
        assert changed <= {*part.changes.get("algorithm", {}), "yoked_progress"}
        assert (config.env != whole.env) == ("env" in part.changes)
        assert config.training == whole.training


def test_what_talks_has_parts_of_its_own(tmp_path: Path):
    """A told critic among them; agents without messages have nobody whom it could teach to talk."""
    talking = configuration.on_task(presets.preset(usual_preset("reference")), "reference")
    assert (talking.preset, usual_preset("spread"), usual_preset(None)) == (
        "gacrl",
        "gacrl-112k",
        "gacrl-112k",
    )
    known = parts_of(talking)
    assert set(known) - set(PARTS) == {"untold-critic"} and "no-coverage-bonus" not in known
    assert {"no-seen-slope", "no-heard-slope", "blunt-look", "warm-symbols", "no-logit-price"} < set(known)
    runs = {run.name: run.config for run in plan(talking, tmp_path, ["no-messages", "soft-messages"])}
    assert [run.algorithm.critic for run in runs.values()] == ["told", "central", "told"]


def test_networks_without_a_part_are_about_as_large(planned: dict[str, Planned]):
    sizes = {name: ablate.num_parameters(run.config) for name, run in planned.items()}
    whole = sizes[FULL]
    assert all(abs(size - whole) < 0.05 * whole for size in sizes.values()), sizes
    narrow = replace(planned["no-messages"].config.algorithm.network, parameters=None)  # pyright: ignore
    without = replace(planned["no-messages"].config.algorithm, network=narrow)
    shrunk = ablate.num_parameters(replace(planned["no-messages"].config, algorithm=without))
    assert shrunk < 0.95 * whole, "what was evened out"


CLEAN = {"git_commit": "c0ffee", "jax": "0.10.2"}


def begin(config: RunConfig, out: Path) -> RunFolder:
    folder = RunFolder.create(out, config)
    folder.origin_file.write_text(json.dumps({"task": {"name": "spread"}, "versions": CLEAN}), encoding="utf-8")
    return folder


def finish(config: RunConfig, out: Path, score: float) -> session.Ended:
    """A finished run of made-up numbers: seeds a little around the score."""
    folder = begin(config, out)
    folder.append_metrics(
        [
            {
                "seed": seed,
                "env_steps": step,
                "greedy": {SCORE: score * (place + 1) / len(STEPS)},
                "update": {"epsilon": float(EPSILON[0, place])},
            }
            for place, step in enumerate(STEPS)
            for seed in config.seeds
        ]
    )
    values = {"values": [score + 0.001 * k for k in range(config.num_seeds)]}
    of_better = {"git_commit": "decade-dirty", "jax": "0.11.0"} if score == 0.95 else CLEAN
    summary = {
        "seeds": list(config.seeds),
        "final": {"greedy": dict.fromkeys(METRICS, values)},
        "versions": of_better,
    }
    folder.write_summary(summary)
    return session.Ended(out, config, STEPS[-1], summary)


@pytest.fixture
def trained(monkeypatch: pytest.MonkeyPatch) -> list[RunConfig]:
    """Runs end at once: worse without messages, better without symmetry, and diverging without the bonus."""
    started: list[RunConfig] = []

    def start(config: RunConfig, out: Path, watcher: Watcher) -> session.Ended:
        started.append(config)
        if config.env.reward == "mpe2":
            begin(config, out).write_diverged("seed 0 diverged: loss is nan")
            raise Diverged("seed 0 diverged: loss is nan; try less")
        assert isinstance(config.algorithm, GacrlConfig)
        quiet = config.algorithm.network.communication == "none"
        return finish(config, out, 0.7 if quiet else 0.9 if config.algorithm.augment else 0.95)

    monkeypatch.setattr(session, "start", start)
    return started


def test_the_command_says_what_each_part_is_worth(
    trained: list[RunConfig], tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    out = tmp_path / "out"
    parts = ("no-messages", "no-symmetry", "no-coverage-bonus", YOKED)
    words = ["ablate", *(word for part in parts for word in ("--part", part)), "--seeds", "3", "--out", str(out)]
    assert main([*words, "--json"]) == 0
    answer = json.loads(capsys.readouterr().out.splitlines()[-1])
    runs = {run["name"]: run for run in answer["runs"]}
    assert list(runs) == [FULL, *parts]
    assert runs[FULL]["probability_that_the_part_helps"] is None
    worth = runs["no-messages"]["probability_that_the_part_helps"]
    assert set(worth) >= {SCORE, "coverage_final_0.1", "collisions"}, "every metric of the task"
    assert len(worth) == len(METRICS)
    assert worth[SCORE] == [1.0, 1.0, 1.0] and worth["collisions"] == [0.0, 0.0, 0.0], "fewer are better"
    assert runs["no-symmetry"]["probability_that_the_part_helps"][SCORE][0] == 0.0
    assert runs["no-messages"]["with_it_less_without"][SCORE] == pytest.approx([0.2, 0.199, 0.201], abs=1e-3)
    said = runs["no-messages"]["said"]
    assert (said[SCORE], said["collisions"]) == ("may help", "may cost"), "three seeds claim nothing"
    assert runs["no-coverage-bonus"]["said"] == {}
    assert runs["no-coverage-bonus"]["diverged"] == "seed 0 diverged: loss is nan"
    assert runs["no-messages"]["intervals"][SCORE][0] == pytest.approx(0.701)

    algorithm = trained[-1].algorithm
    assert isinstance(algorithm, GacrlConfig)
    assert algorithm.exploration == "yoked"
    np.testing.assert_allclose(algorithm.yoked_progress, [0, 1 - np.sqrt(0.5), 0.5, 1], atol=1e-4)

    page = Path(answer["report"]).read_text(encoding="utf-8")
    assert "diverged: seed 0 diverged" in page
    for doubt in (
        "not of one version of the code, but of c0ffee, decade-dirty.",
        "changes beside commit decade: no commit has the code",
        "made with different versions of jax.",
    ):
        assert doubt in page, doubt
    assert [versions["git_commit"] for versions in answer["versions"]] == ["c0ffee", "decade-dirty"]
    assert "0.701 [0.700, 0.702]" in page
    assert "<td>no-messages</td><td>may cost</td><td>collisions</td><td>0.200 [0.199, 0.201]" in page
    assert page.count('<figure class="plot">') == 4
    assert (
        "gacrl ablate --preset gacrl-112k --seeds 3 --seed 0 --env-steps 112500 --updates 5 --part no-messages"
        in page
    )
    assert "5 gradient steps after every 25 (the preset has 10)" in page

    before = len(trained)
    assert main(words) == 0
    assert len(trained) == before, "nothing is trained twice"
    summary = out / "no-messages" / "summary.json"
    for changed, because in (
        ("[0, 1, 7]", "it holds seeds [0, 1, 7], not [0, 1, 2]"),
        ("[0, 1, 2]", "lacks a value"),
    ):
        held = {**json.loads(summary.read_text(encoding="utf-8")), "seeds": json.loads(changed)}
        if because == "lacks a value":
            del held["final"]["greedy"][SCORE]["values"][0]
        summary.write_text(json.dumps(held), encoding="utf-8")
        capsys.readouterr()
        assert main(words) == 2
        assert because in capsys.readouterr().err
    assert main(["ablate", "--seeds", "4", "--out", str(out)]) == 2
    assert "holds another ablation" in capsys.readouterr().err


def test_ten_seeds_may_claim():
    """Seeds that differ in every pair; by as much, but in most pairs only; and no more than by chance."""
    task, seeds = tasks.find("spread"), np.arange(10.0)
    whole = dict.fromkeys(("return_agent_mean", "collisions", "reward_raw"), seeds)
    without = {"return_agent_mean": seeds - 10.0, "collisions": seeds - 10.0, "reward_raw": seeds - 0.5}
    found = worths(task, whole, without)
    assert [found[metric].said for metric in whole] == ["helps", "costs", ""]
    assert list(remarkable(found)) == ["return_agent_mean", "collisions"]
    fewer = worths(task, {m: v[:9] for m, v in whole.items()}, {m: v[:9] for m, v in without.items()})
    assert [fewer[metric].said for metric in whole] == ["may help", "may cost", ""]


def test_there_is_nothing_to_compare_with_where_the_whole_diverges(
    trained: list[RunConfig], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    preset = presets.preset("gacrl-112k")
    bare = replace(preset, env=replace(preset.env, reward="mpe2"))
    monkeypatch.setattr(presets, "preset", lambda name="gacrl": bare)
    assert main(["ablate", "--part", YOKED, "--out", str(tmp_path / "out")]) == 2
    assert "nothing to compare with: with all parts, seed 0 diverged" in capsys.readouterr().err
    assert len(trained) == 1


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--seeds", "1"], "--seeds must be at least 2, not 1: with one there is no interval over seeds"),
        (["--preset", "qmix"], "--preset qmix has no parts to take away: name a GACRL preset"),
        (["--part", "no-message"], "unknown part 'no-message': did you mean 'no-messages'?"),
        (["--env-steps", "0"], "training.env_steps must be between 1 and"),
    ],
)
def test_mistakes_end_in_one_sentence(
    words: list[str], sentence: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
):
    assert main(["ablate", *words, "--out", str(tmp_path / "out")]) == 2
    said = capsys.readouterr().err
    assert sentence in said
    assert said.count("\n") == 1
    assert not (tmp_path / "out").exists()
