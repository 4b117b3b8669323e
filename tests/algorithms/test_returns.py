"""Advantages and n-step returns: by hand, and as rlax has them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import rlax

from gacrl import rollout, tasks
from gacrl.algorithms.returns import generalised_advantages, n_step_returns, next_values
from gacrl.evaluation.references import random
from gacrl.tasks.spread.environment import Spread

T = 12
KEY = jax.random.key(1)


def test_advantages_by_hand():
    """γ = ½, λ = ½: an episode that terminates after two steps, and one that is cut off after one."""
    reward, value = jnp.array([1.0, 2.0, 3.0]), jnp.array([0.5, 1.0, 2.0])
    next_value = jnp.array([1.0, 100.0, 4.0])
    terminated, truncated = jnp.array([False, True, False]), jnp.array([False, False, True])
    found = generalised_advantages(reward, value, next_value, terminated, truncated, 0.5, 0.5)
    # δ = 1 + ½·1 − ½ = 1;  2 − 1 = 1 (nothing follows);  3 + ½·4 − 2 = 3 (bootstrapped)
    np.testing.assert_allclose(found, [1 + 0.25 * 1, 1, 3])


@pytest.mark.parametrize(
    ("time_limits", "asked", "expected"),
    [
        ([3, 7], [3, 7, 9], [11, 12, 13, 103, 15, 16, 17, 107, 19, 109]),  # episodes of 4 steps, cut at the end
        ([], [9], [11, 12, 13, 14, 15, 16, 17, 18, 19, 109]),
    ],
)
def test_next_values_are_computed_where_they_are_not_known(
    time_limits: list[int], asked: list[int], expected: list[int]
):
    rows: list[list[int]] = []

    def anew(at: jnp.ndarray) -> jnp.ndarray:
        rows.append(np.asarray(at).tolist())
        return 100.0 + at[:, None]

    truncated = jnp.zeros(10, bool).at[jnp.asarray(time_limits, int)].set(True)
    found = next_values(10.0 + jnp.arange(10.0)[:, None], truncated, 4, anew)
    assert sorted(set(rows[0])) == asked and len(rows[0]) == 4, "three time limits and the end fit ten steps"
    np.testing.assert_array_equal(found[:, 0], expected)


def test_every_end_has_its_own_next_value_where_episodes_end_at_any_step():
    """V(s_t) = t, and 1,000 + t for what follows step t: steps 0 to 4 are truncated, and so is the last."""
    truncated = jnp.zeros(10, bool).at[jnp.arange(5)].set(True)
    found = next_values(jnp.arange(10.0)[:, None], truncated, 1, lambda at: 1000.0 + at[:, None])
    np.testing.assert_array_equal(found[:, 0], 1000.0 + np.arange(10))


@pytest.mark.parametrize("collisions", ["truncate", "off"])
def test_no_end_of_a_task_is_bootstrapped_with_the_value_of_its_own_step(collisions: str):
    """25 steps of 64 copies of spread, played at random where agents often touch."""
    env = Spread(reset_on_collision=collisions, reset_distance=0.3, arena_scale=0.5)
    policy, memory = random(env)
    start = rollout.start(env, env.default_params(), memory, jax.random.key(0), 64)
    collect = jax.jit(lambda start: rollout.collect(env, policy, memory, env.default_params(), start, KEY, 25)[1])
    truncated = collect(start).transitions.truncated
    own = jnp.arange(25.0)[:, None]

    def after(truncated: jax.Array) -> jax.Array:
        return next_values(own, truncated, env.shortest_truncated, lambda at: 1000.0 + at[:, None])

    found = np.asarray(jax.vmap(after, 1, 1)(truncated))[..., 0]
    ends = np.asarray(truncated)
    assert ends.sum() == 64 if collisions == "off" else ends.sum() > 128
    np.testing.assert_array_equal(found[ends], 1000.0 + np.nonzero(ends)[0])


def test_n_step_returns_by_hand():
    reward = jnp.array([1.0, 2.0, 4.0, 8.0, 16.0])
    next_value = jnp.array([10.0, 20.0, 30.0, 40.0, 50.0])
    terminated = jnp.array([False, False, True, False, False])
    truncated = jnp.array([False, False, False, True, False])
    found = n_step_returns(reward, next_value, terminated, truncated, 0.5, 2)
    # Two rewards and a bootstrap; up to the end of the task; the end itself; up to the time limit; the last step.
    np.testing.assert_allclose(found, [1 + 1 + 0.25 * 20, 2 + 2, 4, 8 + 20, 16 + 25])


@pytest.mark.parametrize("gae_lambda", [0.0, 0.7, 1.0])
def test_advantages_are_those_of_rlax(gae_lambda: float):
    numbers = np.random.default_rng(0)
    reward, values = numbers.normal(size=T), numbers.normal(size=T + 1)
    terminated = jnp.asarray(numbers.random(T) < 0.2)
    expected = rlax.truncated_generalized_advantage_estimation(
        jnp.asarray(reward), 0.9 * (1.0 - terminated), gae_lambda, jnp.asarray(values)
    )
    none = jnp.zeros(T, bool)
    found = generalised_advantages(
        jnp.asarray(reward),
        jnp.asarray(values[:-1]),
        jnp.asarray(values[1:]),
        terminated,
        none,
        0.9,
        gae_lambda,
    )
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("n", [1, 3, 20])
def test_n_step_returns_are_those_of_rlax(n: int):
    numbers = np.random.default_rng(n)
    reward, next_value = jnp.asarray(numbers.normal(size=T)), jnp.asarray(numbers.normal(size=T))
    terminated = jnp.asarray(numbers.random(T) < 0.2)
    expected = rlax.n_step_bootstrapped_returns(reward, 0.9 * (1.0 - terminated), next_value, n)
    found = n_step_returns(reward, next_value, terminated, jnp.zeros(T, bool), 0.9, n)
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6)


def test_a_cut_off_step_is_bootstrapped_wherever_it_stands():
    """A long chain of rewards 1 and the true value 1 / (1 − γ) everywhere: every target is that value."""
    reward, value = jnp.ones(T), jnp.full(T, 10.0)
    truncated = jnp.arange(T) % 5 == 4
    none = jnp.zeros(T, bool)
    for n in (1, 2, 7):
        found = n_step_returns(reward, value, none, truncated, 0.9, n)
        np.testing.assert_allclose(found, 10.0, rtol=1e-5)
    found = generalised_advantages(reward, value, value, none, truncated, 0.9, 0.95)
    np.testing.assert_allclose(found, 0.0, atol=1e-5)


@pytest.mark.parametrize("name", ["spread", "speaker_listener", "reference", "colours", "traffic_junction"])
def test_where_only_the_time_limit_truncates_few_values_are_computed(name: str):
    env = tasks.find(name).make(tasks.default_settings(name))
    assert env.shortest_truncated == env.max_cycles > 1
