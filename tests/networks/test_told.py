"""The ceiling: all that a speaker sees reaches whoever hears it, and what was told is remembered."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import drawn

from gacrl import tasks
from gacrl.config.algorithms import NetworkConfig
from gacrl.envs.environment import Environment
from gacrl.envs.probes import Probe
from gacrl.networks import communication
from gacrl.networks.agent import AgentNetwork, unroll
from gacrl.networks.communication import Neighbourhood
from gacrl.networks.communication.told import Told
from gacrl.tasks.spread.environment import Spread
from gacrl.types import Arrives

EVERYONE = ~jnp.eye(3, dtype=bool)
TASKS: dict[str, Environment] = {
    "a vector": Probe(num_agents=3),
    "places": Spread(3, 2),
    "colours": tasks.find("colours").make(tasks.default_settings("colours")),
}


def told(env: Environment, **settings: Any) -> AgentNetwork:
    config = NetworkConfig(width=16, communication="told", **settings)
    return drawn(AgentNetwork, env, config, env.num_actions)


def test_what_is_told_by_hand():
    """Two features and two units; 0 hears 1 and 2. An edge is (f0, f1 + 1 or 2 for who spoke), its score ln 3 a unit."""
    env = Probe(num_agents=3)
    net = drawn(communication.make, env, NetworkConfig(width=2, depth=1, communication="told"))
    edge = jnp.array([[1.0, 0, 0, 0, 0], [0, 1, 0, 1, 2]])
    query = jnp.array([[np.sqrt(2) * np.log(3), 0.0], [0.0, 0.0]])
    merge = jnp.array([[0.0, 0, 1, 0], [0, 0, 0, 1]])
    where = lambda net: [  # noqa: E731
        *(getattr(net.edge.layers[0], part) for part in ("weight", "bias")),
        *(getattr(layer, part) for layer in (net.query, net.merge) for part in ("weight", "bias")),
    ]
    net = eqx.tree_at(where, net, [edge, jnp.zeros(2), query, jnp.zeros(2), merge, jnp.zeros(2)])
    near = Neighbourhood(
        jnp.array([[0, 1, 1], [0, 0, 1], [0, 0, 0]], bool),
        jnp.zeros((3, 3, 0)),
        features=jnp.array([[9.0, 9.0], [1.0, 2.0], [2.0, 4.0]]),
    )
    hidden = jnp.array([[1.0, 0.5], [0.0, 0.0], [7.0, 7.0]])
    # Of 1: (1, 3); of 2: (2, 6). Agent 0 asks for the first unit: 1 : 3. Agent 1 hears 2 alone, agent 2 nobody.
    expected = [[1 + 0.25 * 1 + 0.75 * 2, 0.5 + 0.25 * 3 + 0.75 * 6], [2.0, 6.0], [7.0, 7.0]]
    np.testing.assert_allclose(net.hear(hidden, (), near, None), expected, rtol=1e-5)
    spoken = net.speak(hidden, near, None, 1.0)
    np.testing.assert_array_equal(spoken.messages, [near.features])
    np.testing.assert_array_equal(spoken.hidden, hidden)


@pytest.mark.parametrize("rounds", [1, 2])
def test_teachers_hear_what_others_made_of_it(rounds: int):
    """0 hears 1, who hears 2: what 2 sees reaches 0 in the second round."""
    net = drawn(lambda key: Told(Probe(num_agents=3), NetworkConfig(width=8), key, rounds=rounds))
    graph = jnp.array([[0, 1, 0], [0, 0, 1], [0, 0, 0]], bool)

    def heard(features: jax.Array) -> jax.Array:
        return net.hear(jnp.ones((3, 8)), (), Neighbourhood(graph, jnp.zeros((3, 3, 0)), features=features), None)

    moved = np.abs(jax.jacobian(heard)(jnp.array([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]]))).max((1, 3)) > 0
    np.testing.assert_array_equal(moved, [[0, 1, rounds == 2], [0, 0, 1], [0, 0, 0]])


@pytest.mark.parametrize(
    ("task", "torso", "recurrent"),
    [
        *((task, torso, False) for task in TASKS for torso in ("mlp", "graph")),
        *(("a vector", torso, True) for torso in ("mlp", "graph")),
    ],
)
def test_nothing_that_the_speaker_sees_is_lost(task: str, torso: Any, recurrent: bool):
    """Each of its features changes what each hearer puts out, and has a gradient there; those of the unheard none."""
    env = TASKS[task]
    network = told(env, torso=torso, recurrent=recurrent)
    seen = env.reset(jax.random.key(0), env.default_params())[1]
    graph = EVERYONE.at[0, 2].set(False)
    numbers = jax.random.normal(jax.random.key(1), seen.features.shape)
    memory = network.initial_memory(3)

    @eqx.filter_jit
    def head(features: jax.Array) -> jax.Array:
        return network(seen._replace(features=features, adjacency=graph), memory)[0].head

    slopes = np.abs(jax.jit(jax.jacobian(head))(numbers)).max(1)  # [hearer, speaker, feature]
    assert slopes.shape == (3, 3, env.observation_size)
    for hearer, speaker in zip(*np.nonzero(graph), strict=True):
        assert (slopes[hearer, speaker] > 0).all(), (hearer, speaker)
    assert (slopes[0, 2] == 0).all()
    before = head(numbers)
    for feature in range(env.observation_size):
        after = head(numbers.at[1, feature].add(0.5))
        assert np.abs(after - before)[0].max() > 1e-4, feature
        np.testing.assert_array_equal(after[0], head(numbers.at[1, feature].add(0.5).at[2].add(1.0))[0])


def test_an_absent_agent_tells_nothing():
    env = Spread(3, 2)
    network = told(env)
    there = jnp.array([True, True, False])
    seen = env.reset(jax.random.key(0), env.default_params()._replace(agent_mask=there))[1]
    act = eqx.filter_jit(lambda seen: network(seen)[0])
    ghost = act(seen._replace(features=seen.features.at[2].set(5.0)))
    np.testing.assert_array_equal(ghost.head[:2], act(seen).head[:2])
    assert (ghost.messages[0, 2] == 0).all() and (ghost.messages[0, :2] != 0).any()


def test_what_was_told_is_remembered():
    """Nothing arrives at the second step; what agent 1 saw at the first still matters to agent 0."""
    env = Probe(num_agents=3)
    network = told(env, recurrent=True)
    seen = env.reset(jax.random.key(0))[1]._replace(adjacency=EVERYONE)
    both = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (2, *leaf.shape)), seen)
    kept = jnp.broadcast_to(jnp.array([True, False])[:, None, None], (2, 3, 3))
    both = both._replace(features=jax.random.normal(jax.random.key(1), (2, 3, 2)), arrives=Arrives(kept=kept))

    @eqx.filter_jit
    def second(features: jax.Array) -> jax.Array:
        steps = both._replace(features=features)
        return unroll(network, steps, jnp.array([True, False]), network.initial_memory(3), None)[0].head[1]

    before = second(both.features)
    assert np.abs(second(both.features.at[0, 1].add(1.0)) - before)[0].max() > 1e-3
    np.testing.assert_array_equal(second(both.features.at[1, 1].add(1.0))[0], before[0])


def test_agents_of_another_order_are_told_the_same():
    """Where the weights for who spoke are put in that order, too."""
    env, order = Probe(num_agents=3), np.array([2, 0, 1])
    net = drawn(communication.make, env, NetworkConfig(width=8, communication="told"))
    hidden, seen = jax.random.normal(jax.random.key(0), (3, 8)), jax.random.normal(jax.random.key(1), (3, 2))
    graph = EVERYONE.at[0, 1].set(False)
    hear = eqx.filter_jit(lambda net, hidden, near: net.hear(hidden, (), near, None))
    before = hear(net, hidden, Neighbourhood(graph, jnp.zeros((3, 3, 0)), features=seen))
    weight = net.edge.layers[0].weight
    reordered = weight.at[:, 2:].set(weight[:, 2:][:, order])
    moved = eqx.tree_at(lambda net: net.edge.layers[0].weight, net, reordered)
    near = Neighbourhood(graph[order][:, order], jnp.zeros((3, 3, 0)), features=seen[order])
    np.testing.assert_allclose(hear(moved, hidden[order], near), before[order], atol=1e-6)
    assert np.abs(hear(net, hidden[order], near) - before[order]).max() > 1e-3
