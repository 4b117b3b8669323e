"""Many copies at once: the numbers of each by itself, whatever ends the episodes."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gacrl import rollout
from gacrl.envs import copies
from gacrl.envs.probes import Probe
from gacrl.evaluation.episodes import record_many
from gacrl.evaluation.evaluate import evaluate
from gacrl.evaluation.references import random
from gacrl.tasks.spread.environment import Spread

E = 6
KEY = jax.random.key(0)
MASKS = {"agent_mask": jnp.array([True, True, True, False]), "landmark_mask": jnp.array([True, False, True])}


@pytest.mark.parametrize(
    ("env", "masks"),
    [
        (Spread(), {}),
        (Spread(5, 5, num_agent_neighbors=2, num_landmark_neighbors=7), {}),
        (Spread(4, 3, reward="coverage", reset_on_collision="in_place"), MASKS),
        (
            Spread(
                reward="paper", continuous_actions=True, reset_on_collision="truncate", terminate_on_success=True
            ),
            {},
        ),
    ],
    ids=["standard", "neighbours", "padded", "continuous"],
)
def test_a_step_of_many_is_the_step_of_each(env, masks):
    params = env.default_params()._replace(landmark_speed=0.3, reset_distance=0.4, **masks)
    mapped = jax.jit(jax.vmap(env.step, (0, 0, 0, None)))
    at_once = jax.jit(env.step_many)
    look = jax.jit(env.observe_many)
    state, _ = jax.jit(lambda keys: copies.reset(env, params, keys))(jax.random.split(KEY, E))
    for key in jax.random.split(KEY, 8):
        action_key, step_key = jax.random.split(key)
        keys = jax.random.split(step_key, E)
        if env.continuous_actions:
            action = jax.random.uniform(action_key, (E, env.num_agents, 5))
        else:
            action = jax.random.randint(action_key, (E, env.num_agents), 0, 5)
        theirs, ours = mapped(state, action, keys, params), at_once(state, action, keys, params)
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=2e-6), ours, theirs)
        assert jax.tree.map(jnp.shape, ours) == jax.tree.map(jnp.shape, theirs)
        seen, after = look(theirs[0], params), theirs[1].observation
        jax.tree.map(np.testing.assert_array_equal, seen, after)
        state = theirs[0]


def test_copies_begin_anew_where_their_episode_is_over_and_only_there():
    env = dataclasses.replace(Spread(), max_cycles=3)
    params = env.default_params()
    state, _ = copies.reset(env, params, jax.random.split(KEY, E))
    state = state._replace(clock=jnp.array([0, 1, 2, 2, 0, 1], jnp.int32))
    action = jnp.zeros((E, 3), jnp.int32)
    going_on, seen, after = jax.jit(lambda state, key: copies.step(env, params, state, action, key))(state, KEY)
    np.testing.assert_array_equal(after.truncated, [False, False, True, True, False, False])
    np.testing.assert_array_equal(going_on.clock, [1, 2, 0, 0, 1, 2])
    stayed = (going_on.landmarks == state.landmarks).all((1, 2))
    np.testing.assert_array_equal(stayed, ~after.truncated)
    assert (going_on.landmarks[2] != going_on.landmarks[3]).all(), "two new episodes alike"
    same = (seen.features == after.observation.features).all((1, 2))
    np.testing.assert_array_equal(same, ~after.truncated)
    np.testing.assert_array_equal(seen.features, env.observe_many(going_on, params).features)


def test_a_task_that_knows_no_quicker_way_is_mapped():
    env = Probe("value")
    params = env.default_params()
    state, first = copies.reset(env, params, jax.random.split(KEY, E))
    action = jnp.zeros((E, env.num_agents), jnp.int32)
    step = jax.jit(lambda state, key: copies.step(env, params, state, action, key))
    for key in jax.random.split(KEY, 3):
        state, seen, after = step(state, key)
        assert after.reward.shape == (E, env.num_agents)
        assert seen.features.shape == first.features.shape


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    "kind", [pytest.param(jnp.asarray, marks=pytest.mark.soak), pytest.param(np.asarray, marks=pytest.mark.slow)]
)
def test_keys_that_are_numbers_draw_what_keys_draw(kind: Any):
    """What `jax.random.PRNGKey` makes is an array of two numbers, and no two copies of anything."""
    env = Spread(3, 2, reset_on_collision="in_place", reset_distance=5.0)
    params, (policy, memory) = env.default_params(), random(env)

    def drawn(key: Any) -> Any:
        state, seen = env.reset(key)
        keys = jax.random.split(key, E)
        states, _ = jax.vmap(env.reset)(keys)
        carry = rollout.start(env, params, memory, key, E)
        return (
            (seen, env.step(state, jnp.zeros(3, int), key), env.step_many(states, jnp.zeros((E, 3), int), keys)),
            rollout.collect(env, policy, memory, params, carry, key, 3),
            record_many(env, policy, memory, params, key, 1)[0].reward,
            evaluate(env, policy, memory, params, key, 2),
        )

    found, expected = drawn(kind(jax.random.PRNGKey(0))), drawn(jax.random.key(0))
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_array_equal(one, other)
