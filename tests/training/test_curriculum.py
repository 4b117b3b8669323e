"""Tasks that grow: gates, arenas and teams by hand, and one compiled program through all of it."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gacrl import tasks
from gacrl.config import files as configuration
from gacrl.config import presets
from gacrl.config.run import CurriculumConfig, EvaluationConfig, RunConfig, TrainingConfig
from gacrl.errors import ConfigError
from gacrl.play import open_run
from gacrl.tasks.spread.environment import Spread
from gacrl.tasks.spread.settings import SpreadSettings
from gacrl.training import build, checkpoint, curriculum
from gacrl.training.recorder import RunFolder
from gacrl.types import Rollout

TASK = tasks.find("spread")


def over(covered: list[float], going_on: int = 1) -> Rollout:
    """A step of several environments, in some of which an episode ends with this much covered."""
    done = jnp.array([[True] * len(covered) + [False] * going_on])
    info = {TASK.progress: jnp.array([covered + [1.0] * going_on])}
    return Rollout(SimpleNamespace(terminated=done & False, truncated=done, info=info), ())


def test_a_gate_counts_only_the_episodes_that_follow_success():
    """Of the running mean: 1 − .95² after two perfect episodes, and half a failure is not yet below the gate."""
    settings = SpreadSettings(coverage_threshold_end=0.1)
    start = TASK.numbers(settings, Spread())
    growing = curriculum.make(CurriculumConfig(episodes=4, gate=0.09), TASK, settings, start)
    stage, params = growing.init(start)
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
            np.testing.assert_allclose(stage.progress, mean, rtol=1e-5)
        np.testing.assert_allclose(params.coverage_threshold, 0.5 - 0.4 * min(counted / 4, 1), rtol=1e-6)


def test_arena_and_team_grow_to_the_configured_task():
    """From 1 agent of 4 and an arena of 0.5 to all and 1.5, over 3 episodes; landmarks (2) in proportion."""
    settings = SpreadSettings(4, 2, arena_scale=1.5, arena_scale_start=0.5, num_agents_start=1)
    start = TASK.numbers(settings, TASK.make(settings))
    growing = curriculum.make(CurriculumConfig(episodes=3), TASK, settings, start)
    stage, params = growing.init(start)
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
    env=SpreadSettings(max_cycles=4, num_agents_start=1, arena_scale_start=0.2),
    curriculum=CurriculumConfig(episodes=8),
    training=TrainingConfig(env_steps=64, num_envs=2, num_steps=2),
    evaluation=EvaluationConfig(num_episodes=2),
)


@pytest.mark.soak
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
    assert trainer.evaluation_params.agent_mask.all(), "evaluated with the whole team"
    assert trainer.evaluation_params.arena_scale == 1.0
    assert jax.tree.leaves(trainer.evaluate(state.learner, False, "monitor", 2))[0].shape == (1, 2)


def test_a_team_that_grew_plays_with_fewer_than_it_began_with(tmp_path: Path):
    config = replace(GROWING, env=SpreadSettings(max_cycles=4, num_agents_start=3))
    folder = RunFolder.create(tmp_path / "run", config)
    tensors = checkpoint.serialise(checkpoint.arrays(build.make_trainer(config).init((0,))))
    checkpoint.save(folder.checkpoints, tensors, 0, configuration.fingerprint(config), {})
    assert open_run(folder.path, lambda env: replace(env, num_agents=2)).env.num_agents == 2


def test_a_task_that_stays_as_it_is_costs_nothing():
    """The curriculum is the constant one, whatever its length; a setting that moves makes it another."""
    for settings, still in ((SpreadSettings(), True), (SpreadSettings(local_ratio_end=0.1), False)):
        params = TASK.numbers(settings, TASK.make(settings))
        state, same = curriculum.make(CurriculumConfig(episodes=3), TASK, settings, params).init(params)
        assert (state is params) is still and (same is params) is still


@pytest.mark.parametrize(
    ("preset", "env", "gate", "said"),
    [
        ("gacrl", {}, 0.5, "gate has nothing to hold back: spread stays as it is"),
        ("gacrl", {"num_agents_start": 4}, None, "num_agents_start must be at most env.num_agents, 3, not 4"),
        ("paper", {"num_agents_start": 2}, None, "gacrl_paper knows teams of one size only, and in spread"),
    ],
)
def test_what_cannot_grow_is_refused(preset: str, env: dict[str, int], gate: float | None, said: str):
    config = presets.preset(preset)
    config = replace(config, env=replace(config.env, **env), curriculum=CurriculumConfig(gate=gate))
    with pytest.raises(ConfigError, match=said):
        build.make_trainer(config)


def test_a_gate_needs_a_task_that_says_what_progress_is():
    settings = SpreadSettings(local_ratio_end=0.1)
    params = TASK.numbers(settings, TASK.make(settings))
    with pytest.raises(ConfigError, match="gate needs a task that says what progress is"):
        curriculum.make(CurriculumConfig(gate=0.5), TASK._replace(progress=None), settings, params)
