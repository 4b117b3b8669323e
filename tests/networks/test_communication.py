"""What reaches whom: CommNet and DIAL by hand, edges that are cut, gradients from hearer to speaker.

Every kind passes what is here; `test_told`, `test_tarmac`, `test_ic3net` and `test_gate` have what is theirs.
"""

from dataclasses import replace
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
from gacrl.networks.agent import AgentMemory, AgentNetwork, unroll, words_said
from gacrl.networks.communication import Communication, Neighbourhood, Spoken
from gacrl.networks.communication.dial import discretise_regularise
from gacrl.networks.graph import proximity_adjacency
from gacrl.tasks.spread.environment import Spread
from gacrl.types import Arrives

KINDS = ("commnet", "dial", "discrete", "soft", "told", "tarmac", "ic3net")
EVERYONE = jnp.ones((3, 3), bool) & ~jnp.eye(3, dtype=bool)


def talk(kind: Any, **settings: Any) -> Any:
    config = NetworkConfig(width=8, vocabulary=3, communication=kind, **settings)
    return drawn(lambda key: communication.make(Spread(3, 2), config, key))


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
    spoken = net.speak(hidden, near, None, 1.0)
    # The mean of (0.2, 0) and (0.4, 0.6) is (0.3, 0.3); agent 1 hears (0.4, 0.6).
    before = [[0.1 + 0.3, 0.2 + 0.3], [0.3 + 0.6, 0.0 + 0.4], [0.5, 1.2]]
    np.testing.assert_allclose(spoken.hidden, np.tanh(before), rtol=1e-5)
    np.testing.assert_array_equal(spoken.messages, [hidden])
    # With only agent 2 let through to agent 0, the mean is over agent 2.
    two = net.speak(hidden, near._replace(adjacency=near.adjacency.at[0, 1].set(False)), None, 1.0)
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
    spoken = net.speak(hidden, near, None, 1.0)
    np.testing.assert_array_equal(spoken.inbox, units > 0)
    np.testing.assert_array_equal(spoken.hidden, hidden)  # heard at the next step only
    noisy = net.speak(hidden, near, key, 1.0).inbox
    np.testing.assert_allclose(noisy, sigmoid(units + 0.5 * jax.random.normal(key, (3, 3))), rtol=1e-5)
    heard = net.hear(hidden, spoken.inbox, near, None)
    mean = (np.asarray(spoken.inbox)[1] + np.asarray(spoken.inbox)[2]) / 2
    decoded = np.maximum(np.asarray(net.decode.weight) @ mean + np.asarray(net.decode.bias), 0)
    np.testing.assert_allclose(heard[0], np.asarray(hidden)[0] + decoded, rtol=1e-5)


def test_symbols_are_one_hot_and_as_frequent_as_their_distribution_says():
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
    say = eqx.filter_jit(lambda key: net.speak(hidden, near, key, 1.0))
    np.testing.assert_array_equal(say(None).messages, [[[1, 0, 0], [0, 1, 0], [0, 1, 0]]])
    said = np.asarray(
        jax.jit(jax.vmap(lambda key: say(key).messages[0]))(jax.random.split(jax.random.key(0), 4_000))
    )
    assert (np.sort(said.round(5), axis=-1) == [0, 0, 1]).all()
    assert np.abs(said.mean(0) - chances).max() < 5 * np.sqrt(0.25 / 4_000)


def test_soft_symbols_are_as_soft_in_play():
    """Learning without noise: what Gumbel-Softmax gives where the noise is the same for all symbols."""
    net, hidden = talk("soft"), jax.random.normal(jax.random.key(0), (3, 8))
    near = Neighbourhood(EVERYONE, jnp.zeros((3, 3, 2)))
    messages = net.speak(hidden, near, None, 0.5).messages
    np.testing.assert_allclose(messages, jax.nn.softmax(net.encode[0](hidden) / 0.5)[None], rtol=1e-6)


def test_every_weight_of_the_symbols_matters():
    """The receiver's too: what it knows decides whom it attends to."""
    net, key = talk("discrete", rounds=2), jax.random.key(1)
    hidden, offsets = jax.random.normal(key, (6, 8)), jax.random.normal(jax.random.key(2), (6, 6, 2))
    near = Neighbourhood(~jnp.eye(6, dtype=bool), offsets)

    @eqx.filter_jit
    @eqx.filter_grad
    def slope(net: Any) -> Any:
        spoken = net.speak(hidden, near, key, 1.0).hidden
        return jnp.sum(spoken * jax.random.normal(jax.random.key(3), spoken.shape))

    for path, leaf in jax.tree_util.tree_leaves_with_path(slope(net)):
        assert jnp.abs(leaf).max() > 1e-4, jax.tree_util.keystr(path)


# Who is heard.


@pytest.mark.parametrize("kind", KINDS)
def test_who_is_silenced_is_not_heard_at_all(kind: str):
    """With every edge cut an agent is alone; with one edge cut the graph is the one without it."""
    env, graph = Spread(3, 2), EVERYONE.at[2, 0].set(False)
    config = NetworkConfig(width=8, vocabulary=3, communication=kind, rounds=2)
    network = drawn(AgentNetwork, env, config, 5)
    _, seen = env.reset(jax.random.key(0))
    memory = AgentMemory((), jax.random.uniform(jax.random.key(1), (3, 3))) if kind == "dial" else ()
    act = eqx.filter_jit(
        lambda graph, kept: network(
            seen._replace(adjacency=graph, arrives=Arrives(kept=kept)), memory, jax.random.key(2)
        )[0]
    )
    everything = jnp.ones((3, 3), bool)
    alone, together = act(graph & False, everything).head, act(graph, everything).head
    silenced = act(graph, everything & False)
    np.testing.assert_allclose(silenced.head, alone, atol=1e-6)
    assert not silenced.adjacency.any()
    without = act(graph, everything.at[0, 1].set(False))
    cut = without.head
    np.testing.assert_allclose(cut, act(graph.at[0, 1].set(False), everything).head, atol=1e-6)
    np.testing.assert_array_equal(without.adjacency, graph.at[0, 1].set(False))
    assert (np.abs(together - alone).max(1) > 1e-3).all()
    assert np.abs(cut[0] - together[0]).max() > 1e-3


@pytest.mark.parametrize("kind", ["commnet", "dial", "discrete", "tarmac", "ic3net"])
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
            return net.hear(jnp.zeros((3, 8)), said[:, :3], near, None)
        return net.speak(said, near, None, 1.0).hidden

    said = jax.random.normal(jax.random.key(0), (3, 8))
    before, after = hears(said), hears(said.at[2].set(-said[2]))
    np.testing.assert_array_equal(after[:2], before[:2])
    other = hears(said.at[1].set(-said[1]))
    assert np.abs(other[0] - before[0]).max() > 1e-3
    if kind == "dial":
        np.testing.assert_array_equal(before[2], np.maximum(net.decode.bias, 0))


@pytest.mark.parametrize("replaced", [False, True])
@pytest.mark.parametrize("kind", KINDS)
def test_only_the_nearest_are_heard(kind: str, replaced: bool):
    """As the graph of everyone's two nearest neighbours is; who is nearest and out of reach does not count.

    Also where other words arrive.
    """
    env = Spread(6, 2)
    adjacency = (jnp.ones((6, 6), bool) & ~jnp.eye(6, dtype=bool)).at[0, 1].set(False)
    config = NetworkConfig(width=8, vocabulary=3, communication=kind, rounds=2)
    seen = env.reset(jax.random.key(0))[1]
    shape = words_said(drawn(AgentNetwork, env, config, 5), env)
    assert shape is not None
    values = jax.random.normal(jax.random.key(4), shape)
    seen = seen._replace(arrives=Arrives(values) if replaced else Arrives())
    memory = AgentMemory((), jax.random.uniform(jax.random.key(1), (6, 3))) if kind == "dial" else ()
    offsets = seen.positions[None] - seen.positions[:, None]
    distance = jnp.where(adjacency, jnp.square(offsets).sum(-1), jnp.inf)
    two_nearest = adjacency & (distance <= jnp.sort(distance, axis=1)[:, 1:2])

    def heard(nearest: int | None, graph: jax.Array) -> jax.Array:
        network = drawn(AgentNetwork, env, replace(config, nearest_agents=nearest), 5)
        listening = seen._replace(adjacency=graph)
        return eqx.filter_jit(lambda: network(listening, memory, jax.random.key(2))[0].head)()

    np.testing.assert_allclose(heard(2, adjacency), heard(None, two_nearest), atol=1e-6)
    assert np.abs(heard(2, adjacency) - heard(None, adjacency)).max() > 1e-3
    np.testing.assert_allclose(heard(5, adjacency), heard(None, adjacency), atol=1e-6)


# What a listener sees of whom it hears.


@pytest.mark.parametrize("nearest", [None, 2])
@pytest.mark.parametrize("kind", KINDS)
def test_a_voice_does_not_tell_where_an_unseen_speaker_stands(kind: str, nearest: int | None):
    """Agents see their nearest neighbour and hear both. With the same words, 0 cannot tell where 2 stands, and can
    where 1 does, whom it sees: symbols are heard with where they come from."""
    env = Spread(3, 2, num_agent_neighbors=1)
    config = NetworkConfig(width=8, vocabulary=3, communication=kind, rounds=1, nearest_agents=nearest)
    network = drawn(AgentNetwork, env, config, 5)
    seen = env.reset(jax.random.key(0))[1]._replace(adjacency=EVERYONE)
    memory = AgentMemory((), jax.random.uniform(jax.random.key(1), (3, 3))) if kind == "dial" else ()
    act = eqx.filter_jit(
        lambda places: network(seen._replace(positions=places), memory, jax.random.key(2))[0].head
    )
    here = jnp.array([[0.0, 0.0], [0.3, 0.1], [-0.8, 0.4]])
    before = act(here)
    np.testing.assert_array_equal(act(here.at[2].set(jnp.array([0.6, 0.9])))[0], before[0])
    moved = np.abs(act(here.at[1].set(jnp.array([0.1, -0.3])))[0] - before[0]).max()
    assert moved > 1e-3 if kind in ("discrete", "soft", "told") else moved == 0


def test_a_voice_without_a_face_has_no_offset_at_all():
    """In a task in which agents do not see each other an edge is the symbol alone, wherever the agents are said to be."""
    env = Probe()
    network = drawn(AgentNetwork, env, NetworkConfig(width=8, vocabulary=3, communication="discrete"), 2)
    assert network.communication.edge[0].layers[0].weight.shape[-1] == 3
    seen = env.reset(jax.random.key(0))[1]._replace(adjacency=~jnp.eye(2, dtype=bool))
    near = seen._replace(positions=jnp.zeros((2, 2)))
    far = seen._replace(positions=jnp.array([[0.0, 0.0], [0.5, 0.5]]))
    np.testing.assert_array_equal(network(near)[0].head, network(far)[0].head)
    spread = drawn(AgentNetwork, Spread(3, 2), NetworkConfig(width=8, vocabulary=3, communication="discrete"), 5)
    assert spread.communication.edge[0].layers[0].weight.shape[-1] == 3 + 2 + 1


# What arrives instead.


def words(seed: int, rounds: int, symbols: int) -> jax.Array:
    return jax.random.uniform(jax.random.key(seed), (rounds, 3, symbols))


@pytest.mark.parametrize("kind", KINDS)
def test_what_arrives_is_heard_in_place_of_what_is_said(kind: str):
    """Words said anew change nothing; others do: those of the marked speakers, for whoever hears them."""
    env, graph = Spread(3, 2), EVERYONE.at[2, 1].set(False)
    network = drawn(AgentNetwork, env, NetworkConfig(width=8, vocabulary=3, communication=kind, dial_noise=0.5), 5)
    seen = env.reset(jax.random.key(0))[1]._replace(adjacency=graph)
    fresh = network.initial_memory(3)

    @eqx.filter_jit
    def act(arrives: Arrives) -> Any:
        """The words of a step, and the heads after it: DIAL's of the step that follows."""
        output, memory = network(seen._replace(arrives=arrives), fresh, jax.random.key(2))
        if kind == "dial":
            return output.messages, network(seen, memory, jax.random.key(3))[0].head
        return output.messages, output.head

    said, head = act(Arrives())
    everyone = jnp.ones(said.shape[:2], bool)
    other = jax.random.uniform(jax.random.key(3), said.shape)
    for same in (Arrives(said), Arrives(said, everyone), Arrives(other, ~everyone)):
        np.testing.assert_allclose(act(same)[1], head, atol=1e-6)
    marked = act(Arrives(other, ~everyone.at[:, 1].set(False)))[1]
    np.testing.assert_allclose(marked, act(Arrives(said.at[:, 1].set(other[:, 1])))[1], atol=1e-6)
    np.testing.assert_allclose(marked[1:], head[1:], atol=1e-6)  # 2 does not hear 1, nor does 1 itself
    assert np.abs(marked[0] - head[0]).max() > 1e-4
    replaced = act(Arrives(other, everyone))[1]
    np.testing.assert_allclose(replaced, act(Arrives(other))[1], atol=1e-6)
    assert (np.abs(replaced - head).max(1) > 1e-4).all()


@pytest.mark.parametrize("kind", ["commnet", "soft"])
def test_words_arrive_in_their_own_round(kind: str):
    """What arrives in the first round changes what is said in the second, and not the other way around."""
    env = Spread(3, 2)
    network = drawn(AgentNetwork, env, NetworkConfig(width=8, vocabulary=3, communication=kind, rounds=2), 5)
    seen = env.reset(jax.random.key(0))[1]._replace(adjacency=EVERYONE)
    act = eqx.filter_jit(lambda arrives: network(seen._replace(arrives=arrives), (), jax.random.key(2))[0])
    plain = act(Arrives())
    other = jax.random.uniform(jax.random.key(3), plain.messages.shape)
    for number in (0, 1):
        found = act(Arrives(other, jnp.zeros((2, 3), bool).at[number].set(True)))
        np.testing.assert_allclose(found.messages[: number + 1], plain.messages[: number + 1], atol=1e-6)
        assert (np.abs(found.messages - plain.messages).max((1, 2))[number + 1 :] > 1e-4).all()
        assert (np.abs(found.head - plain.head).max(1) > 1e-4).all()


@pytest.mark.parametrize("kind", KINDS)
def test_words_of_another_shape_are_refused_in_one_sentence(kind: str):
    env = Spread(3, 2)
    network = drawn(AgentNetwork, env, NetworkConfig(width=8, vocabulary=3, communication=kind), 5)
    seen, memory = env.reset(jax.random.key(0))[1], network.initial_memory(3)
    fitting = [1, 3, {"commnet": 8, "ic3net": 8, "tarmac": 16 + 32, "told": env.observation_size}.get(kind, 3)]
    for shape in ([2, *fitting[1:]], [1, 2, fitting[2]], [1, 3, fitting[2] + 1], fitting[1:]):
        with pytest.raises(ConfigError) as caught:
            network(seen._replace(arrives=Arrives(jnp.zeros(shape))), memory)
        assert str(caught.value) == f"what arrives must be [rounds, agents, symbols] = {fitting}, not {shape}"


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


@pytest.mark.parametrize("kind", ["discrete", "told"])
def test_who_has_stopped_listening_can_learn_to_listen_again(kind: Any):
    """Layers that are quiet for every input pass no gradient to the speaker; with a slope they do."""

    def slope_of(heard_slope: float) -> float:
        config = NetworkConfig(width=8, communication=kind, heard_slope=heard_slope, radius=10.0)
        network = drawn(AgentNetwork, Spread(3, 2), config, 5)
        merge = network.communication.merge if kind == "told" else network.communication.merge[0]
        quiet = eqx.tree_at(lambda merge: merge.bias, merge, merge.bias - 100.0)
        network = eqx.tree_at(lambda net: net.communication.merge, network, quiet if kind == "told" else (quiet,))
        _, seen = Spread(3, 2).reset(jax.random.key(0))

        def head(features: jax.Array) -> jax.Array:
            return network(seen._replace(features=features), (), jax.random.key(1))[0].head[0].sum()

        return float(jnp.abs(jax.grad(head)(seen.features)[1:]).sum())

    assert slope_of(0.0) == 0.0
    assert slope_of(0.1) > 1e-4


# Kinds by name.


def test_a_kind_that_nobody_knows_is_refused():
    with pytest.raises(
        ConfigError, match=r"unknown algorithm\.network\.communication 'dail': did you mean 'dial'"
    ):
        NetworkConfig(communication="dail")


def test_what_is_said_is_heard_late_where_there_is_an_inbox():
    configs = {name: NetworkConfig(width=4, communication=name) for name in COMMUNICATION}
    kinds = {name: communication.kind_of(config).heard_late for name, config in configs.items()}
    assert {name for name, late in kinds.items() if late} == {"dial"}
    inboxes = {
        name: bool(jax.tree.leaves(drawn(communication.make, Spread(3, 2), config).empty_inbox(1)))
        for name, config in configs.items()
    }
    assert kinds == inboxes
    symbols = {name for name, config in configs.items() if communication.kind_of(config).sends_symbols}
    assert symbols == {"discrete"}


class Shout(Communication):
    """Everyone hears the sum of what all hold, for a price: agent i pays i times the loudness, squared."""

    loudness: jax.Array

    def __init__(self, env: Any, config: NetworkConfig, key: Any, gain: float | None = None):
        self.loudness = jnp.ones(config.vocabulary)

    def speak(self, hidden: Any, near: Any, key: Any, temperature: Any, code: Any = None) -> Spoken:
        agents = jnp.arange(hidden.shape[0])
        return Spoken(hidden, hidden[None, :, :2], loss=agents * jnp.square(self.loudness).mean())


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
    np.testing.assert_array_equal(output.messages, [output.hidden[:, :2]])
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
