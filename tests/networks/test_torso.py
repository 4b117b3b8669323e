"""The graph torso, alone and under every kind of communication: what it must not depend on, it does not."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import drawn

from gacrl.config.algorithms import NetworkConfig
from gacrl.envs.probes import Probe
from gacrl.networks import torso as torsos
from gacrl.networks.agent import AgentNetwork
from gacrl.tasks.spread.environment import Spread, SpreadParams, SpreadState
from gacrl.types import Observation

pytestmark = pytest.mark.usefixtures("quick_start")

KINDS = ("commnet", "discrete")
"""Soft symbols are the discrete ones where nothing is drawn; they differ in their gradients."""


def config(communication: Any = "none", **settings: Any) -> NetworkConfig:
    return NetworkConfig(
        torso="graph", width=8, vocabulary=3, rounds=2, radius=1.2, communication=communication, **settings
    )


def network_for(env: Spread, communication: str = "none", **settings: Any) -> AgentNetwork:
    """The same parameters for every task."""
    return drawn(AgentNetwork, env, config(communication, **settings), env.num_actions)


def world(num_agents: int, num_landmarks: int, seed: int = 0) -> SpreadState:
    numbers = np.random.default_rng(seed)
    sizes = (num_agents, num_agents, num_landmarks, num_landmarks)
    places = [jnp.asarray(numbers.uniform(-1, 1, (size, 2)), jnp.float32) for size in sizes]
    return SpreadState(*places, jnp.zeros((), jnp.int32))


class Graphs(NamedTuple):
    """Outputs with who hears whom by distance, everyone, and as the task prescribes."""

    near: Any
    everyone: Any
    prescribed: Any
    torso: Any


@eqx.filter_jit
def outputs(network: AgentNetwork, env: Spread, state: SpreadState, ring: jax.Array | None = None, **masks: Any):
    """The head in each of the three graphs (in the first only, without a ring), and the torso's vectors."""
    seen = env.observe(state, SpreadParams(**masks))
    graphs = [seen]
    if ring is not None:
        graphs += [seen._replace(positions=None), seen._replace(adjacency=ring)]
    heads = [network(graph)[0].head for graph in graphs]
    return Graphs(*[*heads, None, None][:3], network.torso(seen))


def same(found: Graphs, expected: Graphs, order: Any = slice(None), atol: float = 1e-5) -> None:
    """found[order] is what is expected, in all that there is."""
    for name, here, there in zip(Graphs._fields, found, expected, strict=True):
        if here is not None:
            np.testing.assert_allclose(here[order], there, atol=atol, err_msg=name)


FOUR, RING = Spread(4, 3), jnp.roll(jnp.eye(4, dtype=bool), 1, axis=1)


@pytest.mark.parametrize("kind", KINDS)
def test_the_order_of_agents_and_landmarks_does_not_matter(kind: str):
    network, state, ring = network_for(FOUR, kind), world(4, 3), RING
    agents, landmarks = np.array([2, 0, 3, 1]), np.array([1, 2, 0])
    before = outputs(network, FOUR, state, ring)
    heads = np.stack(before[:3])
    assert np.ptp(heads, axis=0).max() > 0.01, "the graphs differ"
    assert np.ptp(heads, axis=1).max() > 0.05, "the agents differ"
    for order, places in ((agents, np.arange(3)), (np.arange(4), landmarks), (agents, landmarks)):
        moved = SpreadState(
            state.positions[order],
            state.velocities[order],
            state.landmarks[places],
            state.landmark_velocities[places],
            state.clock,
        )
        same(outputs(network, FOUR, moved, ring[order][:, order]), before, np.argsort(order))


def test_the_whole_world_may_be_moved():
    """And it is the world's place alone that does not matter: velocities do."""
    network, state, shift = network_for(FOUR, "discrete"), world(4, 3), jnp.array([[0.7, -1.3]])
    here = outputs(network, FOUR, state, RING)
    moved = state._replace(positions=state.positions + shift, landmarks=state.landmarks + shift)
    same(outputs(network, FOUR, moved, RING), here)
    faster = outputs(network, FOUR, state._replace(velocities=state.velocities + 1.0), RING)
    assert np.abs(faster.torso - here.torso).max() > 0.05


@pytest.mark.parametrize(
    ("kind", "limits"), [("commnet", {}), ("discrete", {"nearest_landmarks": 2, "nearest_agents": 2})]
)
def test_padding_is_not_there(kind: str, limits: dict[str, int]):
    """Three agents and two landmarks, and the same with padding in between, wherever that stands."""
    small, large = Spread(3, 2), Spread(5, 4)
    state, bigger = world(3, 2), world(5, 4, seed=1)
    agents, landmarks = np.array([True, False, True, True, False]), np.array([False, True, True, False])
    padded = bigger._replace(
        positions=bigger.positions.at[agents].set(state.positions),
        velocities=bigger.velocities.at[agents].set(state.velocities),
        landmarks=bigger.landmarks.at[landmarks].set(state.landmarks),
    )
    masks = {"agent_mask": jnp.asarray(agents), "landmark_mask": jnp.asarray(landmarks)}
    expected = outputs(network_for(small, kind), small, state)
    same(outputs(network_for(large, kind, **limits), large, padded, **masks), expected, agents)


def test_only_the_nearest_are_looked_at():
    """All of them are no limit; one is what a task shows that itself shows no more than the nearest."""
    env, state = FOUR, world(4, 3)
    everything = outputs(network_for(env), env, state)
    limited = network_for(env, nearest_landmarks=3, nearest_agents=50)
    same(outputs(limited, env, state), everything, atol=0)
    # Places in an observation that nobody fills are padding.
    roomy = Spread(4, 3, num_agent_neighbors=5, num_landmark_neighbors=4)
    same(outputs(network_for(roomy), roomy, state), everything)
    narrow = Spread(4, 3, num_agent_neighbors=1, num_landmark_neighbors=1)
    found = outputs(network_for(env, nearest_landmarks=1, nearest_agents=1), env, state)
    same(found, outputs(network_for(narrow), narrow, state), atol=1e-6)
    assert np.abs(found.torso - everything.torso).max() > 0.01


def test_one_set_of_parameters_serves_any_team():
    for team in (1, 2, 7):
        env = Spread(team, team)
        network = network_for(env, "discrete")
        for here, there in zip(
            jax.tree.leaves(network), jax.tree.leaves(network_for(Spread(3, 3), "discrete")), strict=True
        ):
            np.testing.assert_array_equal(here, there)
        found = outputs(network, env, world(team, team))
        assert found.near.shape == (team, 5) and np.isfinite(found.near).all()


@pytest.mark.parametrize("kind", [*KINDS, "soft"])
def test_gradients_are_finite_where_everything_stands_in_one_place(kind: str):
    env = Spread(3, 3)
    state = jax.tree.map(jnp.zeros_like, world(3, 3))

    @eqx.filter_jit
    def gradients(network: AgentNetwork, features: jax.Array) -> Any:
        def loss(parts: Any) -> jax.Array:
            network, features = parts
            observation = env.observe(state, SpreadParams())._replace(features=features)
            return jnp.square(network(observation, (), jax.random.key(1))[0].head).sum()

        return jax.grad(loss)((network, features))

    found = gradients(network_for(env, kind), jnp.zeros((3, env.observation_size)))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(found))
    assert np.abs(found[0].head.weight).max() > 0


def test_a_task_without_space_is_a_graph_of_one():
    """Agents then are what their features say, each for itself."""
    env = Probe()
    torso = drawn(torsos.make, env, config())
    seen = Observation(None, None, None, None, None)._replace(features=jnp.array([[1.0, 0.5], [1.0, 0.5]]))
    act = eqx.filter_jit(lambda seen: torso(seen))
    same = act(seen)
    np.testing.assert_array_equal(same[0], same[1])
    other = act(seen._replace(features=seen.features.at[1].set(-1.0)))
    np.testing.assert_array_equal(other[0], same[0])
    assert np.abs(other[1] - same[1]).max() > 0.05
