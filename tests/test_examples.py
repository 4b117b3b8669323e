"""The examples do what they say: each is run, on few steps where what it reaches is not at stake."""

import csv
import importlib.util
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

import gacrl
from gacrl.cli.main import main
from gacrl.config.kinds import COMMUNICATION
from gacrl.evaluation.evaluate import evaluate, stream_key
from gacrl.messages import interventions
from gacrl.play import open_run

ROOT = Path(__file__).parent.parent
SILENT, TOLD = 1.2, 5.6
"""What Beacon brings at best without a word (each of six steps ends at the beacon with one chance in five), and to one
who knows where it is: one step on the way to each of the two outer places is lost."""

pytestmark = pytest.mark.xdist_group("examples")


@pytest.fixture
def example(from_outside: None, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], Any]:
    """An example as a module, run from the repository's folder."""
    monkeypatch.chdir(ROOT)

    def load(name: str) -> Any:
        spec = importlib.util.spec_from_file_location(name, ROOT / "examples" / f"{name}.py")
        assert spec is not None and spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        return module

    return load


def silenced(folder: Path) -> float:
    """What the policy of a run brings when nobody hears anything."""
    opened = open_run(folder)
    env, params, memory = opened.env, opened.trainer.evaluation_params, opened.trainer.memory

    def play() -> Any:
        policy, key = opened.policy(0, False), stream_key("report")
        return evaluate(env, policy, memory, params, key, 320, interventions.silence())

    return float(np.mean(jax.jit(play)()["return_agent_mean"]))


@pytest.mark.soak
def test_a_task_of_your_own_is_solved_by_talking_alone(tmp_path: Path, example: Callable[[str], Any]):
    """The default preset, with its discrete symbols; silenced it is no better than a policy that never heard a word."""
    assert len((ROOT / "examples" / "own_task.py").read_text().splitlines()) <= 60
    words = [
        "train",
        "--env",
        "examples/own_task.py:Beacon",
        "--env-steps",
        "10000",
        "--out",
        str(tmp_path / "run"),
    ]
    assert main(words) == 0
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    reached = summary["final"]["greedy"]["return_agent_mean"]["mean"]
    assert reached > TOLD - 0.3
    assert silenced(tmp_path / "run") < SILENT + 0.3


def few(monkeypatch: pytest.MonkeyPatch) -> None:
    """Presets learn little and measure little."""
    preset = gacrl.preset

    def small(name: str = "gacrl") -> Any:
        config = preset(name)
        return replace(config, evaluation=replace(config.evaluation, num_episodes=2, final_episodes=4))

    monkeypatch.setattr(gacrl, "preset", small)


@pytest.mark.soak
def test_messages_of_your_own(example: Callable[[str], Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """They are said, their loss is among the others, and any learner takes them by name."""
    few(monkeypatch)
    run = example("own_messages").main(env_steps=600, out=tmp_path / "run")
    row = json.loads((run.folder / "metrics.jsonl").read_text().splitlines()[-1])
    assert 0 < row["update"]["loss_messages"] < 1e-3 * 8
    words = ["train", "--preset", "ippo", "--algorithm.network.communication", "numbers", "--env-steps", "64"]
    words += ["--env", "examples/own_task.py:Beacon", "--training.num-envs", "4", "--training.num-steps", "4"]
    words += ["--evaluation.num-episodes", "2", "--evaluation.final-episodes", "2", "--out", str(tmp_path / "ppo")]
    del COMMUNICATION["numbers"]
    assert main([*words, "--use", "examples/own_messages.py"]) == 0
    row = json.loads((tmp_path / "ppo" / "metrics.jsonl").read_text().splitlines()[-1])
    assert row["update"]["loss_messages"] > 0


@pytest.mark.soak
def test_exploration_of_your_own(example: Callable[[str], Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """A learner from replay and one on-policy take it; the share of random actions is what the rule says."""
    few(monkeypatch)
    run = example("own_exploration").main(preset="vdn", env_steps=2048, out=tmp_path / "vdn")
    row = json.loads((run.folder / "metrics.jsonl").read_text().splitlines()[-1])
    shares = [max(0.5 ** (10 * update / 8), 0.05) for update in range(1, 9)]
    assert row["update"]["epsilon"] == pytest.approx(np.mean(shares)), "of the eight updates of 256 steps"
    run = example("own_exploration").main(preset="commnet", env_steps=1600, out=tmp_path / "commnet")
    assert run.summary is not None


@pytest.mark.slow
def test_an_algorithm_of_your_own(example: Callable[[str], Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """REINFORCE learns to talk; its run folder is evaluated as any other."""
    run = example("own_algorithm").main(env_steps=40_000, out=tmp_path / "run")
    assert run.summary["final"]["greedy"]["return_agent_mean"]["mean"] > 2 * SILENT
    assert silenced(run.folder) < SILENT + 0.3
    assert not list((run.folder / "checkpoints").glob("best-*/*optimizer*"))


@pytest.mark.soak
def test_a_tracker_of_your_own(example: Callable[[str], Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """One row an evaluation, as in metrics.jsonl; it may stop the run."""
    few(monkeypatch)
    run = example("own_tracker").main(path=tmp_path / "told.csv", env_steps=1200, out=tmp_path / "run")
    with (tmp_path / "told.csv").open(newline="") as file:
        told = list(csv.DictReader(file))
    rows = [json.loads(line) for line in (run.folder / "metrics.jsonl").read_text().splitlines()]
    assert [float(row["return_agent_mean"]) for row in told] == [
        row["greedy"]["return_agent_mean"] for row in rows
    ]
    assert len(rows) >= 4
