"""The compiled loop: one program for all chunks, members that are seeds, episodes counted right, fixed starts."""

import logging
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array

from gacrl import rollout, tasks
from gacrl.algorithms.contract import Algorithm
from gacrl.config.presets import preset
from gacrl.config.run import EvaluationConfig, RunConfig, TrainingConfig
from gacrl.envs.environment import Environment
from gacrl.envs.probes import Probe
from gacrl.errors import UserError
from gacrl.evaluation import references
from gacrl.evaluation.episodes import record_many
from gacrl.evaluation.evaluate import evaluate, stream_key
from gacrl.tasks.spread.environment import Spread
from gacrl.tasks.spread.settings import METRICS
from gacrl.training import build, checkpoint
from gacrl.training.curriculum import constant
from gacrl.training.devices import one_seed, without_padding
from gacrl.training.loop import train
from gacrl.training.trainer import ChunkReport, Trainer
from gacrl.types import Decision, Metrics, Policy, Transition

pytestmark = pytest.mark.xdist_group("runs")

PAPER = preset("paper")
SMALL = replace(
    PAPER,
    env=replace(PAPER.env, max_cycles=15),
    algorithm=replace(PAPER.algorithm, replay_capacity=500),
    training=TrainingConfig(env_steps=25),
    evaluation=EvaluationConfig(interval=10, num_episodes=4),
    seed=3,
)
"""What decides the compiled programs is as in the tiny run, so that some are compiled already."""


@pytest.fixture(scope="module")
def trainers() -> dict[int, Trainer]:
    """The paper's algorithm for one and for two seeds, on the two devices that there are."""
    assert jax.local_device_count() == 2
    return {count: build.make_trainer(replace(SMALL, num_seeds=count)) for count in (1, 2)}


def leaves(tree: Any) -> list[np.ndarray]:
    """As plain numbers, also random keys."""
    return [
        np.asarray(jax.random.key_data(leaf) if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) else leaf)
        for leaf in jax.tree.leaves(tree)
    ]


# Compiling.


def compiled(records: list[logging.LogRecord]) -> list[str]:
    return [record.getMessage() for record in records if record.getMessage().startswith("Compiling ")]


def test_a_second_chunk_compiles_nothing_whatever_its_length(
    trainers: dict[int, Trainer], caplog: pytest.LogCaptureFixture, tmp_path: Any
):
    """Chunks of 10, 10 and 5 updates, each with its evaluations and its checkpoint."""
    config, trainer, traced = replace(SMALL, num_seeds=2), trainers[2], 0
    original = trainer.algorithm

    def update(*arguments: Any) -> Any:
        nonlocal traced
        traced += 1
        return original.update(*arguments)

    trainer.algorithm = original._replace(update=update)
    counts: list[int] = []
    with jax.log_compiles(), caplog.at_level(logging.WARNING):
        for progress in train(trainer, config, trainer.init(config.seeds)):
            state = without_padding(progress.state, 2)
            tensors = checkpoint.serialise(checkpoint.arrays(state))
            checkpoint.save(tmp_path, tensors, progress.env_steps, "", {})
            assert state.updates.tolist() == [progress.env_steps] * 2
            counts.append(len(compiled(caplog.records)))
            if len(counts) == 1:
                first_traces = traced
    trainer.algorithm = original
    assert progress.env_steps == 25
    assert len(counts) == 3
    assert counts[0] > 0, "compiling is seen"
    assert compiled(caplog.records)[counts[0] :] == []
    assert first_traces == traced == 1


def test_a_start_compiles_no_program_for_each_leaf(caplog: pytest.LogCaptureFixture):
    """Most of a start went into hundreds of tiny programs once."""
    config = replace(SMALL, num_seeds=3)
    with jax.log_compiles(), caplog.at_level(logging.WARNING):
        state = build.make_trainer(config).init(config.seeds)
        one_seed(state, 2)
        without_padding(state, 3)
    assert len(jax.tree.leaves(state)) > 40
    assert 0 < len(compiled(caplog.records)) < 16


# Seeds.


def alone(trainer: Trainer, seed: int) -> list[np.ndarray]:
    """Everything about a seed after ten updates by itself."""
    return [leaf[0] for leaf in leaves(trainer.chunk(trainer.init((seed,)), 10)[0])]


def assert_members_are_seeds(single: Trainer, several: Trainer, seeds: tuple[int, ...]) -> None:
    state, report = several.chunk(several.init(seeds), 10)
    padded = len(seeds) + len(seeds) % 2
    assert {leaf.shape[0] for leaf in jax.tree.leaves((state, report))} == {padded}
    assert {len(leaf.sharding.device_set) for leaf in jax.tree.leaves(state.learner)} == {2}
    together = leaves(without_padding(state, len(seeds)))
    for member, seed in enumerate(seeds):
        for here, there in zip(together, alone(single, seed), strict=True):
            np.testing.assert_allclose(here[member], there, atol=1e-5)
    assert any((here[0] != here[1]).any() for here in together), "the seeds differ"


def test_two_members_are_their_seeds_alone(trainers: dict[int, Trainer]):
    """The paper's algorithm, each seed on a device of its own."""
    assert_members_are_seeds(trainers[1], trainers[2], (3, 4))


def test_three_members_are_their_seeds_alone():
    """Each device maps over two seeds; of the last one there are two copies, one of which is never looked at."""
    env = Probe("both")
    single, several = (Trainer(remembering(env), env, constant(), E, T, num_seeds=count) for count in (1, 3))
    assert_members_are_seeds(single, several, (3, 4, 5))


def test_a_seed_gives_the_same_bits_again_and_chunks_may_be_cut_anywhere(trainers: dict[int, Trainer]):
    whole, again = alone(trainers[1], 3), alone(trainers[1], 3)
    state = trainers[1].init((3,))
    for updates in (1, 7, 2):
        state, _ = trainers[1].chunk(state, updates)
    for first, second, cut in zip(whole, again, leaves(state), strict=True):
        np.testing.assert_array_equal(first, second)
        np.testing.assert_array_equal(first, cut[0])


# Episodes.

E, T, LIMIT, UPDATES = 2, 3, 4, 8
CLOSE = Spread(2, 2, max_cycles=LIMIT, reset_on_collision="truncate", reset_distance=0.7)
"""Episodes end after four steps, or when the agents are close: now and then, and not in step with each other."""


class Remembered(NamedTuple):
    weights: Array
    transitions: Transition
    """Of the last rollout."""


def remembering(env: Environment) -> Algorithm:
    """A linear policy that follows a made-up gradient, and remembers what it saw."""

    def policy(learner: Remembered, explore: bool) -> Policy:
        def act(memory: Any, observation: Any, key: Any) -> tuple[Decision, Any]:
            return Decision(jax.random.categorical(key, observation.features @ learner.weights)), memory

        return act

    def blank(weights: Array) -> Transition:
        params, key = env.default_params(), jax.random.key(0)
        carry = rollout.start(env, params, (), key, E)
        act = policy(Remembered(weights, ()), True)
        return rollout.collect(env, act, (), params, carry, key, T)[1].transitions

    def init(key: Any, hyper: Any) -> Remembered:
        weights = jax.random.normal(key, (env.observation_size, env.num_actions))
        shapes = jax.eval_shape(blank, weights)
        return Remembered(weights, jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes))

    def update(learner: Remembered, rollout: Any, key: Any) -> tuple[Remembered, Metrics]:
        steps = rollout.transitions
        direction = jnp.einsum("teno,ten->o", steps.observation.features, steps.reward)
        noise = jax.random.normal(key, learner.weights.shape)
        weights = learner.weights + 1e-3 * (direction[:, None] * jnp.ones((1, env.num_actions)) + noise)
        return Remembered(weights, steps), {"loss": jnp.asarray(2.0)}

    return Algorithm(init, lambda num_agents: (), policy, update, hyper=())


class History(NamedTuple):
    trainer: Trainer
    steps: Transition
    """[updates x T, E, ...]"""
    reports: list[ChunkReport]
    """Of single updates."""


@pytest.fixture(scope="module")
def history() -> History:
    """Seed 1."""
    trainer = Trainer(remembering(CLOSE), CLOSE, constant(), E, T, metrics=METRICS)
    state, transitions, reports = trainer.init((1,)), [], []
    for _ in range(UPDATES):
        state, report = trainer.chunk(state, 1)
        transitions.append(jax.device_get(one_seed(state.learner.transitions, 0)))
        reports.append(jax.device_get(one_seed(report, 0)))
    return History(trainer, jax.tree.map(lambda *parts: np.concatenate(parts), *transitions), reports)


def episodes_by_hand(steps: Transition) -> list[tuple[int, dict[str, float]]]:
    """The time of its last step, and metrics, of each episode in the order in which they ended."""
    done, found = steps.terminated | steps.truncated, []
    for e in range(E):
        begin = 0
        for t in np.flatnonzero(done[:, e]):
            info = {name: values[begin : t + 1, e] for name, values in steps.info.items()}
            metrics = {"return_agent_mean": info["reward_raw"].sum(), "collisions": info["collisions"].sum()}
            for name in ("reward_raw", "reward_shaped", "near_agents"):
                metrics[name] = info[name].mean()
            for who in ("agent_landmark", "landmark_agent", "agent_agent"):
                metrics[f"distance_{who}"] = info[f"distance_{who}"].mean()
            for radius in ("0.1", "0.2", "0.5"):
                metrics[f"coverage_mean_{radius}"] = info[f"coverage_{radius}"].mean()
                metrics[f"coverage_final_{radius}"] = info[f"coverage_{radius}"][-1]
            metrics["coverage_mean_theta"] = info["coverage_theta"].mean()
            metrics["success_final_0.1"] = info["success_0.1"][-1]
            found.append((int(t), metrics))
            begin = t + 1
    return sorted(found, key=lambda episode: episode[0])


def test_episodes_are_counted_as_by_hand(history: History):
    trainer, steps, reports = history
    episodes = episodes_by_hand(steps)
    lengths = {int(t) for t, _ in episodes}
    assert len(episodes) > UPDATES * T * E / LIMIT, "some ended before the time limit"
    assert len(lengths) > UPDATES * T / LIMIT, "not in step with each other"
    for update, report in enumerate(reports):
        ended = [metrics for t, metrics in episodes if update * T <= t < (update + 1) * T]
        assert report.episodes.ended == len(ended)
        assert report.metrics == {"loss": 2.0}
        for k, name in enumerate(trainer.table.names):
            values = np.array([metrics[name] for metrics in ended])
            np.testing.assert_allclose(report.episodes.total[k], values.sum(), rtol=1e-5, atol=1e-6)
            np.testing.assert_allclose(report.episodes.squares[k], np.square(values).sum(), rtol=1e-5, atol=1e-6)
            if len(values):
                np.testing.assert_allclose(report.episodes.last[k], values[-1], rtol=1e-5, atol=1e-6)
    assert set(trainer.table.names) == set(episodes[0][1])


def test_a_long_chunk_counts_what_short_ones_do(history: History):
    trainer, steps, reports = history
    state, report = jax.device_get(trainer.chunk(trainer.init((1,)), UPDATES))
    assert report.episodes.ended[0] == state.episodes[0] == len(episodes_by_hand(steps))
    for part in ("total", "squares"):
        parts = [getattr(report.episodes, part) for report in reports]
        np.testing.assert_allclose(getattr(report.episodes, part)[0], np.sum(parts, axis=0), rtol=1e-5, atol=1e-6)
    newest = next(report for report in reversed(reports) if report.episodes.ended)
    np.testing.assert_array_equal(report.episodes.last[0], newest.episodes.last)
    assert report.metrics["loss"] == [2.0], "a mean over the updates"


def test_what_follows_an_end_is_a_reset_and_what_is_learned_from_is_not(
    history: History,
):
    _, steps, _ = history
    done = steps.terminated | steps.truncated
    assert not steps.terminated.any(), "this task ends by its time limit alone"
    assert steps.first[0].all()
    np.testing.assert_array_equal(steps.first[1:], done[:-1])

    state, after = steps.observation.state, steps.next_observation.state
    np.testing.assert_array_equal(after[:-1][~done[:-1]], state[1:][~done[:-1]])
    velocities = state.reshape(*state.shape[:2], -1)[..., 4:8]
    assert (velocities[steps.first] == 0).all(), "at rest after a reset"

    # The observation after a last step is the world that the step led to, and no reset.
    places, _ = np.split(steps.observation.positions, 1), None
    moved = steps.next_observation.positions - places[0]
    assert np.abs(moved).max() < 0.2, "nobody jumps within a step"
    jumped = steps.observation.positions[1:] - steps.next_observation.positions[:-1]
    assert (np.abs(jumped[done[:-1]]).reshape(done[:-1].sum(), -1).max(1) > 0.2).all(), "a reset moves everyone"
    params = CLOSE.default_params()
    step = jax.jit(CLOSE.step)
    for t, e in np.argwhere(done)[:6]:
        before = jax.tree.map(lambda leaf, t=t, e=e: jnp.asarray(leaf[t, e]), steps)
        world, _ = CLOSE.reset(jax.random.key(0), params)
        packed = before.observation.state
        world = world._replace(
            positions=packed[:4].reshape(2, 2),
            velocities=packed[4:8].reshape(2, 2),
            landmarks=packed[8:12].reshape(2, 2),
        )
        _, by_hand = step(world, before.decision.action, jax.random.key(0), params)
        np.testing.assert_allclose(before.next_observation.features, by_hand.observation.features, atol=1e-6)


# Evaluation.


def test_evaluation_does_not_depend_on_what_was_trained_before(trainers: dict[int, Trainer]):
    trainer = trainers[2]
    state = trainer.init((3, 4))
    learner = jax.tree.map(jnp.copy, state.learner)

    def measured() -> dict[str, np.ndarray]:
        return jax.device_get(trainer.evaluate(learner, True, "monitor", 4))

    before = measured()
    trained, _ = trainer.chunk(state, 10)
    jax.block_until_ready(trainer.evaluate(trained.learner, True, "monitor", 4))
    after = measured()
    for name, values in before.items():
        np.testing.assert_array_equal(values, after[name])
    assert before["return_agent_mean"].shape == (2, 4)


def test_every_policy_is_evaluated_from_the_same_starts(trainers: dict[int, Trainer]):
    trainer = trainers[2]
    env, key = trainer.evaluation_env, stream_key("monitor")
    params = trainer.evaluation_params
    noop, nothing = references.noop(env)
    learner = one_seed(trainer.init((3, 4)).learner, 1)
    look = references.look_of(tasks.find("spread"), SMALL.env)
    policy = trainer.algorithm.policy(learner, True)
    played = record_many(env, policy, trainer.memory, params, key, 4, look=look)
    idle = record_many(env, noop, nothing, params, key, 4, look=look)
    for one, other in zip(played, idle, strict=True):
        np.testing.assert_array_equal(one.scene.agents.positions[0], other.scene.agents.positions[0])
        np.testing.assert_array_equal(one.scene.marks.positions[0], other.scene.marks.positions[0])
        assert (one.scene.agents.positions[-1] != other.scene.agents.positions[-1]).any()
    assert len({episode.scene.agents.positions[0].tobytes() for episode in idle}) == 4

    # What the recordings show is what is measured.
    measured = jax.jit(lambda: evaluate(env, noop, nothing, params, key, 4))()["return_agent_mean"]
    np.testing.assert_allclose(measured, [episode.return_so_far[-1] for episode in idle], rtol=1e-5)


def test_streams_of_random_numbers_never_meet():
    keys = [stream_key("training", seed) for seed in (*range(200), 20_260_101, 2**31 - 1, 2**32 - 1)]
    keys += [stream_key(stream) for stream in ("monitor", "gate", "report")]
    assert len(np.unique([jax.random.key_data(key) for key in keys], axis=0)) == len(keys)

    env = Spread()
    draw: Callable[..., Any] = jax.jit(jax.vmap(lambda key: env.reset(key)[0].positions))
    places = np.concatenate([np.asarray(draw(jax.random.split(key, 8))) for key in keys])
    assert len(np.unique(places.reshape(len(places), -1), axis=0)) == 8 * len(keys)


def test_every_seed_has_a_training_stream_of_its_own(history: History):
    state = history.trainer.init_stacked((3, 4, 5))
    keys = jax.random.key_data(state.key)
    assert len(np.unique(keys, axis=0)) == 3
    positions = np.asarray(state.carry.env_state.positions)
    assert len(np.unique(positions.reshape(3 * E, -1), axis=0)) == 3 * E


def test_a_run_that_diverges_says_so(monkeypatch: pytest.MonkeyPatch):
    """A loss that is not a number ends the run at once, before a checkpoint of it is written."""
    algorithm = remembering(CLOSE)
    algorithm = algorithm._replace(update=lambda learner, rollout, key: (learner, {"loss": jnp.asarray(jnp.nan)}))
    config = RunConfig(
        env=replace(PAPER.env, num_agents=2, max_cycles=LIMIT),
        training=TrainingConfig(env_steps=E * T, num_envs=E, num_steps=T),
        evaluation=EvaluationConfig(num_episodes=1),
    )
    trainer = Trainer(algorithm, CLOSE, constant(), E, T, metrics=METRICS)
    monkeypatch.setattr(trainer, "evaluate", lambda *how: {"return_agent_mean": np.zeros((1, 1))})
    with pytest.raises(
        UserError, match=r"seed 0 diverged between environment steps 0 and 6: loss is nan; .*smaller learning"
    ):
        next(train(trainer, config, trainer.init((0,))))


def test_transitions_hold_what_was_done(history: History):
    _, steps, _ = history
    assert isinstance(steps.decision, Decision)
    assert steps.decision.action.shape == (UPDATES * T, E, 2)
    assert set(np.unique(steps.decision.action)) == set(range(5))
