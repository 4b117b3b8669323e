"""Symbols with a gate: who says nothing is not heard, and each word has a price."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import drawn

from gacrl.config.algorithms import NetworkConfig
from gacrl.errors import ConfigError
from gacrl.networks.agent import AgentNetwork
from gacrl.networks.communication import Neighbourhood
from gacrl.networks.layers import num_parameters
from gacrl.tasks.spread.environment import Spread
from gacrl.types import Arrives

ENV, EVERYONE = Spread(3, 2), ~jnp.eye(3, dtype=bool)
SEEN = ENV.reset(jax.random.key(0))[1]._replace(adjacency=EVERYONE)
act = eqx.filter_jit(lambda network, seen, key=None: network(seen, (), key)[0])


def made(bias: Any = None, **settings: Any) -> AgentNetwork:
    """bias: which gates are open, for all agents alike, by rounds."""
    rounds = settings.pop("rounds", 2)
    config = NetworkConfig(width=8, vocabulary=3, communication="discrete", rounds=rounds, gate=True, **settings)
    network = drawn(AgentNetwork, ENV, config, 5)
    if bias is None:
        return network
    gates = tuple(
        eqx.tree_at(lambda gate: (gate.weight, gate.bias), gate, (jnp.zeros((1, 8)), jnp.array([50.0 * number])))
        for gate, number in zip(network.communication.gate, bias, strict=True)
    )
    return eqx.tree_at(lambda network: network.communication.gate, network, gates)


@pytest.mark.parametrize("drawing", [False, True])
def test_shut_gates_are_an_empty_graph(drawing: bool):
    """And open ones are symbols without a gate: the same weights, the same draws."""
    key = jax.random.key(2) if drawing else None
    silent, alone = (act(made((-1, -1)), seen, key) for seen in (SEEN, SEEN._replace(adjacency=EVERYONE & False)))
    np.testing.assert_allclose(silent.head, alone.head, atol=1e-6)
    np.testing.assert_array_equal(silent.messages, np.zeros((2, 3, 3)))
    loud = act(made((1, 1)), SEEN, key)
    plain = eqx.tree_at(lambda network: network.communication.gate, made((1, 1)), ())
    np.testing.assert_allclose(loud.head, act(plain, SEEN, key).head, atol=1e-6)
    assert np.abs(loud.head - silent.head).max() > 1e-2
    # Only the second round: what was known before it is what oneself saw.
    late = act(made((-1, 1)), SEEN, key)
    assert (late.messages[0] == 0).all()
    np.testing.assert_allclose(late.messages[1].sum(-1), np.ones(3), atol=1e-6)
    assert np.abs(late.head - silent.head).max() > 1e-2


def one_silent() -> tuple[AgentNetwork, np.ndarray]:
    """A network of one round in which some agents speak and some do not, by what they see."""
    network = made(rounds=1)
    logits = network.communication.gate[0](network.torso(SEEN).hidden)[:, 0]
    middle = jnp.sort(logits)[:2].mean()
    return eqx.tree_at(
        lambda network: network.communication.gate[0].bias, network, network.communication.gate[0].bias - middle
    ), np.asarray(logits > middle)


def test_who_says_nothing_is_not_heard_at_all():
    """As if its edges were cut, and as if it were silenced from outside. In play a word is a symbol or nothing."""
    network, speaks = one_silent()
    assert speaks.sum() == 2
    found = act(network, SEEN)
    assert np.isin(found.messages, (0.0, 1.0)).all()
    np.testing.assert_array_equal(found.messages[0].sum(-1), speaks)
    cut = act(network, SEEN._replace(adjacency=EVERYONE & jnp.broadcast_to(jnp.asarray(speaks), (3, 3))))
    muted = act(network, SEEN._replace(arrives=Arrives(kept=jnp.broadcast_to(jnp.asarray(speaks), (3, 3)))))
    np.testing.assert_allclose(found.head, cut.head, atol=1e-6)
    np.testing.assert_allclose(found.head, muted.head, atol=1e-6)


def test_a_word_that_arrives_in_place_of_silence_is_heard_and_the_other_way_around():
    network, speaks = one_silent()
    quiet, before = int(np.flatnonzero(~speaks)[0]), act(network, SEEN)
    said = before.messages

    def with_words(agent: int, word: Any) -> np.ndarray:
        return np.asarray(
            act(network, SEEN._replace(arrives=Arrives(said.at[0, agent].set(jnp.array(word))))).head
        )

    others = np.arange(3) != quiet
    spoken = np.abs(with_words(quiet, [0.0, 1.0, 0.0]) - before.head).max(1)
    assert (spoken[others] > 1e-3).all() and spoken[quiet] < 1e-6
    loud = int(np.flatnonzero(speaks)[0])
    cut = act(network, SEEN._replace(adjacency=EVERYONE.at[:, loud].set(False)))
    np.testing.assert_allclose(with_words(loud, [0.0, 0.0, 0.0]), cut.head, atol=1e-6)


def test_the_order_of_agents_does_not_matter():
    """With a gate that is open for some; offsets are seen by whoever hears."""
    network, _ = one_silent()
    net, order = network.communication, np.array([2, 0, 1])
    hidden, sight = network.torso(SEEN).hidden, jax.random.normal(jax.random.key(1), (3, 3, 2))
    say = eqx.filter_jit(lambda hidden, near: net.speak(hidden, near, None, 1.0).hidden)
    moved = Neighbourhood(EVERYONE, sight[order][:, order])
    expected = say(hidden, Neighbourhood(EVERYONE, sight))[order]
    np.testing.assert_allclose(say(hidden[order], moved), expected, atol=1e-6)


def test_a_word_has_its_price():
    """Two rounds; whoever speaks in one of them pays once. What it costs falls with the gate as a sigmoid does."""
    for bias, words in (((1, 1), 2), ((-1, 1), 1), ((-1, -1), 0)):
        np.testing.assert_allclose(
            act(made(bias, word_price=0.25), SEEN).message_loss, 3 * [0.25 * words], rtol=1e-6
        )
    assert act(made((1, 1)), SEEN).message_loss is None

    network, temperature = made((0, 0), word_price=0.25), 0.5

    def cost(biases: Any) -> jax.Array:
        gates = lambda network: [gate.bias for gate in network.communication.gate]  # noqa: E731
        output, _ = eqx.tree_at(gates, network, biases)(SEEN, (), None, temperature)
        return output.message_loss.mean()

    biases = [jnp.array([0.3]), jnp.array([-0.2])]
    for slope, bias in zip(jax.jit(jax.grad(cost))(biases), (0.3, -0.2), strict=True):
        chance = 1 / (1 + np.exp(-bias / temperature))
        np.testing.assert_allclose(slope, [0.25 * chance * (1 - chance) / temperature], rtol=1e-5)


def test_every_weight_of_the_gate_matters():
    network, key = made(), jax.random.key(4)

    @eqx.filter_jit
    @eqx.filter_grad
    def slope(network: AgentNetwork) -> Any:
        head = network(SEEN, (), key)[0].head
        return jnp.sum(head * jax.random.normal(jax.random.key(3), head.shape))

    for path, leaf in jax.tree_util.tree_leaves_with_path(slope(network).communication.gate):
        assert jnp.abs(leaf).max() > 1e-5, jax.tree_util.keystr(path)


def test_without_a_gate_there_is_none():
    plain = NetworkConfig(width=8, vocabulary=3, communication="discrete", rounds=2)
    network = drawn(AgentNetwork, ENV, plain, 5)
    assert network.communication.gate == ()
    assert num_parameters(made()) - num_parameters(network) == 2 * (8 + 1)


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        (
            {"communication": "commnet", "gate": True},
            "algorithm.network.gate needs algorithm.network.communication discrete or soft, not commnet",
        ),
        (
            {"communication": "discrete", "word_price": 0.1},
            "algorithm.network.word_price needs algorithm.network.gate: agents without it cannot say less",
        ),
        (
            {"communication": "discrete", "gate": True, "word_price": -0.1},
            "algorithm.network.word_price must be between 0 and 1e+06, not -0.1",
        ),
        ({"signature_size": 0}, "algorithm.network.signature_size must be between 1 and 65536, not 0"),
        ({"value_size": 0}, "algorithm.network.value_size must be between 1 and 65536, not 0"),
    ],
)
def test_settings_that_do_not_fit_are_refused_in_one_sentence(settings: dict[str, Any], sentence: str):
    with pytest.raises(ConfigError) as caught:
        NetworkConfig(**settings)
    assert str(caught.value) == sentence
