"""IC3Net: a mean over neighbours of whom some are silent, by hand, and the gradient of the gate."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from conftest import drawn

from gacrl.config.algorithms import NetworkConfig
from gacrl.networks import communication
from gacrl.networks.communication import Neighbourhood
from gacrl.tasks.spread.environment import Spread

EVERYONE = ~jnp.eye(3, dtype=bool)
NEAR = Neighbourhood(EVERYONE, jnp.zeros((3, 3, 0)))


def made(width: int = 2, rounds: int = 1) -> Any:
    config = NetworkConfig(width=width, communication="ic3net", rounds=rounds)
    return drawn(communication.make, Spread(3, 2), config)


def with_layer(net: Any, layer: Any, weight: Any, bias: Any) -> Any:
    values = (jnp.asarray(weight, jnp.float32), jnp.asarray(bias, jnp.float32))
    return eqx.tree_at(lambda net: (layer(net).weight, layer(net).bias), net, values)


def by_hand() -> Any:
    """Speaks who has h0 > 0.25; H = 0.5 I, C swaps the two units."""
    net = with_layer(made(), lambda net: net.gate, [[4.0, 0.0]], [-1.0])
    net = with_layer(net, lambda net: net.own[0], 0.5 * np.eye(2), np.zeros(2))
    return with_layer(net, lambda net: net.heard[0], np.eye(2)[::-1], np.zeros(2))


def test_the_mean_counts_who_is_silent():
    hidden = jnp.array([[0.2, 0.6], [0.3, 0.1], [0.5, -0.4]])
    spoken = by_hand().speak(hidden, NEAR, None, 1.0)
    np.testing.assert_allclose(spoken.messages, [[[0, 0], [0.3, 0.1], [0.5, -0.4]]], atol=1e-7)
    # Agent 0 hears both; 1 hears 2 and the silence of 0; 2 hears 1 and that silence.
    means = np.array([[0.4, -0.15], [0.25, -0.2], [0.15, 0.05]])
    np.testing.assert_allclose(spoken.hidden, np.tanh(0.5 * np.asarray(hidden) + means[:, ::-1]), rtol=1e-5)
    loud = hidden.at[0].set(jnp.array([5.0, 5.0]))
    assert np.abs(by_hand().speak(loud, NEAR, None, 1.0).hidden[1] - spoken.hidden[1]).max() > 0.1
    hushed = by_hand().speak(hidden.at[0].set(jnp.array([-5.0, 5.0])), NEAR, None, 1.0)
    np.testing.assert_array_equal(hushed.hidden[1:], spoken.hidden[1:])


def test_closed_gates_are_an_empty_graph():
    """In every round, with noise or without; open ones are CommNet."""
    hidden, key = jax.random.normal(jax.random.key(0), (3, 8)), jax.random.key(1)
    net, empty = made(8, rounds=2), NEAR._replace(adjacency=EVERYONE & False)
    say = eqx.filter_jit(lambda net, near, key: net.speak(hidden, near, key, 0.7))
    shut, open_ = (with_layer(net, lambda net: net.gate, np.zeros((1, 8)), [bias]) for bias in (-50.0, 50.0))
    for draw in (None, key):
        silent = say(shut, NEAR, draw)
        np.testing.assert_array_equal(silent.hidden, say(shut, empty, draw).hidden)
        assert (silent.messages == 0).all()
        assert np.abs(say(open_, NEAR, draw).hidden - silent.hidden).max() > 1e-2
    plain = drawn(communication.make, Spread(3, 2), NetworkConfig(width=8, communication="commnet", rounds=2))
    plain = eqx.tree_at(lambda net: (net.own, net.heard), plain, (net.own, net.heard))
    np.testing.assert_allclose(say(plain, NEAR, None).hidden, say(open_, NEAR, None).hidden, atol=1e-6)


def test_the_gate_learns_from_what_it_lets_through():
    """Open or shut, its gradient is that of a sigmoid at temperature τ, times what the hearer would hear."""
    net, temperature = by_hand(), 0.5
    hidden = jnp.array([[0.0, 0.0], [0.2, 0.6], [0.5, -0.4]])  # 1 is silent, 2 speaks

    def heard(bias: jax.Array) -> jax.Array:
        gated = eqx.tree_at(lambda net: net.gate.bias, net, bias)
        return gated.speak(
            hidden, NEAR._replace(adjacency=EVERYONE.at[:, 2].set(False)), None, temperature
        ).hidden[0]

    logit = 4 * 0.2 - 1
    chance = 1 / (1 + np.exp(-logit / temperature))
    expected = (
        np.array([0.6, 0.2]) * chance * (1 - chance) / temperature
    )  # tanh' = 1: agent 0 has and hears nothing
    np.testing.assert_allclose(jax.jacobian(heard)(net.gate.bias)[:, 0], expected, rtol=1e-5)


def test_the_order_of_agents_does_not_matter():
    net, order = made(8, rounds=2), np.array([2, 0, 1])
    net = with_layer(net, lambda net: net.gate, net.gate.weight, net.gate.bias + 2.0)
    hidden, graph = jax.random.normal(jax.random.key(5), (3, 8)), EVERYONE.at[0, 1].set(False)
    say = eqx.filter_jit(lambda hidden, graph: net.speak(hidden, NEAR._replace(adjacency=graph), None, 1.0).hidden)
    assert 0 < (np.asarray(net.gate(hidden)) > 0).sum() < 3
    np.testing.assert_allclose(say(hidden[order], graph[order][:, order]), say(hidden, graph)[order], atol=1e-6)
