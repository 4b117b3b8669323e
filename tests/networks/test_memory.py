"""Where memories begin anew: by hand, and along many steps beside one step after the other."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import drawn

from gacrl.config.algorithms import NetworkConfig
from gacrl.envs.probes import Probe
from gacrl.networks.agent import AgentMemory, AgentNetwork, unroll
from gacrl.networks.critic import Critic
from gacrl.networks.gru import Gru
from gacrl.networks.memory import beginnings, restarted
from gacrl.types import Observation


class Kept(NamedTuple):
    """Of three agents: two numbers each, one number each, and one of the whole team."""

    carry: Any
    symbol: Any
    team: Any


FRESH = Kept(jnp.array([[0.0, -1.0], [-2.0, -3.0], [-4.0, -5.0]]), jnp.array([7, 8, 9]), jnp.array(0.5))
OLD = Kept(jnp.array([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]]), jnp.array([1, 2, 3]), jnp.array(10.0))


def same(found: Any, expected: Any) -> None:
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    for here, there in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_array_equal(here, there)
        assert here.dtype == there.dtype


def test_an_episode_begins_for_all_or_for_nobody():
    same(restarted(FRESH, OLD, jnp.array(True)), FRESH)
    same(restarted(FRESH, OLD, jnp.array(False)), OLD)


def test_an_agent_begins_by_itself_and_leaves_the_team_its_memory():
    found = restarted(FRESH, OLD, jnp.array([True, False, True]))
    same(found, Kept(jnp.array([[0.0, -1.0], [3.0, 4.0], [-4.0, -5.0]]), jnp.array([7, 2, 9]), jnp.array(10.0)))
    same(restarted(FRESH, OLD, jnp.zeros(3, bool)), OLD)
    same(restarted(FRESH, OLD, jnp.ones(3, bool)), FRESH._replace(team=OLD.team))


def test_who_remembers_nothing_has_nothing_to_forget():
    assert restarted((), (), jnp.array(True)) == ()
    nested = AgentMemory((), OLD.carry)
    found = restarted(AgentMemory((), FRESH.carry), nested, jnp.array([False, True, False]))
    same(found, AgentMemory((), jnp.array([[1.0, 2.0], [-2.0, -3.0], [5.0, 6.0]])))


def test_beginnings_by_hand():
    """Five steps; an episode opens with the fourth. A life that ends with a step begins anew before the next one."""
    first = jnp.array([False, False, False, True, False])
    assert beginnings(first, None) is first
    left = jnp.array([[False, True], [True, False], [False, True], [False, False], [True, True]])
    expected = [
        [False, False],  # what was remembered before is as it should be
        [False, True],
        [True, False],
        [True, True],  # the episode begins for everyone, whoever left
        [False, False],  # and what the last step ends is of the next stretch
    ]
    np.testing.assert_array_equal(beginnings(first, left), expected)
    np.testing.assert_array_equal(beginnings(first[3:], left[3:]), [[True, True], [False, False]])
    np.testing.assert_array_equal(beginnings(first[4:], left[4:]), [[False, False]])


# Along many steps.

N, T = 3, 6
ENV = Probe(num_agents=N)
BEGINS = np.array(
    [
        [False, True, False],
        [False, False, False],
        [True, False, False],
        [True, True, True],
        [False, False, False],
        [False, True, True],
    ]
)
KINDS = {
    "recurrent": {"recurrent": True},
    "recurrent, commnet": {"recurrent": True, "communication": "commnet"},
    "dial": {"communication": "dial"},
    "recurrent, dial": {"recurrent": True, "communication": "dial"},
}


def observations() -> Observation:
    """T of them, all different."""
    _, seen = ENV.reset(jax.random.key(0))
    seen = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (T, *leaf.shape)), seen)
    return seen._replace(features=jax.random.normal(jax.random.key(0), (T, N, 2)))


def under_way(memory: Any) -> Any:
    """Something to remember, of each agent something else."""
    return jax.tree.map(lambda leaf: leaf + 0.5 + jnp.arange(N)[:, None] / 4, memory)


@pytest.mark.parametrize("kind", KINDS)
def test_unrolling_with_beginnings_of_each_agent_is_step_by_step_with_resets_of_each(kind: str):
    config = NetworkConfig(width=8, vocabulary=3, **KINDS[kind])
    network: AgentNetwork = drawn(AgentNetwork, ENV, config, 2)
    seen, keys = observations(), jax.random.split(jax.random.key(1), T)
    start = under_way(network.initial_memory(N))
    along = eqx.filter_jit(unroll)
    outputs, memories = along(network, seen, jnp.asarray(BEGINS), start, keys)

    one = eqx.filter_jit(lambda *inputs: network(*inputs))
    memory, kept = start, start
    for t in range(T):
        for agent in np.flatnonzero(BEGINS[t]):
            memory = jax.tree.map(lambda leaf: leaf.at[agent].set(0.0), memory)  # noqa: B023
        now = jax.tree.map(lambda leaf: leaf[t], seen)  # noqa: B023
        expected, memory = one(now, memory, keys[t])
        np.testing.assert_allclose(outputs.head[t], expected.head, atol=1e-6)
        for found, leaf in zip(jax.tree.leaves(memories), jax.tree.leaves(memory), strict=True):
            np.testing.assert_allclose(found[t], leaf, atol=1e-6)
        unbroken, kept = one(now, kept, keys[t])
        assert np.abs(unbroken.head - expected.head).max() > 1e-3, "who forgets says something else"

    everyone = jnp.asarray(BEGINS.all(1))
    for_all, _ = along(network, seen, everyone, start, keys)
    for_each, _ = along(network, seen, jnp.broadcast_to(everyone[:, None], (T, N)), start, keys)
    np.testing.assert_allclose(for_each.head, for_all.head, atol=1e-6)


def test_the_unit_forgets_for_each_agent():
    """Agents know nothing of each other there: each is as it would be alone."""
    gru, x = drawn(Gru, 8), jax.random.normal(jax.random.key(0), (T, N, 8))
    memory = under_way(gru.empty(N))
    together = gru.unroll(x, jnp.asarray(BEGINS), memory)
    for agent in range(N):
        mine = slice(agent, agent + 1)
        alone = gru.unroll(x[:, mine], jnp.asarray(BEGINS[:, agent]), memory[mine])
        np.testing.assert_allclose(together[:, mine], alone, atol=1e-6)


@pytest.mark.parametrize("view", ["local", "central"])
def test_a_critic_forgets_for_each_agent(view: Any):
    critic: Critic = drawn(lambda key: Critic(ENV, NetworkConfig(width=8, recurrent=True), view, key))
    seen, memory = observations(), under_way(critic.initial_memory(N))
    values, memories = critic.unroll(seen, jnp.asarray(BEGINS), memory)
    one = eqx.filter_jit(lambda *inputs: critic(*inputs))
    for t in range(T):
        memory = jnp.where(jnp.asarray(BEGINS[t])[:, None], 0.0, memory)
        expected, memory = one(jax.tree.map(lambda leaf: leaf[t], seen), memory)  # noqa: B023
        np.testing.assert_allclose(values[t], expected, atol=1e-6)
        np.testing.assert_allclose(memories[t], memory, atol=1e-6)
