"""What `spread` promises beyond MPE2's steps: symmetry, padding, difficulty as data, and its measurements."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jax import lax

from gacrl.envs.particles import Physics
from gacrl.envs.symmetry import turn_vectors
from gacrl.tasks.spread.environment import Spread, SpreadParams, SpreadState, pack_state, unpack_state

KEY = jax.random.key(0)


def crowd(seed: int, num_agents: int, num_landmarks: int, reach: float = 0.6) -> SpreadState:
    """Somewhere in the middle of an episode, with contacts and covered landmarks."""
    rng = np.random.default_rng(seed)
    return SpreadState(
        positions=jnp.asarray(rng.uniform(-reach, reach, (num_agents, 2)), jnp.float32),
        velocities=jnp.asarray(rng.normal(0, 1, (num_agents, 2)), jnp.float32),
        landmarks=jnp.asarray(rng.uniform(-reach, reach, (num_landmarks, 2)), jnp.float32),
        landmark_velocities=jnp.asarray(rng.normal(0, 1, (num_landmarks, 2)), jnp.float32),
        clock=jnp.int32(0),
    )


def still(positions, landmarks) -> SpreadState:
    """Everything at rest, so that the next step's positions are these."""
    positions, landmarks = jnp.asarray(positions, jnp.float32), jnp.asarray(landmarks, jnp.float32)
    return SpreadState(positions, jnp.zeros_like(positions), landmarks, jnp.zeros_like(landmarks), jnp.int32(0))


@functools.cache
def compiled(env: Spread):
    return jax.jit(env.step)


def numbers(env: Spread, **changed: float) -> SpreadParams:
    return env.default_params()._replace(**{name: jnp.float32(value) for name, value in changed.items()})


def close(ours, theirs, atol: float = 1e-5) -> None:
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=atol), ours, theirs)


# Time


@pytest.mark.parametrize("reset_on_collision", ["off", "in_place"])
@pytest.mark.parametrize("max_cycles", [1, 7])
def test_an_episode_is_exactly_max_cycles_steps(max_cycles, reset_on_collision):
    env = Spread(max_cycles=max_cycles, reset_on_collision=reset_on_collision)
    # So wide that agents and landmarks are put elsewhere after every step.
    params = numbers(env, reset_distance=10.0)

    def step(state, key):
        action_key, step_key = jax.random.split(key)
        state, result = env.step(state, jax.random.randint(action_key, (3,), 0, 5), step_key, params)
        return state, (state, result)

    start, _ = env.reset(KEY)
    _, (states, results) = lax.scan(step, start, jax.random.split(KEY, max_cycles))
    np.testing.assert_array_equal(results.truncated, np.arange(1, max_cycles + 1) == max_cycles)
    assert not results.terminated.any()
    np.testing.assert_array_equal(states.clock, np.arange(1, max_cycles + 1))
    # Bootstrapping needs the place where the episode ended, not where the next one starts.
    np.testing.assert_array_equal(results.observation.features[-1, :, 2:4], states.positions[-1])
    np.testing.assert_array_equal(results.observation.positions[-1], states.positions[-1])


def test_changing_a_number_never_traces_again():
    env = Spread()
    traces = []

    @jax.jit
    def step(state, params):
        traces.append(None)
        return env.step(state, jnp.array([1, 2, 3]), KEY, params)

    start, _ = env.reset(KEY)
    later, _ = step(start, env.default_params())
    step(later, env.default_params())
    state = crowd(0, 3, 3, reach=0.2)
    before, _ = step(state, env.default_params())
    changes = {
        "local_ratio": lambda result: result.reward,
        "coverage_threshold": lambda result: result.info["coverage_theta"],
        "collision_penalty": lambda result: result.reward,
    }
    _, unchanged = step(state, env.default_params())
    for name, outcome in changes.items():
        _, result = step(state, numbers(env, **{name: 0.01}))
        assert not np.array_equal(outcome(result), outcome(unchanged)), name
    slow = env.default_params()._replace(physics=jax.tree.map(jnp.float32, Physics(damping=0.75)))
    after, _ = step(state, slow)
    assert not np.array_equal(after.velocities, before.velocities)
    near, _ = step(state, numbers(env, arena_scale=0.1, landmark_speed=0.2, reset_distance=0.1))
    assert not np.array_equal(near.landmarks, before.landmarks), "landmarks are reflected where the arena ends"
    assert len(traces) == 1


# Symmetry


@settings(max_examples=25, deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 2**32 - 1),
    agents=st.permutations(range(5)),
    landmarks=st.permutations(range(4)),
)
def test_names_of_agents_and_landmarks_do_not_matter(seed, agents, landmarks):
    agents, landmarks = np.array(agents), np.array(landmarks)
    # Sorted by distance, what an agent sees does not depend on the names of the others either.
    env = Spread(5, 4, num_agent_neighbors=3, num_landmark_neighbors=4, terminate_on_success=True)
    state = crowd(seed, 5, 4)
    action = jnp.asarray(np.random.default_rng(seed).integers(5, size=5))
    renamed = SpreadState(
        state.positions[agents],
        state.velocities[agents],
        state.landmarks[landmarks],
        state.landmark_velocities[landmarks],
        state.clock,
    )
    after, result = compiled(env)(state, action, KEY)
    renamed_after, renamed_result = compiled(env)(renamed, action[agents], KEY)
    close(renamed_after.positions, after.positions[agents])
    close(renamed_after.velocities, after.velocities[agents])
    close(renamed_after.landmarks, after.landmarks[landmarks])
    close(renamed_after.landmark_velocities, after.landmark_velocities[landmarks])
    close(renamed_result.reward, result.reward[agents])
    close(renamed_result.observation.features, result.observation.features[agents])
    close(renamed_result.info, result.info)


# Padding


AGENTS, LANDMARKS = np.array([0, 2, 3]), np.array([1, 4])
"""The slots of the real ones among 5 and 5."""


def padded_and_small(seed: int, **structure):
    """The same three agents and two landmarks, alone and among padding that is in everyone's way."""
    large = Spread(5, 5, **structure)
    small = Spread(3, 2, **structure)
    params = large.default_params()._replace(
        agent_mask=jnp.zeros(5, bool).at[AGENTS].set(True),
        landmark_mask=jnp.zeros(5, bool).at[LANDMARKS].set(True),
    )
    state = crowd(seed, 3, 2, reach=0.4)
    if seed % 2:
        # Success, whatever padded landmarks lie uncovered.
        state = state._replace(landmarks=state.positions[:2] + 0.1 * state.velocities[:2] + 0.02)
        state = state._replace(landmark_velocities=jnp.zeros((2, 2)))
    surroundings = crowd(seed + 1, 5, 5, reach=0.4)
    padded = SpreadState(
        # The padding stands on agents and on landmarks, to the very point.
        surroundings.positions.at[1]
        .set(state.positions[0])
        .at[4]
        .set(state.landmarks[0])
        .at[AGENTS]
        .set(state.positions),
        surroundings.velocities.at[AGENTS].set(state.velocities),
        surroundings.landmarks.at[0].set(state.positions[1]).at[LANDMARKS].set(state.landmarks),
        surroundings.landmark_velocities.at[LANDMARKS].set(state.landmark_velocities),
        state.clock,
    )
    return large, params, padded, small, state


@pytest.mark.parametrize("reward", ["mpe2", "paper"])
@pytest.mark.parametrize("seen", [None, 2])
def test_padding_changes_nothing_for_the_real_ones(seen, reward):
    endings = set()
    for seed in range(10):
        large, params, padded, small, state = padded_and_small(
            seed,
            num_agent_neighbors=seen,
            num_landmark_neighbors=seen,
            reward=reward,
            max_cycles=6,
            terminate_on_success=True,
            reset_on_collision="truncate",
        )
        rng = np.random.default_rng(seed)
        for _ in range(6):
            actions = jnp.asarray(rng.integers(5, size=5))
            padded, crowded = compiled(large)(padded, actions, KEY, params)
            state, alone = compiled(small)(state, actions[AGENTS], KEY)
            close(padded.positions[AGENTS], state.positions)
            close(padded.velocities[AGENTS], state.velocities)
            close(crowded.reward[AGENTS], alone.reward)
            close(crowded.info, alone.info)
            assert (crowded.terminated, crowded.truncated) == (alone.terminated, alone.truncated)
            endings.add((bool(alone.terminated), bool(alone.truncated)))
            close(real_features(crowded.observation.features, large), alone.observation.features)
            np.testing.assert_array_equal(crowded.reward[np.array([1, 4])], 0.0)
            np.testing.assert_array_equal(crowded.observation.features[np.array([1, 4])], 0.0)
            np.testing.assert_array_equal(crowded.observation.agent_mask, params.agent_mask)
            np.testing.assert_array_equal(crowded.observation.landmark_mask, params.landmark_mask)
    assert endings >= {(False, False), (False, True), (True, False)}


def real_features(features, env: Spread):
    """The real agents' rows without the slots of padding, which must be 0."""
    if env.num_agent_neighbors is not None:
        return features[AGENTS]
    rows = []
    for agent in AGENTS:
        own, landmarks, others, silence = np.split(np.asarray(features[agent]), [4, 14, 22])
        others = np.insert(others.reshape(4, 2), agent, np.nan, axis=0)
        landmarks = landmarks.reshape(5, 2)
        seen = [other for other in AGENTS if other != agent]
        assert not np.delete(landmarks, LANDMARKS, axis=0).any() and not others[[1, 4]].any()
        rows.append(np.concatenate([own, landmarks[LANDMARKS].ravel(), others[seen].ravel(), silence[:4]]))
    return np.stack(rows)


def test_masks_of_nobody_padded_are_the_same_as_none():
    env = Spread(3, 2)
    state = crowd(3, 3, 2)
    masked = env.default_params()._replace(agent_mask=jnp.ones(3, bool), landmark_mask=jnp.ones(2, bool))
    action = jnp.array([0, 1, 4])
    close(compiled(env)(state, action, KEY, masked), compiled(env)(state, action, KEY), atol=1e-6)


# The arena


@pytest.mark.parametrize(("num_agents", "num_landmarks"), [(3, 3), (1, 4), (4, 1)])
def test_everything_starts_uniformly_in_the_arena(num_agents, num_landmarks):
    env = Spread(num_agents, num_landmarks)

    @jax.jit
    def starts(scale):
        params = env.default_params()._replace(arena_scale=scale)
        return jax.vmap(lambda key: env.reset(key, params))(jax.random.split(KEY, 2000))

    for scale in (1.0, 2.5):
        state, observation = starts(jnp.float32(scale))
        assert observation.features.shape == (2000, num_agents, env.observation_size)
        for places in (state.positions, state.landmarks):
            assert scale * 0.99 < np.abs(places).max() <= scale
            # Standard errors of mean and variance are below 0.01; entities are drawn on their own.
            np.testing.assert_allclose(places.mean(0), 0.0, atol=0.06 * scale)
            np.testing.assert_allclose(places.var(0), scale**2 / 3, rtol=0.1)
        both = np.concatenate([state.positions, state.landmarks], axis=1).reshape(2000, -1)
        correlation = np.corrcoef(both, rowvar=False) - np.eye(both.shape[1])
        assert np.abs(correlation).max() < 0.12
        assert not state.velocities.any() and not state.landmark_velocities.any() and not state.clock.any()


def test_landmarks_keep_their_speed_and_stay_in_the_arena():
    env = Spread(1, 30)
    # A quarter of top speed, which is 2.0: 0.05 in each step.
    params = numbers(env, landmark_speed=0.25, arena_scale=0.7)
    start, _ = env.reset(KEY, params)

    def step(state, _):
        state, _ = env.step(state, jnp.array([0]), KEY, params)
        return state, state

    _, states = lax.scan(step, start, length=200)
    speed = np.linalg.norm(states.landmark_velocities, axis=-1)
    np.testing.assert_allclose(speed, 0.5, rtol=1e-5)
    assert np.abs(states.landmarks).max() <= 0.7
    moved = np.linalg.norm(np.diff(states.landmarks, axis=0), axis=-1)
    turned = (np.diff(states.landmark_velocities, axis=0) != 0).any(-1)
    np.testing.assert_allclose(moved[~turned], 0.05, rtol=1e-3)
    assert (moved[turned] <= 0.05 + 1e-6).all()
    # A component goes its 1.4 and back at 0.5 |cos| on average 0.32: about 9 turns of each, in 20 time units.
    assert 6 < turned.sum() / 30 < 14
    headings = np.arctan2(*np.moveaxis(np.asarray(start.landmark_velocities), -1, 0))
    assert np.histogram(headings, bins=4, range=(-np.pi, np.pi))[0].min() >= 2


def test_reflection_by_hand():
    state = SpreadState(
        positions=jnp.zeros((1, 2)),
        velocities=jnp.zeros((1, 2)),
        landmarks=jnp.array([[0.9, 0.0], [-0.95, -0.9], [0.5, 0.5]]),
        landmark_velocities=jnp.array([[1.5, 0.5], [-1.0, -2.0], [1.0, -1.0]]),
        clock=jnp.int32(0),
    )
    after, result = compiled(Spread(1, 3))(state, jnp.array([0]), KEY)
    # Right wall: 0.9 + 0.15 = 1.05 comes back to 0.95. Corner: both components turn. Free: straight on.
    landmarks = np.array([[0.95, 0.05], [-0.95, -0.9], [0.6, 0.4]])
    np.testing.assert_allclose(after.landmarks, landmarks, atol=1e-6)
    np.testing.assert_allclose(after.landmark_velocities, [[-1.5, 0.5], [1.0, 2.0], [1.0, -1.0]])
    # Reward and observation are of the places after the move.
    distance = np.linalg.norm(landmarks, axis=1).sum()
    np.testing.assert_allclose(result.reward, [-0.5 * distance], rtol=1e-6)
    np.testing.assert_allclose(result.observation.features[0, 4:], landmarks.ravel(), atol=1e-6)


# Collisions


@pytest.mark.parametrize("number", [2, 3])
def test_agents_on_one_point_stay_finite(number):
    env = Spread(4, 2)
    state = still([[0.2, 0.2]] * number + [[-0.8, 0.0], [0.8, 0.8]][: 4 - number], [[0.2, 0.2], [0.0, 0.0]])
    after, result = compiled(env)(state, jnp.full(4, 2), KEY)
    for leaf in jax.tree.leaves((after, result)):
        assert np.isfinite(leaf).all()
    # No direction to be pushed in: only their own kick to the right, 5 in a tenth.
    np.testing.assert_allclose(after.velocities[:number], [[0.5, 0.0]] * number, atol=1e-6)
    np.testing.assert_allclose(result.info["collisions"], number * (number - 1) / 2)
    for _ in range(20):
        after, result = compiled(env)(after, jnp.arange(4), KEY)
    for leaf in jax.tree.leaves((after, result)):
        assert np.isfinite(leaf).all()
    distance = np.linalg.norm(after.positions[0] - after.positions[1])
    assert distance > 0.15, "different kicks bring them apart again"


NEAR, FAR = [[0.0, 0.0], [0.19, 0.0], [0.9, 0.9]], [[0.0, 0.0], [0.21, 0.0], [0.9, 0.9]]


@pytest.mark.parametrize(("positions", "collided"), [(NEAR, True), (FAR, False)])
def test_collisions_can_end_the_episode(positions, collided):
    env = Spread(reset_on_collision="truncate")
    state, result = compiled(env)(still(positions, np.eye(3, 2)), jnp.zeros(3, int), KEY)
    assert bool(result.truncated) is collided and not result.terminated
    np.testing.assert_allclose(state.positions, positions, atol=1e-6)
    _, wider = compiled(env)(still(FAR, np.eye(3, 2)), jnp.zeros(3, int), KEY, numbers(env, reset_distance=0.3))
    assert bool(wider.truncated)


@pytest.mark.parametrize(("positions", "collided"), [(NEAR, True), (FAR, False)])
def test_collisions_can_start_over_while_the_clock_runs_on(positions, collided):
    env, plain = Spread(reset_on_collision="in_place", max_cycles=5), Spread(max_cycles=5)
    start = still(positions, np.eye(3, 2))._replace(clock=jnp.int32(2))
    state, result = compiled(env)(start, jnp.ones(3, int), KEY)
    kept, expected = compiled(plain)(start, jnp.ones(3, int), KEY)

    assert state.clock == 3 and not result.truncated and not result.terminated
    # What happened is measured and paid before the new places are drawn; what is seen is the new places.
    close((result.reward, result.info), (expected.reward, expected.info))
    assert np.allclose(state.positions, kept.positions) is not collided
    assert np.allclose(state.landmarks, kept.landmarks) is not collided
    np.testing.assert_array_equal(result.observation.features[:, 2:4], state.positions)
    if collided:
        assert not state.velocities.any()
        other, _ = compiled(env)(start, jnp.ones(3, int), jax.random.key(1))
        assert not np.allclose(other.positions, state.positions), "places come from the step's key"


# Measurements


@pytest.mark.parametrize(("num_agents", "num_landmarks"), [(3, 3), (1, 4), (4, 1), (2, 3), (7, 5)])
def test_measurements_are_what_they_say(num_agents, num_landmarks):
    env = Spread(num_agents, num_landmarks)
    params = numbers(env, local_ratio=0.3, coverage_threshold=0.35, collision_penalty=2.0)
    at_half = numbers(env, local_ratio=0.5)
    measure, rewards = jax.jit(env.measure), jax.jit(env.rewards)
    for seed in range(8):
        state = crowd(seed, num_agents, num_landmarks)
        measured = measure(state, params)
        expected = transcribed(np.float64(state.positions), np.float64(state.landmarks), 0.3, 0.35, 2.0)
        assert measured.keys() == expected.keys()
        close(measured, expected)
        np.testing.assert_allclose(rewards(state, at_half).mean(), measured["reward_raw"], rtol=1e-5)


def transcribed(positions, landmarks, local_ratio, threshold, penalty):
    """Plainly, agent by agent."""
    agents, places = range(len(positions)), range(len(landmarks))
    gap = [[np.hypot(*(positions[i] - landmarks[j])) for j in places] for i in agents]
    between = [[np.hypot(*(positions[i] - positions[k])) for k in agents if k != i] for i in agents]
    agent_nearest = np.array([min(gap[i]) for i in agents])
    landmark_nearest = np.array([min(gap[i][j] for i in agents) for j in places])
    neighbour = np.array([min(between[i], default=np.inf) for i in agents])
    collisions = np.array([sum(d < 0.3 for d in between[i]) for i in agents])

    def raw(ratio, penalty):
        return np.mean([-ratio * penalty * hits - (1 - ratio) * landmark_nearest.sum() for hits in collisions])

    bonus = 10 * (1 - agent_nearest / 2) ** 2
    bonus += np.where(agent_nearest < threshold, 3 * (1 - agent_nearest / threshold), 0)
    return {
        "reward_raw": raw(0.5, 1.0),
        "reward_shaped": raw(local_ratio, penalty) + bonus.sum() - (neighbour < 0.2).sum(),
        "coverage_0.1": (landmark_nearest < 0.1).mean(),
        "coverage_0.2": (landmark_nearest < 0.2).mean(),
        "coverage_0.5": (landmark_nearest < 0.5).mean(),
        "coverage_theta": (landmark_nearest < threshold).mean(),
        "success_0.1": float((landmark_nearest < 0.1).all()),
        "distance_agent_landmark": agent_nearest.mean(),
        "distance_landmark_agent": landmark_nearest.mean(),
        "distance_agent_agent": np.mean(between) if len(positions) > 1 else 0.0,
        "collisions": collisions.sum() / 2,
        "near_agents": (neighbour < 0.2).mean(),
    }


def test_success_by_hand():
    env = Spread(2, 2, terminate_on_success=True, max_cycles=2)
    covered = still([[0.05, 0.0], [0.5, 0.53]], [[0.0, 0.0], [0.5, 0.5]])
    _, result = compiled(env)(covered, jnp.zeros(2, int), KEY)
    assert result.terminated and not result.truncated
    assert result.info["coverage_0.1"] == 1.0
    _, result = compiled(env)(covered._replace(clock=jnp.int32(1)), jnp.zeros(2, int), KEY)
    assert result.truncated and not result.terminated, "the time limit comes first"
    half = covered._replace(positions=covered.positions.at[1, 0].set(0.7))
    _, result = compiled(env)(half, jnp.zeros(2, int), KEY)
    assert not result.terminated and result.info["coverage_0.1"] == 0.5


def test_the_coverage_reward_by_hand():
    """MPE2's reward and the bonus for the share that is covered; what is measured stays MPE2's."""
    half = still([[0.05, 0.0], [0.7, 0.53]], [[0.0, 0.0], [0.5, 0.5]])
    plain, paid = Spread(2, 2), Spread(2, 2, reward="coverage")
    _, mpe2 = compiled(plain)(half, jnp.zeros(2, int), KEY)
    _, found = compiled(paid)(half, jnp.zeros(2, int), KEY, numbers(paid, coverage_bonus=0.8))
    np.testing.assert_allclose(found.reward, mpe2.reward + 0.8 * 0.5, rtol=1e-6)
    jax.tree.map(np.testing.assert_array_equal, found.info, mpe2.info)


@pytest.mark.parametrize(("num_agents", "num_landmarks"), [(3, 3), (1, 4), (4, 1)])
def test_the_packed_state_is_all_of_it(num_agents, num_landmarks):
    env = Spread(num_agents, num_landmarks)
    state = crowd(0, num_agents, num_landmarks)
    packed = env.observe(state, env.default_params()).state
    assert packed.shape == (4 * num_agents + 4 * num_landmarks,)
    np.testing.assert_array_equal(packed, pack_state(state))
    jax.tree.map(np.testing.assert_array_equal, unpack_state(packed, num_agents), state)


# What agents see of each other.


@pytest.mark.parametrize("count", [None, 1, 3, 4, 9])
def test_agents_see_of_each_other_what_their_features_show(count):
    """Of five, all in order or the nearest ones; so do observations that are made of bare features."""
    env = Spread(5, 2, num_agent_neighbors=count)
    look = jax.jit(lambda state: env.observe(state, env.default_params()))
    see = jax.jit(env.sight)
    for seed in range(8):
        state = crowd(seed, 5, 2)
        seen = look(state)
        sight = np.asarray(see(seen))
        np.testing.assert_array_equal(see(env.from_features(seen.features)), sight)
        shown = np.asarray(seen.features)[:, 4 + 2 * 2 :][:, : 2 * env.seen_agents].reshape(5, -1, 2)
        places = np.asarray(state.positions)
        for i in range(5):
            others = [j for j in range(5) if j != i]
            in_sight = [j for j in others if sight[i, j].any()]
            assert len(in_sight) == min(4, env.seen_agents)
            nearest = sorted(others, key=lambda j: np.linalg.norm(places[j] - places[i]))
            assert in_sight == others if count is None else set(in_sight) == set(nearest[: len(in_sight)])
            order = in_sight if count is None else nearest[: len(in_sight)]
            np.testing.assert_array_equal(shown[i, : len(order)], sight[i, order])
            np.testing.assert_allclose(sight[i, order], places[order] - places[i], atol=1e-6)
            assert not sight[i, i].any() and not shown[i, len(order) :].any()


@pytest.mark.parametrize("count", [None, 2])
def test_who_is_not_there_is_not_seen(count):
    """Neither in the features of others nor beside a voice, where sight is limited."""
    env = Spread(4, 2, num_agent_neighbors=count)
    there = np.array([True, False, True, True])
    seen = env.observe(crowd(3, 4, 2), env.default_params()._replace(agent_mask=jnp.asarray(there)))
    sight, shown = np.asarray(env.sight(seen)), np.asarray(seen.features)[:, 8 : 8 + 2 * env.seen_agents]
    assert (np.abs(shown[there]).reshape(3, -1, 2).max(-1) > 0).sum() == 3 * 2
    assert (np.abs(sight[there][:, there]).max(-1) > 0).sum() == 3 * 2
    assert count is None or not sight[:, 1].any(), "where all are in sight, no edge leads to who is not there"


def test_sight_turns_with_the_world():
    env = Spread(4, 2, num_agent_neighbors=2)
    seen = env.observe(crowd(5, 4, 2), env.default_params())
    for symmetry in range(env.num_symmetries):
        turned = env.turn(seen, jnp.asarray(symmetry))
        np.testing.assert_allclose(
            env.sight(turned), turn_vectors(env.sight(seen), jnp.asarray(symmetry)), atol=1e-6
        )
