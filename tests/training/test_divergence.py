"""A run that diverges stops within a chunk, says where, and can be looked into."""

import functools
import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import pytest
from conftest import content

from gacrl.algorithms.contract import Algorithm
from gacrl.cli.main import main
from gacrl.config import presets
from gacrl.config.run import EvaluationConfig, RunConfig, TrainingConfig
from gacrl.training import build, session
from gacrl.training.divergence import Diverged, not_finite
from gacrl.training.recorder import RunFolder
from gacrl.training.trainer import Trainer
from gacrl.types import Decision


class Weights(NamedTuple):
    network: Any
    updates: Any


def breaking(at: int, loss: float) -> Algorithm:
    """Agents that stand still, and whose weights are broken by one update; the loss is finite up to then."""

    def policy(learner: Weights, explore: bool) -> Any:
        return lambda memory, observation, key: (Decision(jnp.zeros(3, jnp.int32)), memory)

    def init(key: Any, hyper: Any) -> Weights:
        return Weights({"layer": jnp.ones((2, 3))}, jnp.zeros((), jnp.int32))

    def update(learner: Weights, rollout: Any, key: Any) -> tuple[Weights, Any]:
        updates = learner.updates + 1
        layer = learner.network["layer"].at[1, 2].add(jnp.where(updates >= at, jnp.inf, 0.5))
        return Weights({"layer": layer}, updates), {"loss": jnp.where(updates >= at, loss, updates * 1.0)}

    return Algorithm(init, lambda num_agents: (), policy, update, hyper=())


SHORT = RunConfig(
    env=replace(presets.preset("paper").env, max_cycles=4),
    training=TrainingConfig(env_steps=60, num_envs=2, num_steps=3),
    evaluation=EvaluationConfig(interval=18, num_episodes=2, final_episodes=2),
    seed=7,
)
"""Ten updates, three to a chunk."""


def nothing_played(self: Trainer, *_: Any) -> dict[str, np.ndarray]:
    """Stand in for `Trainer.evaluate`, a program that may be compiled ahead."""
    return dict.fromkeys(self.table.names, np.zeros((1, 2)))


vars(nothing_played)["lower"] = lambda *_: SimpleNamespace(compile=lambda: None)


@pytest.mark.slow
def test_a_run_that_diverges_stops_within_a_chunk_and_can_be_looked_into(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    """The loss stays finite: it is a parameter, of the fifth update, that is not."""
    folder = tmp_path / "run"
    monkeypatch.setattr(build.build_algorithm, "make", lambda *_: breaking(at=5, loss=2.0))
    monkeypatch.setattr(session, "make_trainer", functools.cache(build.make_trainer))
    monkeypatch.setattr(Trainer, "evaluate", nothing_played)
    with pytest.raises(Diverged) as stopped:
        session.start(SHORT, folder)
    assert str(stopped.value) == (
        "seed 7 diverged between environment steps 18 and 36: network['layer'] is inf in 1 of 6 places; try a smaller "
        f"learning rate, or see the first bad update with `gacrl resume {folder} --diagnose`, which begins at the last "
        "good checkpoint, of environment step 18"
    )
    assert [json.loads(line)["env_steps"] for line in (folder / "metrics.jsonl").read_text().splitlines()] == [18]
    assert [path.name for path in folder.glob("checkpoints/step-*")] == ["step-000000000018"]
    because = "seed 7 diverged between environment steps 18 and 36: network['layer'] is inf in 1 of 6 places"
    assert RunFolder(folder).why_diverged() == because, "a comparison can tell it from one that was stopped"

    before = content(folder)
    assert main(["resume", str(folder), "--diagnose", "--json"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert json.loads(lines[-1]) == {
        "begun_at": 18,
        "ended_at": 30,
        "bad": {
            "seed": 7,
            "update": 5,
            "env_steps": 30,
            "metrics": {"loss": [4.0, 2.0]},
            "broken": {"network['layer']": "inf in 1 of 6 places"},
        },
    }
    assert "seed 7: update 5, up to environment step 30, is the first bad one" in lines
    assert content(folder) == before, "nothing is written"

    monkeypatch.setattr(build.build_algorithm, "make", lambda *_: breaking(at=100, loss=2.0))
    monkeypatch.setattr(session, "make_trainer", functools.cache(build.make_trainer))
    assert session.resume(folder).summary is not None
    assert RunFolder(folder).why_diverged() is None, "it did not diverge this time"


def test_what_is_not_finite_is_named():
    learners = {"w": jnp.array([[1.0, 2.0], [jnp.nan, -jnp.inf]]), "n": jnp.array([[1], [2]])}
    found = list(not_finite((3, 4), [{"loss": 1.0}, {"loss": float("inf")}], learners))
    assert found == [(4, "loss", "inf"), (4, "['w']", "nan in 2 of 2 places")]
    assert list(not_finite((3,), [{"loss": 1.0}], {"w": learners["w"]})) == [], (
        "a repeated member is not looked at"
    )
