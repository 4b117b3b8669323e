"""The agents' network over time, and the size that is asked for."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import drawn

from gacrl.config.algorithms import NetworkConfig
from gacrl.envs.probes import Probe
from gacrl.networks.agent import AgentMemory, AgentNetwork, matched, unroll
from gacrl.networks.layers import num_parameters
from gacrl.tasks.spread.environment import Spread

ENV, T = Probe(), 6
FIRST = jnp.array([False, False, True, False, True, False])


@pytest.mark.parametrize("kind", ["none", "commnet", "dial"])
def test_unrolling_is_step_by_step_with_a_fresh_memory_at_each_start(kind: Any):
    """From a memory that is already under way."""
    config = NetworkConfig(width=8, vocabulary=3, recurrent=True, communication=kind)
    network: AgentNetwork = drawn(AgentNetwork, ENV, config, 2)
    features = jax.random.normal(jax.random.key(0), (T, 2, 2))
    seen = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (T, *leaf.shape)), ENV.reset(jax.random.key(0))[1])
    seen = seen._replace(features=features)
    keys = jax.random.split(jax.random.key(1), T)
    fresh = network.initial_memory(2)
    memory = jax.tree.map(lambda leaf: leaf + 0.5, fresh)
    outputs, memories = eqx.filter_jit(unroll)(network, seen, FIRST, memory, keys)

    one = eqx.filter_jit(lambda *inputs: network(*inputs))
    for t in range(T):
        if FIRST[t]:
            memory = fresh
        expected, memory = one(jax.tree.map(lambda leaf: leaf[t], seen), memory, keys[t])  # noqa: B023
        np.testing.assert_allclose(outputs.head[t], expected.head, atol=1e-6)
        for found, leaf in zip(jax.tree.leaves(memories), jax.tree.leaves(memory), strict=True):
            np.testing.assert_allclose(found[t], leaf, atol=1e-6)
    assert (
        np.abs(outputs.head[3] - one(jax.tree.map(lambda leaf: leaf[3], seen), fresh, keys[3])[0].head).max()
        > 0.01
    )


def test_messages_of_padded_agents_are_nothing():
    env = Spread(3, 2)
    network: AgentNetwork = drawn(AgentNetwork, env, NetworkConfig(width=8, vocabulary=3, communication="dial"), 5)
    mask = jnp.array([True, False, True])
    _, seen = env.reset(jax.random.key(0), env.default_params()._replace(agent_mask=mask))
    memory = network.initial_memory(3)
    assert isinstance(memory, AgentMemory) and memory.carry == ()
    output, _ = eqx.filter_jit(lambda *inputs: network(*inputs))(seen, memory, jax.random.key(2))
    assert output.messages is not None and output.messages.shape == (1, 3, 3)
    assert (np.asarray(output.messages)[:, [0, 2]] > 0).all() and (output.messages[:, 1] == 0).all()
    assert not output.adjacency[1].any() and not output.adjacency[:, 1].any()


@pytest.mark.parametrize("torso", ["mlp", "graph"])
@pytest.mark.parametrize("communication", ["none", "discrete"])
def test_the_size_asked_for_is_nearly_met(torso: Any, communication: Any):
    env = Spread(3, 3)
    for wanted in (2_000, 27_606):
        asked = NetworkConfig(torso=torso, communication=communication, recurrent=True, parameters=wanted)
        settings = matched(env, asked, 5)
        size = num_parameters(eqx.filter_eval_shape(AgentNetwork, env, settings, 5, jax.random.key(0)))
        assert abs(size / wanted - 1) < 0.06
    unlimited = NetworkConfig(width=24)
    assert matched(env, unlimited, 5) is unlimited
