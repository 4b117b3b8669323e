"""Equations (3), (4), (7), (9) by hand, the graph that is left where edges are cut, and what arrives of words."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gacrl.envs.environment import observe
from gacrl.errors import ConfigError
from gacrl.networks.arrives import arriving
from gacrl.networks.encoder import kl_divergence, sample_latent
from gacrl.networks.graph import (
    attend,
    attend_to_speakers,
    heard_adjacency,
    nearest_speakers,
    neighbour_sum,
    proximity_adjacency,
)
from gacrl.networks.messages import gumbel_sigmoid, gumbel_softmax, most_likely_symbol
from gacrl.types import Arrives

V, N = 4, 3
MESSAGES = jax.nn.softmax(jnp.asarray(np.random.default_rng(0).normal(size=(V, N)), jnp.float32), axis=0)


def test_reparameterisation_by_hand():
    """(3): standard deviation is exp(½ log σ²): 2 at variance 4, ⅓ at variance 1/9."""
    z = sample_latent(jnp.array([1.0, -1.0]), jnp.log(jnp.array([4.0, 1 / 9])), jnp.array([0.5, -3.0]))
    np.testing.assert_allclose(z, [2.0, -2.0], rtol=1e-6)


def test_kl_divergence_of_known_gaussians():
    mean, variance = jnp.array([[0.0, 0.0], [3.0, 0.0]]), jnp.array([[1.0, 1.0], [1.0, 2.0]])
    np.testing.assert_allclose(
        kl_divergence(mean, jnp.log(variance)), [0.0, 4.5 + 0.5 * (1 - np.log(2))], atol=1e-6
    )


def test_graph_by_hand():
    """(4): nearer than 1.5, 1.5 itself is not; no self edges. Agents on a line at 0, 1.5 and 2.75."""
    positions = jnp.array([[0.0, 0.0], [1.5, 0.0], [2.75, 0.0]])
    everyone = jnp.ones(3, bool)
    near = proximity_adjacency(positions, everyone, 1.5)
    np.testing.assert_array_equal(near, [[0, 0, 0], [0, 0, 1], [0, 1, 0]])
    near = proximity_adjacency(positions, everyone, 1.6)
    np.testing.assert_array_equal(near, [[0, 1, 0], [1, 0, 1], [0, 1, 0]])
    near = proximity_adjacency(positions, jnp.array([True, False, True]), 9.0)
    np.testing.assert_array_equal(near, [[0, 0, 1], [0, 0, 0], [1, 0, 0]])


def test_neighbour_sum_by_hand():
    """(7): row i of A picks the j that i sums over; a plain sum, the same for one neighbour or two."""
    m = jnp.array([[1.0, 20.0, 300.0], [0.5, 0.25, 0.125]])
    adjacency = jnp.array([[False, True, True], [False, False, True], [False, False, False]])
    np.testing.assert_array_equal(neighbour_sum(m, adjacency), [[320, 300, 0], [0.375, 0.125, 0]])


def test_gumbel_softmax_by_hand():
    """(9): (logits + noise)/τ = (0, ln 2, ln 5)."""
    logits, noise = jnp.array([1.0, 0.0, -1.0]), jnp.array([-1.0, 2 * np.log(2), 1 + 2 * np.log(5)])
    np.testing.assert_allclose(gumbel_softmax(logits, noise, 2.0), [1 / 8, 2 / 8, 5 / 8], rtol=1e-6)
    # A higher temperature softens, a lower one sharpens: (0, ½ ln 2, ½ ln 5), (0, 2 ln 2, 2 ln 5).
    for temperature, weights in ((4.0, np.sqrt([1, 2, 5])), (1.0, np.array([1, 4, 25]))):
        np.testing.assert_allclose(gumbel_softmax(logits, noise, temperature), weights / weights.sum(), rtol=1e-5)


def test_straight_through_is_one_hot_with_the_soft_gradient():
    logits, noise = jnp.array([1.0, 0.0, -1.0]), jnp.array([0.0, 3.0, 0.5])
    cotangent = jnp.array([3.0, -1.0, 2.0])
    soft, soft_pullback = jax.vjp(lambda x: gumbel_softmax(x, noise, 1.5), logits)
    hard, hard_pullback = jax.vjp(lambda x: gumbel_softmax(x, noise, 1.5, True), logits)
    np.testing.assert_allclose(hard, [0, 1, 0], atol=1e-6)
    assert hard.argmax() == soft.argmax() != logits.argmax()
    np.testing.assert_array_equal(hard_pullback(cotangent)[0], soft_pullback(cotangent)[0])
    # The softmax's own: p (g - p · g) / τ.
    p, g = np.asarray(soft, np.float64), np.asarray(cotangent, np.float64)
    np.testing.assert_allclose(soft_pullback(cotangent)[0], p * (g - p @ g) / 1.5, rtol=1e-5)


def test_most_likely_symbol():
    np.testing.assert_array_equal(
        most_likely_symbol(jnp.array([[0.0, 2.0, 1.0], [5.0, 2.0, 1.0]])), [[0, 1, 0], [1, 0, 0]]
    )


def test_a_gate_opens_as_often_as_its_sigmoid_and_learns_by_the_soft_one():
    logits = jnp.array([-1.0, 0.5, 3.0])
    noise = jax.random.logistic(jax.random.key(0), (4_000, 3))
    for temperature in (0.3, 2.0):
        opened = gumbel_sigmoid(jnp.broadcast_to(logits, noise.shape), noise, temperature)
        np.testing.assert_allclose(opened, opened.round(), atol=1e-6)
        chance = 1 / (1 + np.exp(-np.asarray(logits)))
        assert np.abs(opened.mean(0) - chance).max() < 5 * np.sqrt(0.25 / 4_000)
        slope = jax.grad(lambda logits: gumbel_sigmoid(logits, noise[0], temperature).sum())(logits)  # noqa: B023
        soft = 1 / (1 + np.exp(-np.asarray(logits + noise[0]) / temperature))
        np.testing.assert_allclose(slope, soft * (1 - soft) / temperature, rtol=1e-4)
    np.testing.assert_array_equal(gumbel_sigmoid(logits, None, 1.0), [0, 1, 1])


# Attention to those who spoke.

VALUES = jnp.array([[[1.0, 2.0], [3.0, 5.0], [-1.0, 4.0]]])
SCORE = jnp.log(jnp.array([[1.0, 3.0, 2.0]]))


def test_who_is_silent_is_as_a_cut_edge():
    """Whatever the scores; and exactly nothing is heard where nobody spoke."""
    for score in (SCORE, SCORE * 100, SCORE.at[0, 1].set(-jnp.inf)):
        for spoke in ([1.0, 1.0, 1.0], [1.0, 0.0, 1.0], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]):
            spoke = jnp.array([spoke])
            expected = attend(VALUES, jnp.where(spoke > 0, score, -jnp.inf))
            np.testing.assert_allclose(attend_to_speakers(VALUES, score, spoke), expected, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(
    ("spoke", "shares"),
    [
        ([1.0, 1.0, 0.0], [1 / 4, 3 / 4, 2 / 6]),  # the third would have 2 of 1 + 3 + 2
        ([0.0, 1.0, 0.0], [1 / 4, 1.0, 2 / 5]),
        ([0.0, 0.0, 0.0], [1.0, 1.0, 1.0]),
    ],
)
def test_whether_to_speak_has_the_gradient_of_what_would_be_heard(spoke: list[float], shares: list[float]):
    slope = jax.jacobian(lambda spoke: attend_to_speakers(VALUES, SCORE, spoke)[0])(jnp.array([spoke]))[:, 0]
    np.testing.assert_allclose(slope, np.asarray(VALUES)[0].T * shares, rtol=1e-5)
    away = SCORE.at[0, 2].set(-jnp.inf)
    slope = jax.jacobian(lambda spoke: attend_to_speakers(VALUES, away, spoke)[0])(jnp.array([spoke]))[:, 0]
    assert np.isfinite(slope).all() and (slope[:, 2] == 0).all()


# Edges, and what arrives along them.


def test_a_cut_edge_is_no_edge_one_way():
    """0 hears nothing of 2; 2 still hears 0. In a graph of the task, of distance, and of everyone."""
    kept = jnp.ones((3, 3), bool).at[0, 2].set(False)
    everyone = ~np.eye(3, dtype=bool)
    prescribed = jnp.array([[False, True, True], [False, False, True], [True, False, False]])
    places = jnp.array([[0.0, 0.0], [5.0, 0.0], [1.0, 0.0]])
    features = jnp.zeros((3, 1))
    for seen, graph in (
        (observe(features, num_actions=1), everyone),
        (observe(features, num_actions=1, adjacency=prescribed), np.asarray(prescribed)),
        (observe(features, num_actions=1, positions=places), [[0, 0, 1], [0, 0, 0], [1, 0, 0]]),
    ):
        np.testing.assert_array_equal(heard_adjacency(seen, 1.5), graph)
        cut = np.array(graph, bool)
        cut[0, 2] = False
        found = heard_adjacency(seen._replace(arrives=Arrives(kept=kept)), 1.5)
        np.testing.assert_array_equal(found, cut)
        m = jnp.array([[1.0, 20.0, 300.0]])
        np.testing.assert_array_equal(neighbour_sum(m, found), m @ cut.T)


def test_the_nearest_speakers_are_the_nearest_along_the_edges():
    """On a line at 0, 1, 3 and 7; agent 0 does not hear agent 1."""
    places = jnp.array([[0.0, 0.0], [1.0, 0.0], [3.0, 0.0], [7.0, 0.0]])
    graph = (~jnp.eye(4, dtype=bool)).at[0, 1].set(False)
    np.testing.assert_array_equal(nearest_speakers(places, graph, 2), [[2, 3], [0, 2], [1, 0], [2, 1]])
    np.testing.assert_array_equal(nearest_speakers(None, graph, 2), [[2, 3], [0, 2], [0, 1], [0, 1]])


def test_what_arrives_by_default_is_what_was_said():
    for arrives in (Arrives(), Arrives(kept=jnp.zeros((N, N), bool))):  # a cut edge is the graph's
        np.testing.assert_array_equal(arriving(MESSAGES.T, arrives), MESSAGES.T)


def test_what_arrives_is_of_the_round_and_of_whom_it_is_marked():
    values = jnp.arange(2.0 * N * V).reshape(2, N, V)
    np.testing.assert_array_equal(arriving(MESSAGES.T, Arrives(values), 1, 2), values[1])
    marks = jnp.array([[True, False, False], [False, True, True]])
    expected = np.stack([MESSAGES.T[0], values[1, 1], values[1, 2]])
    np.testing.assert_array_equal(arriving(MESSAGES.T, Arrives(values, marks), 1, 2), expected)
    with pytest.raises(ConfigError, match=r"what arrives must be .* = \[1, 3, 4\], not \[2, 3, 4\]"):
        arriving(MESSAGES.T, Arrives(values))
