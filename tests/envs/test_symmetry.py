"""The square's eight symmetries hold for the whole task: what is turned behaves as what is not."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gacrl.envs.symmetry import NUM_SYMMETRIES, turn_action, turn_vectors
from gacrl.tasks.spread.environment import Spread, SpreadState


def turned(state: SpreadState, symmetry: int) -> SpreadState:
    return state._replace(
        **{name: turn_vectors(getattr(state, name), jnp.asarray(symmetry)) for name in state._fields[:4]}
    )


@pytest.mark.parametrize("continuous", [False, True])
def test_a_turned_world_goes_on_as_the_world_does(continuous: bool):
    env = Spread(num_agents=4, num_landmarks=3, num_agent_neighbors=2, continuous_actions=continuous)
    key = jax.random.key(3)
    state, seen = env.reset(key)
    state = state._replace(velocities=0.3 * jax.random.normal(key, (4, 2)))
    action = jax.random.uniform(key, (4, 5)) if continuous else jnp.array([1, 2, 3, 4])
    straight, after = env.step(state, action, key)
    features = []
    for symmetry in range(NUM_SYMMETRIES):
        moved = env.turn_action(action, jnp.asarray(symmetry))
        there, after_there = env.step(turned(state, symmetry), moved, key)
        for here, expected in zip(there, turned(straight, symmetry), strict=True):
            np.testing.assert_allclose(here, expected, atol=1e-6)
        np.testing.assert_allclose(after_there.reward, after.reward, rtol=1e-5)
        expected = env.turn(after.observation, jnp.asarray(symmetry))
        for here, there in zip(jax.tree.leaves(after_there.observation), jax.tree.leaves(expected), strict=True):
            np.testing.assert_allclose(here, there, atol=1e-6)
        features.append(np.asarray(expected.features).round(5).tobytes())
    assert len(set(features)) == NUM_SYMMETRIES, "they are eight different ones"
    identity = env.turn(seen, jnp.asarray(0))
    np.testing.assert_array_equal(identity.features, seen.features)


def test_a_quarter_turn_and_a_mirror_by_hand():
    np.testing.assert_allclose(turn_vectors(jnp.array([1.0, 2.0, 3.0, 4.0]), jnp.asarray(1)), [-2, 1, -4, 3])
    np.testing.assert_allclose(turn_vectors(jnp.array([1.0, 2.0]), jnp.asarray(4)), [1, -2])
    # none, left, right, down, up; a quarter turn to the left makes left into down.
    np.testing.assert_array_equal(turn_action(jnp.arange(5), jnp.asarray(1), False), [0, 3, 4, 2, 1])
    np.testing.assert_array_equal(turn_action(jnp.arange(5), jnp.asarray(4), False), [0, 1, 2, 4, 3])
    pushes = jnp.array([0.0, 0.1, 0.2, 0.3, 0.4])
    np.testing.assert_allclose(turn_action(pushes, jnp.asarray(1), True), [0.0, 0.4, 0.3, 0.1, 0.2])
