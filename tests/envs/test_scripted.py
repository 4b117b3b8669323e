"""The scripted policies reach what is known of them, and the oracle copes with every shape of the task."""

import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

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


def at_rest(positions, landmarks) -> SpreadState:
    positions, landmarks = jnp.asarray(positions, jnp.float32), jnp.asarray(landmarks, jnp.float32)
    return SpreadState(
        positions, jnp.zeros_like(positions), landmarks, jnp.zeros_like(landmarks), jnp.int32(0)
    )


def test_an_unknown_name_is_refused():
    with pytest.raises(ValueError, match="no scripted policy 'orcale', only random, noop, oracle"):
        scripted.make("orcale", Spread())


# What the task of MPE2 gives them: three agents, 25 steps


@pytest.mark.parametrize(("name", "known"), [("random", -26.2), ("noop", -24.0)])
def test_floors(name, known):
    returns = play(Spread(), scripted.make(name, Spread()), 2048)["return_agent_mean"]
    assert returns.mean() == pytest.approx(known, abs=3 * returns.std() / len(returns) ** 0.5)


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
    _, observation = env.reset(KEY)
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
    # What the agents see does not matter; episodes end after 5 steps, or earlier by a collision.
    env = Spread(8, 5, max_cycles=5, num_agent_neighbors=1, num_landmark_neighbors=1, reset_on_collision="truncate")
    oracle = scripted.make("oracle", env)
    params = env.default_params()

    @jax.jit
    def step(carry, key):
        return rollout.step(env, *oracle, params, carry, key)

    checked = 0
    carry = rollout.start(env, params, oracle.initial_memory, KEY, 8)
    landmark = np.full((8, 8), np.nan)
    for key in jax.random.split(KEY, 12):
        before = carry
        carry, transition = step(carry, key)
        for one in range(8):
            if carry.first[one]:  # reset: forgotten
                assert (carry.memory[one] == scripted.UNASSIGNED).all()
                continue
            if not before.first[one]:
                np.testing.assert_array_equal(carry.memory[one], landmark[one])
                continue
            landmark[one] = carry.memory[one]
            state = unpack_state(transition.observation.state[one], 8)
            ...
