"""TarMAC: whom receivers attend to, by hand."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from conftest import drawn

from gacrl.config.algorithms import NetworkConfig
from gacrl.networks import communication
from gacrl.networks.communication import Neighbourhood
from gacrl.tasks.spread.environment import Spread


def near(graph: jax.Array) -> Neighbourhood:
    return Neighbourhood(graph, jnp.zeros((*graph.shape, 0)))


def test_receivers_weigh_values_by_query_and_signature():
    """Signatures and values of two numbers, √d = √2; agent 0 hears 1 and 2, agent 1 hears 2, agent 2 nobody."""
    settings = NetworkConfig(width=2, communication="tarmac", signature_size=2, value_size=2)
    net = drawn(communication.make, Spread(3, 2), settings)
    root = np.sqrt(2)
    weights = {
        "signature": [[np.log(2) * root, 0], [0, 0]],  # k = √2 ln 2 (h0, 0)
        "value": [[0, 1], [1, 0]],  # v = (h1, h0)
        "query": [[1, 0], [0, 1]],  # q = h
        "merge": [[0.1, 0, 0, 0], [0, 0.1, 0, 1]],  # (0.1 c0, 0.1 c1 + h1)
    }
    signature = jnp.array(weights.pop("signature"))
    net = eqx.tree_at(lambda net: net.signature[0], net, signature)
    for name, weight in weights.items():
        layer = getattr(net, name)[0]
        layer = eqx.tree_at(lambda layer: (layer.weight, layer.bias), layer, (jnp.array(weight), jnp.zeros(2)))
        net = eqx.tree_at(lambda net: getattr(net, name)[0], net, layer)  # noqa: B023
    hidden = jnp.array([[1.0, 0.5], [2.0, 0.7], [3.0, 0.9]])
    graph = jnp.array([[0, 1, 1], [0, 0, 1], [0, 0, 0]], bool)
    spoken = net.speak(hidden, near(graph), None, 1.0)
    # Scores are h0_i h0_j ln 2, each with itself: agent 0 weighs 2 : 4 : 8; agent 1 weighs itself 16 and 2 64.
    attention = np.array([[1 / 7, 2 / 7, 4 / 7], [0, 1 / 5, 4 / 5], [0, 0, 1]])
    context = attention @ np.asarray(hidden)[:, ::-1]
    expected = np.tanh(np.stack([0.1 * context[:, 0], 0.1 * context[:, 1] + np.asarray(hidden)[:, 1]], 1))
    np.testing.assert_allclose(spoken.hidden, expected, rtol=1e-5)
    signatures = np.log(2) * root * np.asarray(hidden)[:, :1] * [1, 0]
    np.testing.assert_allclose(
        spoken.messages, [np.concatenate([signatures, np.asarray(hidden)[:, ::-1]], 1)], rtol=1e-6
    )


def test_rounds_and_order():
    """In two rounds agent 0 hears of 2 through 1, in one it does not; and the order of agents does not matter."""
    chain = jnp.array([[0, 1, 0], [0, 0, 1], [0, 0, 0]], bool)
    hidden = jax.random.normal(jax.random.key(0), (3, 8))
    say = eqx.filter_jit(lambda net, hidden, graph: net.speak(hidden, near(graph), None, 1.0))
    for rounds in (1, 2):
        settings = NetworkConfig(width=8, communication="tarmac", rounds=rounds, signature_size=3, value_size=5)
        net = drawn(communication.make, Spread(3, 2), settings)
        before = say(net, hidden, chain)
        assert before.messages.shape == (rounds, 3, 8)
        far = np.abs(say(net, hidden.at[2].add(1.0), chain).hidden[0] - before.hidden[0]).max()
        assert far > 1e-3 if rounds == 2 else far == 0
        order = np.array([2, 0, 1])
        moved = say(net, hidden[order], chain[order][:, order])
        np.testing.assert_allclose(moved.hidden, before.hidden[order], atol=1e-6)


def test_every_weight_matters():
    net = drawn(
        communication.make,
        Spread(6, 2),
        NetworkConfig(width=8, communication="tarmac", rounds=2, signature_size=4),
    )
    hidden, graph = jax.random.normal(jax.random.key(1), (6, 8)), ~jnp.eye(6, dtype=bool)

    @eqx.filter_jit
    @eqx.filter_grad
    def slope(net):
        spoken = net.speak(hidden, near(graph), None, 1.0).hidden
        return jnp.sum(spoken * jax.random.normal(jax.random.key(3), spoken.shape))

    for path, leaf in jax.tree_util.tree_leaves_with_path(slope(net)):
        assert np.abs(leaf).max() > 1e-4, jax.tree_util.keystr(path)
