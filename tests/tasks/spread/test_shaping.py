"""Equation (1), with numbers worked out by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gacrl.tasks.spread.environment import Spread, SpreadState
from gacrl.tasks.spread.shaping import paper_shaped_reward

# Proximity 10 (1 - d/2)^2: 7.65625, 2.5, and 2.5 once more at d = 3, as the bracket's sign is lost.
# Coverage 3 (1 - d/θ) within θ = 0.5: 1.5, 0, 0.
LANDMARK_DISTANCE = jnp.array([0.25, 1.0, 3.0])
BONUS = 7.65625 + 2.5 + 2.5 + 1.5


@pytest.mark.parametrize(
    ("agent_distance", "per_agent", "once"),
    [
        ([0.1, 0.1, 0.7], 2, 1),
        ([0.1, 0.15, 0.19], 3, 1),
        ([0.2, 0.2, 0.25], 0, 0),
        ([np.inf, np.inf, np.inf], 0, 0),
    ],
)
def test_both_readings_of_the_collision_term(agent_distance, per_agent, once):
    agent_distance = jnp.array(agent_distance)
    for term, penalty in (("per_agent", per_agent), ("once", once)):
        shaped = paper_shaped_reward(
            jnp.float32(-1.25), LANDMARK_DISTANCE, agent_distance, 0.5, collision_term=term
        )
        np.testing.assert_allclose(shaped, -1.25 + BONUS - penalty, rtol=1e-6)


def test_threshold_is_open_and_moves_the_bonus():
    distance = jnp.array([0.25])
    alone = jnp.array([jnp.inf])
    # At the threshold the bonus is 0 from both sides; at half of it, half of 3.
    for threshold, coverage in ((0.2, 0.0), (0.25, 0.0), (0.5, 1.5), (1.0, 2.25)):
        shaped = paper_shaped_reward(jnp.float32(0.0), distance, alone, threshold)
        np.testing.assert_allclose(shaped, 7.65625 + coverage, rtol=1e-6)


def test_running_away_is_paid_as_printed():
    def shaped(distance):
        return paper_shaped_reward(jnp.float32(0.0), jnp.array([distance]), jnp.array([jnp.inf]), 0.5)

    np.testing.assert_allclose(shaped(2.0), 0.0, atol=1e-6)
    np.testing.assert_allclose(shaped(4.0), 10.0, rtol=1e-6)
    np.testing.assert_allclose(shaped(0.0), 13.0, rtol=1e-6)
    np.testing.assert_allclose(shaped(5.0), 22.5, rtol=1e-6)


def test_padded_agents_add_nothing():
    shaped = paper_shaped_reward(
        jnp.float32(-1.0),
        LANDMARK_DISTANCE,
        jnp.array([0.5, 0.1, 0.1]),
        0.5,
        agent_mask=jnp.array([True, False, True]),
    )
    np.testing.assert_allclose(shaped, -1.0 + 7.65625 + 1.5 + 2.5 - 1.0, rtol=1e-6)


@pytest.mark.parametrize(("term", "penalty"), [("per_agent", 2.0), ("once", 1.0)])
def test_spread_pays_it_to_every_agent(term, penalty):
    """Three resting agents: where they stand after a step that nobody kicks is where they stood.

    Agents at (0, 0), (0.125, 0), (1, 1); landmarks at (0, 0.25), (1, 1.5). Nearest landmark of each agent:
    0.25, sqrt(5)/8, 0.5. Nearest agent of each landmark: 0.25 and 0.5. One touching pair.
    """
    state = SpreadState(
        positions=jnp.array([[0.0, 0.0], [0.125, 0.0], [1.0, 1.0]]),
        velocities=jnp.zeros((3, 2)),
        landmarks=jnp.array([[0.0, 0.25], [1.0, 1.5]]),
        landmark_velocities=jnp.zeros((2, 2)),
        clock=jnp.int32(0),
    )
    env = Spread(3, 2, reward="paper", collision_term=term)
    params = env.default_params()._replace(local_ratio=jnp.float32(0.1), coverage_threshold=jnp.float32(0.4))
    second = np.sqrt(5) / 8
    raw = 0.1 * -(1 + 1 + 0) / 3 - 0.9 * (0.25 + 0.5)
    proximity = 10 * (0.875**2 + (1 - second / 2) ** 2 + 0.75**2)
    coverage = 3 * (1 - 0.25 / 0.4) + 3 * (1 - second / 0.4)
    shaped = raw + proximity + coverage - penalty

    _, result = jax.jit(env.step)(state, jnp.zeros(3, int), jax.random.key(0), params)
    np.testing.assert_allclose(result.reward, np.full(3, shaped), rtol=1e-6)
    np.testing.assert_allclose(result.info["reward_shaped"], shaped, rtol=1e-6)
    # The metric stays at MPE2's ratio whatever the learner trains on.
    np.testing.assert_allclose(result.info["reward_raw"], 0.5 * -2 / 3 - 0.5 * 0.75, rtol=1e-6)
