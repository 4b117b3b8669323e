"""The scripted policies reach what is known of them, and the oracle copes with every shape of the task."""

import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist, pdist

from gacrl import rollout
from gacrl.envs import scripted
from gacrl.envs.spread import Spread, SpreadParams, SpreadState, pack_state, unpack_state
from gacrl.evaluation.evaluate import evaluate
from gacrl.types import Channel

KEY = jax.random.key(7)
QUIET = Channel()


def play(env: Spread, chosen: scripted.Scripted, num_episodes: int) -> dict[str, np.ndarray]:
    """The metrics of each episode."""
    run = jax.jit(lambda key: evaluate(env, *chosen, env.default_params(), key, num_episodes))
    return jax.tree.map(np.asarray, run(KEY))


def begin(env: Spread, chosen: scripted.Scripted, num_envs: int) -> rollout.Carry:
    return jax.jit(lambda: rollout.start(env, env.default_params(), chosen.initial_memory, KEY, num_envs))()


def at_rest(positions, landmarks) -> SpreadState:
    positions, landmarks = jnp.asarray(positions, jnp.float32), jnp.asarray(landmarks, jnp.float32)
    return SpreadState(positions, jnp.zeros_like(positions), landmarks, jnp.zeros_like(landmarks), jnp.int32(0))


def test_an_unknown_name_is_refused():
    with pytest.raises(ValueError, match="no scripted policy 'orcale', only random, noop, oracle"):
        scripted.make("orcale", Spread())


# What the task of MPE2 gives them: three agents, 25 steps


@pytest.mark.parametrize(("name", "known"), [("random", -26.2), ("noop", -24.0)])
def test_floors(name, known):
    returns = play(Spread(), scripted.make(name, Spread()), 2048)["return_agent_mean"]
    error = float(returns.std()) / len(returns) ** 0.5
    assert returns.mean() == pytest.approx(known, abs=3 * error)


@pytest.mark.parametrize(
    ("continuous", "coverage", "success", "known"), [(False, 0.97, 0.93, -7.4), (True, 0.99, 0.98, -5.8)]
)
def test_ceiling(continuous, coverage, success, known):
    env = Spread(continuous_actions=continuous)
    metrics = play(env, scripted.make("oracle", env), 400)
    assert metrics["coverage_final_0.1"].mean() >= coverage
    assert metrics["success_final_0.1"].mean() >= success
    assert metrics["return_agent_mean"].mean() >= known


def test_continuous_actions_of_the_floors():
    env = Spread(continuous_actions=True)
    _, observation = jax.jit(env.reset)(KEY)
    still = scripted.make("noop", env).policy((), observation, KEY, QUIET)[0].action
    np.testing.assert_array_equal(still, np.zeros((3, 5)))
    pushes = scripted.make("random", env).policy((), observation, KEY, QUIET)[0].action
    assert pushes.shape == (3, 5)
    assert 0 <= pushes.min() < pushes.max() <= 1


# The oracle


def test_any_number_of_agents_and_landmarks():
    """Padding down from six: one alone; surplus agents that must not stand in the way; surplus landmarks."""
    env = Spread(num_agents=6, num_landmarks=6, max_cycles=40)
    oracle = scripted.make("oracle", env)

    @jax.jit
    def coverage(agent_mask, landmark_mask):
        params = env.default_params()._replace(agent_mask=agent_mask, landmark_mask=landmark_mask)
        return evaluate(env, *oracle, params, KEY, 100)["coverage_final_0.1"].mean()

    six = jnp.arange(6)
    assert coverage(six < 1, six < 1) == 1.0
    assert coverage(six < 6, six < 3) >= 0.95
    assert coverage(six < 3, six < 6) >= 0.49


def test_padding_changes_nothing():
    places = np.random.default_rng(0).uniform(-1, 1, (200, 10, 2))
    masks = SpreadParams(agent_mask=jnp.arange(5) < 3, landmark_mask=jnp.arange(5) < 4)
    padded = Spread(5, 5, initial_params=masks)

    def decide(env: Spread, positions, landmarks):
        oracle = scripted.make("oracle", env)

        def act(positions, landmarks):
            observation = env.observe(at_rest(positions, landmarks), env.initial_params)
            return oracle.policy(oracle.initial_memory, observation, KEY, QUIET)

        return jax.jit(jax.vmap(act))(jnp.asarray(positions), jnp.asarray(landmarks))

    expected, landmark = decide(Spread(3, 4), places[:, :3], places[:, 5:9])
    decision, padded_landmark = decide(padded, places[:, :5], places[:, 5:])
    np.testing.assert_array_equal(padded_landmark[:, :3], landmark)
    np.testing.assert_array_equal(decision.action[:, :3], expected.action)


def test_the_assignment_is_optimal_and_stays_for_the_episode():
    # The agents see little, which is nothing to the oracle.
    env = Spread(6, 4, max_cycles=5, num_agent_neighbors=1, num_landmark_neighbors=1)
    oracle = scripted.make("oracle", env)
    carry = begin(env, oracle, 16)
    step = jax.jit(lambda carry, key: rollout.step(env, *oracle, env.default_params(), carry, key)[0])
    start, memories = jax.tree.map(np.asarray, carry.env_state), []
    for key in jax.random.split(KEY, 6):
        carry = step(carry, key)
        memories.append(np.asarray(carry.memory))

    first, *same, forgotten, anew = memories  # the fifth step ends the episode
    for later in same:
        np.testing.assert_array_equal(later, first)
    assert (forgotten == scripted.UNASSIGNED).all()
    assert (anew != scripted.UNASSIGNED).all()
    assert (anew != first).any(axis=1).all()

    for positions, landmarks, chosen in zip(start.positions, start.landmarks, first, strict=True):
        if pdist(landmarks).min() > scripted.SHARED_DISTANCE:
            agents, theirs = linear_sum_assignment(cdist(positions, landmarks, "sqeuclidean"))
            np.testing.assert_array_equal(chosen[agents], theirs)
            assert (np.delete(chosen, agents) == -1).all()


def test_landmarks_closer_than_two_discs():
    """0.1 apart they share one agent and the other keeps away; 0.25 apart each gets one, without contact."""
    env = Spread(2, 2)
    oracle = scripted.make("oracle", env)
    positions = jnp.array([[-0.5, 0.1], [0.6, -0.2]])
    landmarks = jnp.array([[[0.0, 0.0], [0.1, 0.0]], [[0.0, 0.0], [0.25, 0.0]]])

    @jax.jit
    def play_on(landmarks):
        states = jax.vmap(at_rest, (None, 0))(positions, landmarks)
        observations = jax.vmap(env.observe, (0, None))(states, env.default_params())
        memories = jnp.broadcast_to(oracle.initial_memory, (2, 2))
        carry = rollout.Carry(states, observations, memories, jnp.ones(2, bool))
        return rollout.collect(env, *oracle, env.default_params(), carry, KEY, 20)[0].env_state.positions

    ends = np.asarray(play_on(landmarks))
    shared, apart = (cdist(*pair) for pair in zip(ends, landmarks, strict=True))
    assert sorted((shared < 0.1).sum(axis=1)) == [0, 2]
    assert sorted((apart < 0.1).sum(axis=1)) == [1, 1]
    assert (apart < 0.1).any(axis=0).all()
    for end in ends:
        assert pdist(end) >= 2 * env.initial_params.physics.agent_radius


def test_moving_landmarks_are_met_where_they_will_be():
    env = Spread(max_cycles=75, initial_params=SpreadParams(landmark_speed=0.25))
    oracle = scripted.make("oracle", env)

    @jax.jit
    def coverage(seen_speed):
        def policy(memory, observation, key, channel):
            state = unpack_state(observation.state, env.num_agents)
            state = state._replace(landmark_velocities=seen_speed * state.landmark_velocities)
            return oracle.policy(memory, observation._replace(state=pack_state(state)), key, channel)

        metrics = evaluate(env, policy, oracle.initial_memory, env.default_params(), KEY, 320)
        return metrics["coverage_mean_0.2"].mean(), metrics["coverage_final_0.1"].mean()

    leading, leading_at_last = coverage(1.0)
    chasing, chasing_at_last = coverage(0.0)
    assert leading >= 0.9
    assert leading >= chasing + 0.015
    assert leading_at_last >= 0.93
    assert chasing_at_last <= 0.2


def test_large_teams_pay_for_the_assignment_once():
    env = Spread(200, 200, initial_params=SpreadParams(arena_scale=8.0))
    oracle = scripted.make("oracle", env)
    start = begin(env, oracle, 2)
    act = jax.jit(jax.vmap(lambda memory, observation: oracle.policy(memory, observation, KEY, QUIET)))

    def fastest(memory):
        times = []
        for _ in range(7):
            begin = time.perf_counter()
            _, after = jax.block_until_ready(act(memory, start.observation))
            times.append(time.perf_counter() - begin)
        return min(times), after

    assigning, landmarks = fastest(start.memory)
    acting, kept = fastest(landmarks)
    np.testing.assert_array_equal(np.sort(landmarks), np.tile(np.arange(200), (2, 1)))
    np.testing.assert_array_equal(kept, landmarks)
    assert acting < 0.6 * assigning
