"""Equations (13) to (16) with the paper's numbers, and the coverage that they follow."""

import jax.numpy as jnp
import numpy as np
import pytest

from gacrl.algorithms.gacrl_paper_exploration import (
    Schedule,
    adaptive_level,
    follow_coverage,
    linear_decay,
    no_coverage,
)

EPISODES = 1500.0
EPSILON = Schedule(0.3, 0.1, 0.2)
TEMPERATURE = Schedule(2.0, 0.7, 0.5)


@pytest.mark.parametrize(
    ("episode", "epsilon", "temperature", "learning_rate"),
    [
        (0, 0.3, 2.0, 5e-4),
        (1, 0.3 - 0.2 / 1500, 2.0 - 1.3 / 1500, 5e-4 - 4e-4 / 1500),
        (750, 0.2, 1.35, 3e-4),
        (1200, 0.14, 0.96, 1.8e-4),
        (1500, 0.1, 0.7, 1e-4),
        (9000, 0.1, 0.7, 1e-4),
    ],
)
def test_levels_fall_linearly_to_their_floor(episode, epsilon, temperature, learning_rate):
    """Equations (15) and (16), and the learning rate, which falls the same way."""
    now = jnp.int32(episode)
    np.testing.assert_allclose(linear_decay(0.3, 0.1, now, EPISODES), epsilon, rtol=1e-5)
    np.testing.assert_allclose(linear_decay(2.0, 0.7, now, EPISODES), temperature, rtol=1e-5)
    np.testing.assert_allclose(linear_decay(5e-4, 1e-4, now, EPISODES), learning_rate, rtol=1e-5)


@pytest.mark.parametrize(
    ("episode", "coverage", "epsilon", "temperature"),
    [
        (0, 0.0, 0.5, 2.5),
        (0, 0.5, 0.4, 2.25),  # "if c = 0.5, the exploration rate increases by 0.2 × (1 - 0.5) = 0.1"
        (0, 1.0, 0.3, 2.0),
        (750, 1 / 3, 0.2 + 0.4 / 3, 1.35 + 1 / 3),
        (1500, 0.0, 0.3, 1.2),
        (1500, 1.0, 0.1, 0.7),
    ],
)
def test_what_is_not_covered_raises_them(episode, coverage, epsilon, temperature):
    """Equations (13) and (14): the bonus stands on top of the floor."""
    now, c = jnp.int32(episode), jnp.float32(coverage)
    np.testing.assert_allclose(adaptive_level(EPSILON, now, EPISODES, c), epsilon, rtol=1e-5)
    np.testing.assert_allclose(adaptive_level(TEMPERATURE, now, EPISODES, c), temperature, rtol=1e-5)


def test_coverage_is_followed_through_two_episodes():
    """Steps of 1/3, 1 and 2/3 in the first episode, then 0 and 1/3 in the second, still running."""
    seen = no_coverage()
    so_far, last = [], []
    for coverage, done in ((1 / 3, False), (1.0, False), (2 / 3, True), (0.0, False), (1 / 3, False)):
        so_far.append(float(seen.signal("episode_so_far")))
        last.append(float(seen.signal("last_episode")))
        seen = follow_coverage(seen, jnp.array([coverage]), jnp.array([done]))
    np.testing.assert_allclose(so_far, [0, 1 / 3, 2 / 3, 0, 0], rtol=1e-6)
    np.testing.assert_allclose(last, [0, 0, 0, 2 / 3, 2 / 3], rtol=1e-6)
    np.testing.assert_allclose(seen.signal("episode_so_far"), 1 / 6, rtol=1e-6)
    assert (int(seen.episode), int(seen.steps)) == (1, 2)


def test_environments_side_by_side_count_by_their_mean():
    seen = follow_coverage(no_coverage(), jnp.array([1.0, 0.0]), jnp.array([False, False]))
    np.testing.assert_allclose(seen.signal("episode_so_far"), 0.5)
    seen = follow_coverage(seen, jnp.array([1.0, 1.0]), jnp.array([True, True]))
    np.testing.assert_allclose(seen.signal("last_episode"), 0.75)
    assert (int(seen.episode), int(seen.steps)) == (2, 0)
