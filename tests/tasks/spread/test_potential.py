"""Shaping by a potential: its value by hand, and that it only lends what it takes back."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gacrl.config import presets
from gacrl.tasks.spread.environment import Spread, params_of
from gacrl.tasks.spread.potential import assignment_potential
from gacrl.tasks.spread.settings import SpreadSettings
from gacrl.training import build

AGENTS = jnp.array([[0.0, 0.0], [1.0, 0.0], [9.0, 9.0]])
LANDMARKS = jnp.array([[-1.0, 0.0], [0.25, 0.0]])


@pytest.mark.parametrize(
    ("agents", "landmarks", "expected"),
    [
        (
            [True, True, True],
            [True, True],
            -(1.0 + 0.75),
        ),  # greedily the first agent would take the nearer landmark
        ([True, False, True], [True, True], -(1.0 + (8.75**2 + 81.0) ** 0.5)),
        ([True, True, False], [False, True], -0.25),
        ([True, False, False], [True, True], -0.25),
    ],
)
def test_the_potential_is_the_best_assignments_distance(agents, landmarks, expected):
    masks = jnp.array(agents), jnp.array(landmarks)
    np.testing.assert_allclose(assignment_potential(AGENTS, LANDMARKS, *masks), expected, rtol=1e-6)


def test_without_masks_all_are_there():
    np.testing.assert_allclose(assignment_potential(AGENTS, LANDMARKS), -1.75, rtol=1e-6)


@pytest.mark.parametrize("terminates", [False, True])
def test_an_episode_pays_back_what_it_was_lent(terminates):
    """Discounted and summed, what is added to MPE2's reward is γᵀ Φ(s_T) − Φ(s_0), or −Φ(s_0) where the task is over."""
    gamma = 0.9
    shaped = Spread(2, 2, max_cycles=30, reward="potential", terminate_on_success=terminates)
    plain, params = replace(shaped, reward="mpe2"), params_of(shaped, gamma)
    step, bare = jax.jit(shaped.step), jax.jit(plain.step)
    state, _ = shaped.reset(jax.random.key(4))
    if terminates:  # a step from both landmarks, at rest
        state = state._replace(
            positions=jnp.array([[0.5, 0.0], [-0.5, 0.0]]), landmarks=jnp.array([[0.55, 0.0], [-0.55, 0.0]])
        )
    before, total, steps = assignment_potential(state.positions, state.landmarks), 0.0, 0
    over = False
    while not over:
        key = jax.random.key(steps)
        action = jax.random.randint(key, (2,), 0, 5)
        _, unshaped = bare(state, action, key, params)
        state, after = step(state, action, key, params)
        added = after.reward - unshaped.reward
        np.testing.assert_allclose(added, added[0], rtol=1e-5, err_msg="the team's, alike for all")
        total += gamma**steps * float(added[0])
        steps += 1
        over = bool(after.terminated | after.truncated)
    assert bool(after.terminated) == terminates
    last = 0.0 if terminates else gamma**steps * float(assignment_potential(state.positions, state.landmarks))
    np.testing.assert_allclose(total, last - float(before), rtol=1e-4)


def test_many_copies_are_shaped_like_one():
    env = Spread(3, 3, reward="potential")
    keys = jax.random.split(jax.random.key(0), 4)
    states, _ = jax.jit(jax.vmap(env.reset))(keys)
    actions = jnp.array([[0, 1, 2], [3, 4, 0], [1, 1, 1], [2, 3, 4]])
    _, together = jax.jit(env.step_many)(states, actions, keys)
    _, alone = jax.jit(jax.vmap(env.step))(states, actions, keys)
    np.testing.assert_allclose(together.reward, alone.reward, rtol=1e-5, atol=1e-6)


def test_training_takes_the_learners_discount():
    config = replace(presets.preset("gacrl"), env=SpreadSettings(reward="potential"))
    found = build.make_trainer(config).params.potential_discount
    np.testing.assert_array_equal(found, np.float32(config.algorithm.gamma))
