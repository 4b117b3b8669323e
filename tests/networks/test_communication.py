"""What reaches whom: CommNet and DIAL by hand, channels that silence, gradients from hearer to speaker."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import drawn, drawn_learner

from gacrl import rollout
from gacrl.algorithms import build as algorithms
from gacrl.config.algorithms import IppoConfig, NetworkConfig, VdnConfig
from gacrl.config.kinds import COMMUNICATION
from gacrl.config.run import TrainingConfig
from gacrl.envs.probes import Probe
from gacrl.errors import ConfigError
from gacrl.networks import communication
from gacrl.networks.agent import AgentMemory, AgentNetwork, unroll
from gacrl.networks.communication import Communication, Neighbourhood, Spoken
from gacrl.networks.communication.dial import discretise_regularise
from gacrl.networks.graph import proximity_adjacency
from gacrl.tasks.spread.environment import Spread
from gacrl.types import Channel

pytestmark = pytest.mark.usefixtures("quick_start")

KINDS = ("commnet", "dial", "discrete", "soft")
EVERYONE = jnp.ones((3, 3), bool) & ~jnp.eye(3, dtype=bool)


def talk(kind: Any, **settings: Any) -> Any:
    config = NetworkConfig(width=8, vocabulary=3, communication=kind, **settings)
    return drawn(lambda key: communication.make(config, key))


def sigmoid(x: Any) -> np.ndarray:
    return 1 / (1 + np.exp(-np.asarray(x, float)))


# By hand.


def test_commnet_by_hand():
    """Two units; agent 0 hears 1 and 2, agent 1 hears 2, agent 2 nobody. H = [[1, 0], [0, 2]], C = [[0, 1], [1, 0]]."""
    net = talk("commnet", rounds=1)
    own, heard = net.own[0], net.heard[0]
    own = eqx.tree_at(
        lambda layer: (layer.weight, layer.bias), own, (jnp.diag(jnp.array([1.0, 2.0])), jnp.array([0.1, 0.0]))
    )
    heard = eqx.tree_at(lambda layer: (layer.weight, layer.bias), heard, (jnp.eye(2)[::-1], jnp.zeros(2)))
    net = eqx.tree_at(lambda n: (n.own[0], n.heard[0]), net, (own, heard))
    hidden = jnp.array([[0.0, 0.1], [0.2, 0.0], [0.4, 0.6]])
    near = Neighbourhood(jnp.array([[0, 1, 1], [0, 0, 1], [0, 0, 0]], bool), jnp.zeros((3, 3, 2)))
    spoken = net.speak(hidden, near, Channel(), None, 1.0)
    # The mean of (0.2, 0) and (0.4, 0.6) is (0.3, 0.3); agent 1 hears (0.4, 0.6).
    before = [[0.1 + 0.3, 0.2 + 0.3], [0.3 + 0.6, 0.0 + 0.4], [0.5, 1.2]]
    np.testing.assert_allclose(spoken.hidden, np.tanh(before), rtol=1e-5)
    np.testing.assert_array_equal(spoken.message, hidden)
    # With only agent 2 let through to agent 0, the mean is over agent 2.
    two = net.speak(hidden, near._replace(adjacency=near.adjacency.at[0, 1].set(False)), Channel(), None, 1.0)
    np.testing.assert_allclose(two.hidden[0], np.tanh([0.1 + 0.6, 0.2 + 0.4]), rtol=1e-5)


def test_dial_units_are_noisy_while_learning_and_bits_when_played():
    message, key = jnp.array([[-0.3, 0.0, 2.0]]), jax.random.key(3)
    np.testing.assert_array_equal(discretise_regularise(message, None, 2.0), [[0, 0, 1]])
    np.testing.assert_allclose(discretise_regularise(message, key, 0.0), sigmoid(message), rtol=1e-6)
    drawn_noise = np.asarray(jax.random.normal(key, (1, 3)))
    expected = sigmoid(np.asarray(message) + 2.0 * drawn_noise)
    np.testing.assert_allclose(discretise_regularise(message, key, 2.0), expected, rtol=1e-5)

    net, hidden = talk("dial", dial_noise=0.5), jax.random.normal(key, (3, 8))
    units = net.encode(hidden)
    near = Neighbourhood(EVERYONE, jnp.zeros((3, 3, 2)))
    spoken = net.speak(hidden, near, Channel(), None, 1.0)
    np.testing.assert_array_equal(spoken.inbox, units > 0)
    np.testing.assert_array_equal(spoken.hidden, hidden)  # heard at the next step only
    noisy = net.speak(hidden, near, Channel(), key, 1.0).inbox
    np.testing.assert_allclose(noisy, sigmoid(units + 0.5 * jax.random.normal(key, (3, 3))), rtol=1e-5)
    heard = net.hear(hidden, spoken.inbox, near, Channel(), None)
    mean = (np.asarray(spoken.inbox)[1] + np.asarray(spoken.inbox)[2]) / 2
    decoded = np.maximum(np.asarray(net.decode.weight) @ mean + np.asarray(net.decode.bias), 0)
    np.testing.assert_allclose(heard[0], np.asarray(hidden)[0] + decoded, rtol=1e-5)


def test_symbols_are_one_hot_and_their_entropy_is_that_of_their_distribution():
    """Played: the most likely. Learning, discrete: one-hot, as often as softmax(logits / τ = 1) says."""
    net, hidden = talk("discrete"), jnp.zeros((3, 8)).at[:, 0].set(jnp.array([0.0, 1.0, 2.0]))
    encode = eqx.tree_at(
        lambda layer: (layer.weight, layer.bias),
        net.encode[0],
        (jnp.zeros((3, 8)).at[1, 0].set(1.0), jnp.array([0.1, 0.0, 0.0])),
    )
    net = eqx.tree_at(lambda n: n.encode[0], net, encode)
    logits = np.array([[0.1, 0, 0], [0.1, 1, 0], [0.1, 2, 0]])
    chances = np.exp(logits) / np.exp(logits).sum(1, keepdims=True)
    near = Neighbourhood(EVERYONE, jnp.zeros((3, 3, 2)))
    say = eqx.filter_jit(lambda key: net.speak(hidden, near, Channel(), key, 1.0))
    np.testing.assert_array_equal(say(None).message, [[1, 0, 0], [0, 1, 0], [0, 1, 0]])
    np.testing.assert_allclose(say(None).entropy, -(chances * np.log(chances)).sum(1), rtol=1e-5)
    said = np.asarray(jax.jit(jax.vmap(lambda key: say(key).message))(jax.random.split(jax.random.key(0), 4_000)))
    assert (np.sort(said.round(5), axis=-1) == [0, 0, 1]).all()
    assert np.abs(said.mean(0) - chances).max() < 5 * np.sqrt(0.25 / 4_000)


def test_soft_symbols_are_as_soft_in_play():
    """Learning without noise: what Gumbel-Softmax gives where the noise is the same for all symbols."""
    net, hidden = talk("soft"), jax.random.normal(jax.random.key(0), (3, 8))
    near = Neighbourhood(EVERYONE, jnp.zeros((3, 3, 2)))
    message = net.speak(hidden, near, Channel(), None, 0.5).message
    np.testing.assert_allclose(message, jax.nn.softmax(net.encode[0](hidden) / 0.5), rtol=1e-6)


def test_every_weight_of_the_symbols_matters():
    """The receiver's too: what it knows decides whom it attends to."""
    net, key = talk("discrete", rounds=2), jax.random.key(1)
    hidden, offsets = jax.random.normal(key, (6, 8)), jax.random.normal(jax.random.key(2), (6, 6, 2))
    near = Neighbourhood(~jnp.eye(6, dtype=bool), offsets)

    @eqx.filter_jit
    @eqx.filter_grad
    def slope(net: Any) -> Any:
        spoken = net.speak(hidden, near, Channel(), key, 1.0).hidden
        return jnp.sum(spoken * jax.random.normal(jax.random.key(3), spoken.shape))

    for path, leaf in jax.tree_util.tree_leaves_with_path(slope(net)):
        assert jnp.abs(leaf).max() > 1e-4, jax.tree_util.keystr(path)


# Who is heard.


@pytest.mark.parametrize("kind", KINDS)
def test_who_is_silenced_is_not_heard_at_all(kind: str):
    """A channel with no edge is an agent alone; one without an edge is the graph without it."""
    env, graph = Spread(3, 2), EVERYONE.at[2, 0].set(False)
    config = NetworkConfig(width=8, vocabulary=3, communication=kind, rounds=2)
    network = drawn(AgentNetwork, env, config, 5)
    _, seen = env.reset(jax.random.key(0))
    memory = AgentMemory((), jax.random.uniform(jax.random.key(1), (3, 3))) if kind == "dial" else ()
    act = eqx.filter_jit(
        lambda graph, keep: (
            network(seen._replace(adjacency=graph), memory, jax.random.key(2), Channel(edge_keep=keep))[0].head
        )
    )
    open_channel, closed = jnp.ones((3, 3)), jnp.zeros((3, 3))
    alone, together = act(graph & False, open_channel), act(graph, open_channel)
    np.testing.assert_allclose(act(graph, closed), alone, atol=1e-6)
    cut = act(graph, open_channel.at[0, 1].set(0.0))
    np.testing.assert_allclose(cut, act(graph.at[0, 1].set(False), open_channel), atol=1e-6)
    assert (np.abs(together - alone).max(1) > 1e-3).all()
    assert np.abs(cut[0] - together[0]).max() > 1e-3


@pytest.mark.parametrize("kind", ["commnet", "dial", "discrete"])
def test_nobody_outside_the_radius_is_heard(kind: str):
    """Agents 0 and 1 hear each other, 2 is too far; whatever it says changes nothing for them."""
    net = talk(kind, rounds=2)
    positions = jnp.array([[0.0, 0.0], [1.0, 0.0], [2.1, 0.0]])
    near = Neighbourhood(
        proximity_adjacency(positions, jnp.ones(3, bool), 1.05), positions[None] - positions[:, None]
    )

    @eqx.filter_jit
    def hears(said: jax.Array) -> jax.Array:
        """From what all hold (DIAL: said a step ago) to what agents 0 and 1 have after hearing."""
        if kind == "dial":
            return net.hear(jnp.zeros((3, 8)), said[:, :3], near, Channel(), None)
        return net.speak(said, near, Channel(), None, 1.0).hidden

    said = jax.random.normal(jax.random.key(0), (3, 8))
    before, after = hears(said), hears(said.at[2].set(-said[2]))
    np.testing.assert_array_equal(after[:2], before[:2])
    other = hears(said.at[1].set(-said[1]))
    assert np.abs(other[0] - before[0]).max() > 1e-3
    if kind == "dial":
        np.testing.assert_array_equal(before[2], np.maximum(net.decode.bias, 0))


@pytest.mark.parametrize(
    "channel", [Channel(), Channel(symbol_map=jnp.tile(jnp.roll(jnp.eye(3), 1, 0), (6, 1, 1)))]
)
def test_only_the_nearest_are_heard(channel: Channel):
    """As the graph of everyone's two nearest neighbours is; who is nearest and out of reach does not count."""
    place_key, said_key = jax.random.split(jax.random.key(0))
    positions, said = jax.random.uniform(place_key, (6, 2)), jax.random.normal(said_key, (6, 8))
    offsets = positions[None] - positions[:, None]
    adjacency = (jnp.ones((6, 6), bool) & ~jnp.eye(6, dtype=bool)).at[0, 1].set(False)
    distance = jnp.where(adjacency, jnp.square(offsets).sum(-1), jnp.inf)
    two_nearest = adjacency & (distance <= jnp.sort(distance, axis=1)[:, 1:2])

    @eqx.filter_jit
    def heard(net: Any, graph: jax.Array) -> jax.Array:
        return net.speak(said, Neighbourhood(graph, offsets), channel, jax.random.key(1), 1.0).hidden

    limited, everyone = talk("discrete", rounds=2, nearest_agents=2), talk("discrete", rounds=2)
    np.testing.assert_allclose(heard(limited, adjacency), heard(everyone, two_nearest), atol=1e-6)
    assert np.abs(heard(limited, adjacency) - heard(everyone, adjacency)).max() > 1e-3
    many = talk("discrete", rounds=2, nearest_agents=5)
    np.testing.assert_allclose(heard(many, adjacency), heard(everyone, adjacency), atol=1e-6)


# Gradients.


@pytest.mark.parametrize("kind", KINDS)
def test_gradients_flow_from_hearer_to_speaker(kind: str):
    """Two steps; the derivative of what one agent puts out by what the other saw. Agent 0 hears 1, not 1 him.

    DIAL's come through time: what was said at the first step is heard at the second.
    """
    env = Probe()
    config = NetworkConfig(width=16, vocabulary=4, communication=kind, dial_noise=0.5, recurrent=kind == "dial")
    network = drawn(AgentNetwork, env, config, 2)
    _, seen = env.reset(jax.random.key(0))
    seen = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (2, *leaf.shape)), seen)
    seen = seen._replace(adjacency=jnp.broadcast_to(jnp.array([[False, True], [False, False]]), (2, 2, 2)))
    keys, first = jax.random.split(jax.random.key(1), 2), jnp.array([True, False])
    features = jax.random.normal(jax.random.key(2), (2, 2, 2))

    @eqx.filter_jit
    def slopes(network: AgentNetwork) -> jax.Array:
        def heads(features: jax.Array) -> jax.Array:
            inputs = seen._replace(features=features), first, network.initial_memory(2), keys
            return unroll(network, *inputs)[0].head

        return jnp.abs(jax.jacobian(heads)(features)).sum((2, 5))  # [step, agent] by [step, agent]

    found = np.asarray(slopes(network))
    assert (found[[0, 1], :, [0, 1], :][:, [0, 1], [0, 1]] > 0).all()  # each by what itself sees now
    same_step, later = found[1, 0, 1, 1], found[1, 0, 0, 1]
    if kind == "dial":
        assert same_step == 0 and later > 1e-3
    else:
        assert same_step > 1e-3 and later == 0
    assert (found[:, 1, :, 0] == 0).all()  # nothing from 0 to 1
    assert (found[0, :, 1, :] == 0).all()  # nor backward in time


# Kinds by name.


def test_a_kind_that_nobody_knows_is_refused():
    with pytest.raises(
        ConfigError, match=r"unknown algorithm\.network\.communication 'dail': did you mean 'dial'"
    ):
        NetworkConfig(communication="dail")


def test_what_is_said_is_heard_late_where_there_is_an_inbox():
    kinds = {name: communication.hears_late(NetworkConfig(width=4, communication=name)) for name in COMMUNICATION}
    assert kinds == {"none": False, "commnet": False, "dial": True, "discrete": False, "soft": False}
    symbols = {
        name for name in COMMUNICATION if communication.kind_of(NetworkConfig(communication=name)).sends_symbols
    }
    assert symbols == {"discrete"}


class Shout(Communication):
    """Everyone hears the sum of what all hold, for a price: agent i pays i times the loudness, squared."""

    loudness: jax.Array

    def __init__(self, config: NetworkConfig, key: Any, gain: float | None = None):
        self.loudness = jnp.ones(config.vocabulary)

    def speak(self, hidden: Any, near: Any, channel: Any, key: Any, temperature: Any, code: Any = None) -> Spoken:
        agents = jnp.arange(hidden.shape[0])
        return Spoken(hidden, hidden[:, :2], loss=agents * jnp.square(self.loudness).mean())


@pytest.fixture
def shouting(monkeypatch: pytest.MonkeyPatch) -> NetworkConfig:
    monkeypatch.setitem(COMMUNICATION, "shout", Shout)
    return NetworkConfig(width=8, communication="shout", vocabulary=3)


def test_a_kind_of_ones_own_may_have_a_loss(shouting: NetworkConfig):
    env = Probe()
    network = drawn(AgentNetwork, env, shouting, 2)
    network = eqx.tree_at(lambda network: network.communication.loudness, network, jnp.full(3, 2.0))
    _, seen = env.reset(jax.random.key(0))
    output, _ = network(seen)
    np.testing.assert_array_equal(output.message_loss, [0.0, 4.0])
    np.testing.assert_array_equal(output.message, output.hidden[:, :2])
    seen = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (3, *leaf.shape)), seen)
    outputs, _ = unroll(network, seen, jnp.zeros(3, bool), (), None)
    np.testing.assert_array_equal(outputs.message_loss, [[0.0, 4.0]] * 3)
    quiet, _ = drawn(AgentNetwork, env, NetworkConfig(width=8, communication="commnet"), 2)(
        jax.tree.map(lambda leaf: leaf[0], seen)
    )
    assert quiet.message_loss is None


@pytest.mark.parametrize("kind", [IppoConfig, VdnConfig])
def test_every_learner_minimises_the_loss_of_the_messages(kind: Any, shouting: NetworkConfig):
    """Its mean over the agents is ½ at loudness 1; one step of Adam makes it quieter, which nothing else would."""
    learning = {"updates": 1, "learning_starts": 0, "batch_size": 4}
    if kind is IppoConfig:
        learning = {"update_epochs": 1, "num_minibatches": 1}
    env, training = Probe(), TrainingConfig(env_steps=1_000, num_envs=2, num_steps=4)
    config = kind(network=shouting, learning_rate=0.01, learning_rate_end=0.01, **learning)
    algorithm = algorithms.make(config, env, training)
    learner, memory, params = drawn_learner(algorithm), algorithm.initial_memory(2), env.default_params()
    where = lambda learner: algorithm.parameters(learner).agent if kind is VdnConfig else learner.network.actor  # noqa: E731
    learner = eqx.tree_at(lambda learner: where(learner).communication.loudness, learner, jnp.ones(3))

    @jax.jit
    def update(learner: Any) -> Any:
        carry = rollout.start(env, params, memory, jax.random.key(0), 2)
        policy = algorithm.policy(learner, True)
        _, experience = rollout.collect(env, policy, memory, params, carry, jax.random.key(1), 4)
        return algorithm.update(learner, experience, jax.random.key(2))

    after, metrics = update(learner)
    np.testing.assert_allclose(metrics["loss_messages"], 0.5, rtol=1e-6)
    np.testing.assert_allclose(where(after).communication.loudness, 1 - 0.01, rtol=1e-4)
