"""`spread` against the installed MPE2: the same states and the same actions, every step compared.

MPE2 runs first, in NumPy's float64. Its states are then copied across, all at once, so that each of our steps
starts where MPE2's did; one test lets ours run on alone.
"""

import copy
import functools
import logging
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np
import pytest
from jax import lax
from mpe2 import simple_spread_v3

from gacrl.envs.particles import Physics
from gacrl.tasks.spread.environment import Spread, SpreadState

TEAMS = {1: 45, 2: 45, 3: 45, 5: 45, 10: 30}
"""Episodes of each team size, for each kind of action: 420 in all."""
LOCAL_RATIOS = (0.5, 0.0, 0.1, 0.73, 1.0)
TOUCHING = 0.3
"""Two agents of radius 0.15."""


class Steps(NamedTuple):
    """M steps of MPE2, episode after episode, as arrays with M in front; named as ours are."""

    positions: np.ndarray
    velocities: np.ndarray
    landmarks: np.ndarray
    clock: np.ndarray
    action: np.ndarray
    local_ratio: np.ndarray
    next_positions: np.ndarray
    next_velocities: np.ndarray
    features: np.ndarray
    reward: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray

    @property
    def lengths(self) -> np.ndarray:
        """Steps of each episode."""
        return np.diff(np.append(np.flatnonzero(self.clock == 0), len(self.clock)))


def scattered(world: Any, rng: np.random.Generator) -> None:
    """As MPE2's own reset left them."""


def crowded(world: Any, rng: np.random.Generator) -> None:
    """All agents within 0.1 of each other: in a disc of that diameter."""
    centre = rng.uniform(-0.9, 0.9, 2)
    for agent in world.agents:
        angle, radius = rng.uniform(0, 2 * np.pi), 0.05 * np.sqrt(rng.uniform())
        agent.state.p_pos = centre + radius * np.array([np.cos(angle), np.sin(angle)])


def charging(world: Any, rng: np.random.Generator) -> None:
    """All agents on their way to one point, at up to twice what their own force can reach."""
    angles = rng.uniform(0, 2 * np.pi) + np.linspace(0, 2 * np.pi, len(world.agents), endpoint=False)
    for agent, angle in zip(world.agents, angles, strict=True):
        outwards = np.array([np.cos(angle), np.sin(angle)])
        agent.state.p_pos = 0.3 * outwards + rng.normal(0, 0.02, 2)
        agent.state.p_vel = -rng.uniform(2, 4) * outwards


def arriving(world: Any, rng: np.random.Generator) -> None:
    """Every agent on its way to a landmark of its own, which it passes after one to three steps."""
    speed, steps = 3.0, rng.integers(1, 4)
    way = speed * world.dt * ((1 - world.damping) ** np.arange(steps)).sum()
    for agent, landmark in zip(world.agents, world.landmarks, strict=True):
        angle = rng.uniform(0, 2 * np.pi)
        outwards = np.array([np.cos(angle), np.sin(angle)])
        agent.state.p_pos = landmark.state.p_pos + way * outwards + rng.normal(0, 0.02, 2)
        agent.state.p_vel = -speed * outwards


@functools.cache
def record(
    num_agents: int,
    continuous: bool,
    episodes: int,
    starts: tuple[Callable[[Any, np.random.Generator], None], ...] = (scattered, crowded, charging),
    max_cycles: int = 25,
    push_range: tuple[float, float] = (0.0, 1.0),
    change_world: Callable[[Any], None] | None = None,
    **settings: Any,
) -> Steps:
    """Let MPE2 play with random actions; starts and local ratios take turns."""
    rng = np.random.default_rng(num_agents)
    env = simple_spread_v3.parallel_env(
        N=num_agents, continuous_actions=continuous, max_cycles=max_cycles, **settings
    )
    raw: Any = env.unwrapped
    if change_world is not None:
        change_world(raw.world)
    names = env.possible_agents
    steps = []

    def draw_actions() -> np.ndarray:
        if not continuous:
            return rng.integers(5, size=num_agents)
        # In the action space's own precision, in which MPE2 then subtracts.
        return rng.uniform(*push_range, size=(num_agents, 5)).astype(np.float32)

    def now(part: str) -> np.ndarray:
        # A copy: MPE2 adds to its positions in place.
        return np.array([getattr(agent.state, part) for agent in raw.world.agents])

    for episode in range(episodes):
        env.reset(seed=episode)
        raw.local_ratio = LOCAL_RATIOS[episode % len(LOCAL_RATIOS)]
        starts[episode % len(starts)](raw.world, rng)
        landmarks = np.array([landmark.state.p_pos for landmark in raw.world.landmarks])
        clock = 0
        while env.agents:
            action = draw_actions()
            before = now("p_pos"), now("p_vel"), landmarks, clock, action, raw.local_ratio
            observations, rewards, terminations, truncations, _ = env.step(dict(zip(names, action, strict=True)))
            steps.append(
                Steps(
                    *before,
                    next_positions=now("p_pos"),
                    next_velocities=now("p_vel"),
                    features=np.array([observations[name] for name in names]),
                    reward=np.array([rewards[name] for name in names]),
                    terminated=all(terminations.values()),
                    truncated=all(truncations.values()),
                )
            )
            clock += 1
    return Steps(*(np.array(column) for column in zip(*steps, strict=True)))


def recorded_state(steps: Steps) -> SpreadState:
    """The states that MPE2 acted upon; its landmarks rest."""
    return SpreadState(
        positions=steps.positions,
        velocities=steps.velocities,
        landmarks=steps.landmarks,
        landmark_velocities=np.zeros_like(steps.landmarks),
        clock=steps.clock.astype(np.int32),
    )


def step_from(env: Spread, steps: Steps, **changed: Any):
    """Our step from each recorded state: one compiled call for all of them."""

    def step(state, action, local_ratio):
        numbers = jax.tree.map(lambda number: jax.numpy.asarray(number, float), changed)
        params = env.default_params()._replace(local_ratio=local_ratio, **numbers)
        return env.step(state, action, jax.random.key(0), params)

    given = jax.tree.map(jax.numpy.asarray, (recorded_state(steps), steps.action, steps.local_ratio))
    return jax.tree.map(np.asarray, jax.jit(jax.vmap(step))(*given))


def pair_distances(positions: np.ndarray) -> np.ndarray:
    """[M, pairs]"""
    first, second = np.triu_indices(positions.shape[1], k=1)
    return np.linalg.norm(positions[:, first] - positions[:, second], axis=-1)


def assert_equals_mpe2(steps: Steps, state: SpreadState, result) -> None:
    """The promise under x64."""
    np.testing.assert_allclose(state.positions, steps.next_positions, rtol=0, atol=1e-9)
    np.testing.assert_allclose(state.velocities, steps.next_velocities, rtol=0, atol=1e-9)
    np.testing.assert_array_equal(state.landmarks, steps.landmarks)
    np.testing.assert_allclose(result.reward, steps.reward, rtol=0, atol=1e-9)
    features = result.observation.features
    assert features.dtype == np.float64
    np.testing.assert_array_max_ulp(features.astype(np.float32), steps.features, maxulp=1)
    np.testing.assert_array_equal(result.terminated, steps.terminated)
    np.testing.assert_array_equal(result.truncated, steps.truncated)


@pytest.mark.parametrize("continuous", [False, True], ids=["discrete", "continuous"])
@pytest.mark.parametrize("num_agents", TEAMS)
def test_every_step_equals_mpe2(num_agents, continuous):
    episodes = TEAMS[num_agents]
    steps = record(num_agents, continuous, episodes)
    np.testing.assert_array_equal(steps.lengths, np.full(episodes, 25))
    if num_agents > 1:
        distance = pair_distances(steps.positions)
        assert (distance[steps.clock > 0].min(axis=1) < 0.1).mean() > 0.02, "no hard collisions recorded"
        assert (distance[steps.clock == 0].max(axis=1) < 0.1).sum() == episodes / 3, "no crowded starts"

    env = Spread(num_agents, num_agents, continuous_actions=continuous)
    with jax.enable_x64(True):
        state, result = step_from(env, steps)
    assert_equals_mpe2(steps, state, result)


@pytest.mark.parametrize("continuous", [False, True], ids=["discrete", "continuous"])
@pytest.mark.parametrize("num_agents", TEAMS)
def test_every_step_is_close_to_mpe2_in_float32(num_agents, continuous):
    steps = record(num_agents, continuous, TEAMS[num_agents])
    state, result = step_from(Spread(num_agents, num_agents, continuous_actions=continuous), steps)
    assert state.positions.dtype == result.reward.dtype == np.float32

    # Closer pairs: the direction of a force of up to 30 between them drowns in the rounding of their places.
    apart = (pair_distances(steps.positions) >= 0.05).all(axis=1)
    assert apart.mean() > 0.75
    for ours, theirs in [
        (state.positions, steps.next_positions),
        (state.velocities, steps.next_velocities),
        (result.observation.features, steps.features),
    ]:
        np.testing.assert_allclose(ours[apart], theirs[apart], rtol=0, atol=1e-5)
    # Whether two agents touch is a comparison: within rounding of 0.3 either answer is right.
    decided = apart & (np.abs(pair_distances(steps.next_positions) - TOUCHING) > 1e-5).all(axis=1)
    assert decided.sum() >= 0.99 * apart.sum()
    np.testing.assert_allclose(result.reward[decided], steps.reward[decided], rtol=0, atol=1e-5)


@pytest.mark.parametrize("num_agents", [3, 10])
def test_whole_episodes_equal_mpe2(num_agents):
    steps = record(num_agents, False, TEAMS[num_agents])
    episodes = jax.tree.map(lambda x: x.reshape(TEAMS[num_agents], 25, *x.shape[1:]), steps)
    env = Spread(num_agents, num_agents)

    def play(state, actions, local_ratio):
        params = env.default_params()._replace(local_ratio=local_ratio)

        def step(state, action):
            state, result = env.step(state, action, jax.random.key(0), params)
            return state, (state, result.reward, result.truncated)

        return lax.scan(step, state, actions)[1]

    with jax.enable_x64(True):
        first = jax.tree.map(lambda x: jax.numpy.asarray(x[:, 0]), recorded_state(episodes))
        played = jax.jit(jax.vmap(play))(
            first, jax.numpy.asarray(episodes.action), jax.numpy.asarray(episodes.local_ratio[:, 0])
        )
        state, reward, truncated = jax.tree.map(np.asarray, played)
    np.testing.assert_allclose(state.positions, episodes.next_positions, rtol=0, atol=1e-9)
    np.testing.assert_allclose(reward, episodes.reward, rtol=0, atol=1e-9)
    np.testing.assert_array_equal(truncated, episodes.truncated)


@pytest.mark.parametrize(
    ("num_agents", "seen_agents", "seen_landmarks"),
    [(1, 2, 3), (2, 1, 1), (3, 1, 2), (3, 5, 7), (5, None, 2), (5, 2, None), (10, 3, 4)],
)
def test_nearest_neighbours_are_mpe2s(num_agents, seen_agents, seen_landmarks):
    seen = {"num_agent_neighbors": seen_agents, "num_landmark_neighbors": seen_landmarks}
    steps = record(num_agents, False, 6, **seen)
    env = Spread(num_agents, num_agents, **seen)
    assert steps.features.shape[2] == env.observation_size
    with jax.enable_x64(True):
        state, result = step_from(env, steps)
    assert_equals_mpe2(steps, state, result)


def test_success_ends_the_episode_where_mpe2_ends_it():
    steps = record(2, False, 60, starts=(arriving,), max_cycles=3, terminate_on_success=True)
    env = Spread(2, 2, max_cycles=3, terminate_on_success=True)
    with jax.enable_x64(True):
        state, result = step_from(env, steps)
    assert_equals_mpe2(steps, state, result)

    success = result.info["success_0.1"] == 1.0
    np.testing.assert_array_equal(steps.terminated, success & (steps.clock < 2))
    assert {1, 2, 3} == set(steps.lengths[success[np.cumsum(steps.lengths) - 1]])
    assert (success & result.truncated & ~result.terminated).sum() >= 3, "no success at the time limit"


@pytest.mark.parametrize(("num_agents", "num_landmarks"), [(1, 3), (2, 4), (4, 2)])
def test_other_numbers_of_landmarks_in_mpe2s_world(num_agents, num_landmarks):
    def set_landmarks(world):
        world.landmarks = [copy.deepcopy(world.landmarks[0]) for _ in range(num_landmarks)]

    steps = record(num_agents, False, 6, change_world=set_landmarks)
    assert steps.landmarks.shape[1] == num_landmarks
    with jax.enable_x64(True):
        state, result = step_from(Spread(num_agents, num_landmarks), steps)
    assert_equals_mpe2(steps, state, result)


def test_other_constants_in_mpe2s_world():
    physics = Physics(
        time_step=0.05,
        damping=0.4,
        contact_force=60.0,
        contact_margin=0.02,
        action_force=3.0,
        agent_radius=0.1,
    )

    def set_constants(world):
        world.dt, world.damping = physics.time_step, physics.damping
        world.contact_force, world.contact_margin = physics.contact_force, physics.contact_margin
        for agent in world.agents:
            agent.size, agent.accel = physics.agent_radius, physics.action_force

    steps = record(3, True, 9, change_world=set_constants)
    env = Spread(3, 3, continuous_actions=True)
    with jax.enable_x64(True):
        state, result = step_from(env, steps, physics=physics)
    assert_equals_mpe2(steps, state, result)


def test_continuous_actions_out_of_bounds_are_clipped_as_mpe2_does(caplog):
    with caplog.at_level(logging.ERROR, logger="pettingzoo.utils.env_logger"):
        steps = record(2, True, 2, push_range=(-0.5, 1.5))
    with jax.enable_x64(True):
        state, result = step_from(Spread(2, 2, continuous_actions=True), steps)
    assert_equals_mpe2(steps, state, result)


def test_no_penalty_is_the_first_stage_of_mpe2s_curriculum():
    steps = record(3, False, 9, curriculum=True)
    with jax.enable_x64(True):
        state, result = step_from(Spread(3, 3), steps, collision_penalty=0.0)
    assert result.info["collisions"].sum() > 10
    assert_equals_mpe2(steps, state, result)


@pytest.mark.parametrize("max_cycles", [1, 7])
def test_the_time_limit_is_mpe2s(max_cycles):
    steps = record(3, False, 3, max_cycles=max_cycles)
    np.testing.assert_array_equal(steps.lengths, max_cycles)
    _, result = step_from(Spread(3, 3, max_cycles=max_cycles), steps)
    np.testing.assert_array_equal(result.truncated, steps.clock == max_cycles - 1)
    np.testing.assert_array_equal(result.truncated, steps.truncated)


def test_agents_on_one_point_are_nan_there_and_finite_here():
    def stacked(world, rng):
        for agent in world.agents[:2]:
            agent.state.p_pos = np.array([0.25, -0.5])

    with np.errstate(invalid="ignore"):
        steps = record(3, False, 1, starts=(stacked,), max_cycles=2)
    assert np.isnan(steps.next_velocities[0, :2]).all()
    state, result = step_from(Spread(3, 3), jax.tree.map(lambda x: x[:1], steps))
    np.testing.assert_allclose(state.velocities[0, 2], steps.next_velocities[0, 2], rtol=0, atol=1e-6)
    for ours in jax.tree.leaves((state, result)):
        assert np.isfinite(ours).all()
    assert result.info["collisions"] == [1.0]
