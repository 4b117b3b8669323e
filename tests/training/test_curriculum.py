"""Tasks that grow: gates, arenas and teams by hand, and one compiled program through all of it."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gacrl.config import files as configuration
from gacrl.config import presets
from gacrl.config.run import CurriculumConfig, EnvConfig, EvaluationConfig, RunConfig, TrainingConfig
from gacrl.errors import ConfigError
from gacrl.play import open_run
from gacrl.tasks.spread.environment import Spread
from gacrl.training import build, checkpoint, curriculum
from gacrl.training.recorder import RunFolder
from gacrl.types import Rollout

pytestmark = pytest.mark.usefixtures("quick_start")


def over(covered: list[float], going_on: int = 1) -> Rollout:
    """A step of several environments, in some of which an episode ends with this much covered."""
    done = jnp.array([[True] * len(covered) + [False] * going_on])
    info = {"coverage_theta": jnp.array([covered + [1.0] * going_on])}
    return Rollout(SimpleNamespace(terminated=done & False, truncated=done, info=info), (), ())


def test_a_gate_counts_only_the_episodes_that_follow_success():
    """Of the running mean: 1 − .95² after two perfect episodes, and half a failure is not yet below the gate."""
    growing = curriculum.make(CurriculumConfig(coverage_threshold_end=0.1, episodes=4, gate=0.09))
    stage, params = growing.init(Spread().default_params())
    assert params.coverage_threshold == 0.5
    expected = [
        ([1.0], 0.05, 0),  # below the gate: it does not count
        ([1.0], 0.0975, 1),
        ([], 0.0975, 1),
        ([1.0, 0.0], 0.9025 * 0.0975 + 0.0975 * 0.5, 3),
        ([0.0] * 10, 0.95**10 * (0.9025 * 0.0975 + 0.0975 * 0.5), 3),
        ([1.0] * 10, None, 13),
    ]
    for covered, mean, counted in expected:
        stage, params = growing.advance(stage, jnp.int32(0), over(covered))
        assert int(stage.episode) == counted
        if mean is not None:
            np.testing.assert_allclose(stage.coverage, mean, rtol=1e-5)
        np.testing.assert_allclose(params.coverage_threshold, 0.5 - 0.4 * min(counted / 4, 1), rtol=1e-6)


def test_arena_and_team_grow_to_the_configured_task():
    """From 1 agent of 4 and an arena of 0.5 to all and 1.5, over 3 episodes; landmarks (2) in proportion."""
    growing = curriculum.make(CurriculumConfig(arena_scale_start=0.5, num_agents_start=1, episodes=3))
    env = Spread(4, 2).padded()
    stage, params = growing.init(env.default_params()._replace(arena_scale=jnp.float32(1.5)))
    seen = []
    for _ in range(5):
        seen.append((params.agent_mask.sum().item(), params.landmark_mask.sum().item(), float(params.arena_scale)))
        stage, params = growing.advance(stage, jnp.int32(0), over([0.0]))
    sizes, arenas = [size[:2] for size in seen], [size[2] for size in seen]
    assert sizes == [(1, 1), (2, 1), (3, 2), (4, 2), (4, 2)]
    np.testing.assert_allclose(arenas, [0.5, 0.5 + 1 / 3, 0.5 + 2 / 3, 1.5, 1.5], rtol=1e-6)
    assert params.agent_mask[0], "the first are there from the start"


GROWING = RunConfig(
    algorithm=replace(
        presets.preset("gacrl").algorithm,
        network=replace(presets.preset("gacrl").algorithm.network, width=8, latent_size=2, rounds=1),
        augment=False,
        symmetric_play=False,
        replay_capacity=64,
        learning_starts=8,
        batch_size=4,
        updates=1,
    ),
    env=EnvConfig(max_cycles=4),
    curriculum=CurriculumConfig(num_agents_start=1, arena_scale_start=0.2, episodes=8),
    training=TrainingConfig(env_steps=64, num_envs=2, num_steps=2),
    evaluation=EvaluationConfig(num_episodes=2),
)


def test_a_team_grows_within_one_program():
    trainer = build.make_trainer(GROWING)
    state = trainer.init((0,))
    start = state.carry.env_state
    assert np.abs(start.positions).max() <= 0.2, "the first episodes start in the arena's first size"
    chunk, sizes = trainer.chunk.lower(state, 4).compile(), []
    for _ in range(3):
        sizes.append(state.env_params.agent_mask.sum().item())
        state, report = chunk(state, 4)
        assert all(np.isfinite(value).all() for value in report.metrics.values())
    assert sizes == [1, 2, 3]
    assert trainer.evaluation_env.default_params().agent_mask is None, (
        "evaluated with the whole team, without masks"
    )
    assert jax.tree.leaves(trainer.evaluate(state.learner, False, "monitor", 2))[0].shape == (1, 2)


def test_a_team_that_grew_plays_with_fewer_than_it_began_with(tmp_path: Path):
    config = replace(GROWING, curriculum=CurriculumConfig(num_agents_start=3))
    folder = RunFolder.create(tmp_path / "run", config)
    tensors = checkpoint.serialise(checkpoint.arrays(build.make_trainer(config).init((0,))))
    checkpoint.save(folder.checkpoints, tensors, 0, configuration.fingerprint(config), {})
    assert open_run(folder.path, lambda env: replace(env, num_agents=2)).env.num_agents == 2


def test_what_cannot_grow_is_refused():
    with pytest.raises(ConfigError, match="gate has nothing to hold back"):
        CurriculumConfig(gate=0.5)
    with pytest.raises(ConfigError, match="num_agents_start must be at most env.num_agents, 3, not 4"):
        RunConfig(curriculum=CurriculumConfig(num_agents_start=4))
    with pytest.raises(ConfigError, match="gacrl_paper knows teams of one size only"):
        replace(presets.preset("paper"), curriculum=CurriculumConfig(num_agents_start=2))
