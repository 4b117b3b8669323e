"""Equations (3), (4), (7), (9) by hand, and what a channel does to messages."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gacrl.networks.encoder import kl_divergence, sample_latent
from gacrl.networks.graph import neighbour_sum, proximity_adjacency
from gacrl.networks.messages import gumbel_softmax, mailbox, most_likely_symbol, transmit
from gacrl.types import Channel

V, N = 4, 3
MESSAGES = jax.nn.softmax(jnp.asarray(np.random.default_rng(0).normal(size=(V, N)), jnp.float32), axis=0)
SYMBOLS = jnp.eye(V)[:, jnp.array([2, 0, 3])]


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
    np.testing.assert_array_equal(neighbour_sum(m, adjacency, Channel()), [[320, 300, 0], [0.375, 0.125, 0]])
    cut = Channel(edge_keep=jnp.ones((3, 3)).at[0, 2].set(0.0))
    np.testing.assert_array_equal(neighbour_sum(m, adjacency, cut), [[20, 300, 0], [0.25, 0.125, 0]])


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


# The channel. Entry [:, i, j] of what transmit returns is j's message as it reaches i.


def test_default_channel_changes_no_bit():
    received, memory = transmit(MESSAGES, Channel())
    assert memory == ()
    for i in range(N):
        np.testing.assert_array_equal(received[:, i, :], MESSAGES)


def test_edge_keep_silences_one_way():
    """0 hears nothing of 2; 2 still hears 0."""
    keep = jnp.ones((N, N)).at[0, 2].set(0.0)
    received, _ = transmit(MESSAGES, Channel(edge_keep=keep))
    np.testing.assert_array_equal(received[:, 0, 2], np.zeros(V))
    for i, j in ((2, 0), (0, 1), (1, 2)):
        np.testing.assert_array_equal(received[:, i, j], MESSAGES[:, j])


def test_symbol_map_translates_each_sender_apart():
    """Sender 0's symbol v arrives as v + 1 (mod 4), 1's unchanged, 2's as any of the four."""
    shift = np.roll(np.eye(V), 1, axis=1)
    maps = jnp.asarray(np.stack([shift, np.eye(V), np.full((V, V), 1 / V)]), jnp.float32)
    received, _ = transmit(SYMBOLS, Channel(symbol_map=maps))
    for i in range(N):
        np.testing.assert_array_equal(received[:, i, :].T, [[0, 0, 0, 1], [1, 0, 0, 0], [1 / V] * V])
    received, _ = transmit(MESSAGES, Channel(symbol_map=maps))
    np.testing.assert_array_equal(received[:, 1, 0], np.roll(MESSAGES[:, 0], 1))


def test_delay_is_exactly_that_many_steps():
    """Step t says t + 1; delayed by d, t + 1 - d arrives, and silence before the start."""
    for delay, arrived in ((0, [1, 2, 3, 4]), (1, [0, 1, 2, 3]), (2, [0, 0, 1, 2])):
        memory, heard = mailbox(N, V, 2), []
        for t in range(4):
            said = jnp.full((V, N), t + 1.0)
            received, memory = transmit(said, Channel(delay=jnp.int32(delay)), memory=memory)
            assert np.ptp(received) == 0
            heard.append(float(received[0, 0, 0]))
        assert heard == arrived


def test_channels_that_lack_something_say_so():
    with pytest.raises(ValueError, match="mailbox"):
        transmit(MESSAGES, Channel(delay=jnp.int32(1)))
    with pytest.raises(ValueError, match="random key"):
        transmit(MESSAGES, Channel(noise=jnp.float32(0.5)))


def test_noise_replaces_messages_by_uniform_symbols():
    """At 1 every message is a random symbol; at 0.25 a quarter of them are, the rest arrives as sent."""
    keys = jax.random.split(jax.random.key(0), 4_000)
    send = jax.jit(lambda noise: jax.vmap(lambda key: transmit(MESSAGES, Channel(noise=noise), key)[0])(keys))
    received = np.asarray(send(jnp.float32(1.0)))
    assert (received.sum(1) == 1).all() and (received.max(1) == 1).all()
    # One broken message for all who hear it.
    np.testing.assert_array_equal(received[:, :, 0], received[:, :, 1])
    for j in range(N):
        counts = received[:, :, 0, j].sum(0)
        assert ((counts - 1_000) ** 2 / 1_000).sum() < 21.1  # the 0.9999 quantile at 3 degrees of freedom

    intact = (np.asarray(send(jnp.float32(0.25)))[:, :, 0, :] == np.asarray(MESSAGES)).all(1)
    assert abs(intact.mean() - 0.75) < 5 * np.sqrt(0.75 * 0.25 / intact.size)
    intact = (np.asarray(send(jnp.float32(0.0)))[:, :, 0, :] == np.asarray(MESSAGES)).all()
    assert intact
