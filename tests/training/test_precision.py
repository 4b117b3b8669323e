"""JAX in double precision, as some programs set it: everything works, and what was trained in single is played alike."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gacrl import play
from gacrl.config import files as configuration
from gacrl.config import presets
from gacrl.config.run import TrainingConfig
from gacrl.envs.environment import Environment
from gacrl.experiments import scoring
from gacrl.tasks.navigation.environment import make
from gacrl.tasks.navigation.settings import ColoursSettings
from gacrl.tasks.spread.environment import Spread
from gacrl.training import build, session

TINY: dict[str, Any] = {
    "algorithm": {"network": {"width": 8}},
    "env": {"max_cycles": 5},
    "training": {"env_steps": 40, "num_envs": 2, "num_steps": 5},
    "evaluation": {"interval": 20, "num_episodes": 2, "final_episodes": 2},
}


@pytest.mark.parametrize(
    "name", {config.algorithm.name: name for name, (_, config) in presets.PRESETS.items()}.values()
)
def test_the_programs_of_every_algorithm_are_sound(name: str):
    """Traced, not compiled: what loops carry keeps its type, and states are in double precision throughout."""
    config = replace(presets.preset(name), training=TrainingConfig(env_steps=100, num_envs=2, num_steps=4))
    with jax.enable_x64(True):
        trainer = build.make_trainer(config)
        member = build.member_shapes(trainer)
        after, report = jax.eval_shape(trainer.chunk_of_one, member, jax.ShapeDtypeStruct((), jnp.int32))
        scores = jax.eval_shape(
            lambda learner: trainer.evaluate(learner, True, "monitor", 2), build.stacked_shapes(trainer).learner
        )
    assert jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype), after) == jax.tree.map(
        lambda leaf: (leaf.shape, leaf.dtype), member
    )
    leaves = jax.tree.leaves((after, report.episodes, scores))
    floats = [leaf.dtype for leaf in leaves if jnp.issubdtype(leaf.dtype, jnp.floating)]
    assert len(floats) > 20 and set(floats) == {np.dtype(np.float64)}


@pytest.mark.parametrize("env", [Spread(4, 3), make(ColoursSettings())], ids=["spread", "colours"])
def test_starts_are_the_same(env: Environment):
    single = env.reset(jax.random.key(7))[0]
    with jax.enable_x64(True):
        double = env.reset(jax.random.key(7))[0]
        assert double.positions.dtype == np.float64
    np.testing.assert_allclose(double.positions, single.positions, rtol=1e-6)
    np.testing.assert_allclose(double.landmarks, single.landmarks, rtol=1e-6)


@pytest.mark.soak
def test_a_run_goes_on_in_either_precision(tmp_path: Path):
    """Trained in double, resumed in single, and again in double; the shipped policies were trained in single."""
    config = configuration.from_dict(TINY, presets.preset("ippo"))
    with jax.enable_x64(True):
        run = session.start(config, tmp_path / "run")
        assert run.summary is not None
        (newest,) = jax.tree.leaves(play.open_run(run.folder).learners.network.actor.head.bias)
        assert newest.dtype == np.float64
    assert play.open_run(run.folder).learners.network.actor.head.bias.dtype == np.float32
    assert session.resume(run.folder, 20).env_steps == 60
    with jax.enable_x64(True):
        assert session.resume(run.folder, 20).env_steps == 80
    rows = session.RunFolder(run.folder).metrics()
    assert [row["env_steps"] for row in rows] == [20, 40, 60, 80]


@pytest.mark.soak
def test_a_policy_trained_in_single_precision_plays_alike_in_double():
    def greedy() -> float:
        scores = scoring.score_run("pretrained:gacrl", 16)
        return scores["final"]["greedy"]["coverage_final_0.1"]["mean"]

    single = greedy()
    with jax.enable_x64(True):
        assert greedy() == pytest.approx(single, abs=0.05)
    assert single > 0.9
