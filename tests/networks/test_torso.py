"""The graph torso, alone and under every kind of communication: what it must not depend on, it does not."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import drawn

from gacrl.config.algorithms import NetworkConfig
from gacrl.envs.environment import Environment, observe
from gacrl.envs.probes import Probe
from gacrl.networks import torso as torsos
from gacrl.networks.agent import AgentNetwork
from gacrl.tasks.spread.environment import Spread, SpreadState
from gacrl.types import Entities, Observation

pytestmark = pytest.mark.usefixtures("quick_start")

KINDS = ("commnet", "discrete", "tarmac", "ic3net")
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
    seen = env.observe(state, env.default_params()._replace(**masks))
    graphs = [seen]
    if ring is not None:
        everyone = ~jnp.eye(ring.shape[0], dtype=bool)
        graphs += [seen._replace(adjacency=everyone), seen._replace(adjacency=ring)]
    heads = [network(graph)[0].head for graph in graphs]
    return Graphs(*[*heads, None, None][:3], network.torso(seen).hidden)


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
    ("kind", "limits"),
    [
        ("commnet", {}),
        ("discrete", {"nearest_landmarks": 2, "nearest_agents": 2}),
        ("tarmac", {"nearest_agents": 2}),
        ("ic3net", {"nearest_agents": 2}),
    ],
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
            observation = env.observe(state, env.default_params())._replace(features=features)
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
    act = eqx.filter_jit(lambda seen: torso(seen).hidden)
    same = act(seen)
    np.testing.assert_array_equal(same[0], same[1])
    other = act(seen._replace(features=seen.features.at[1].set(-1.0)))
    np.testing.assert_array_equal(other[0], same[0])
    assert np.abs(other[1] - same[1]).max() > 0.05


# What is known of an entity besides where it stands.


@dataclass(frozen=True)
class Beacons(Environment):
    """Two agents that see beacons, and each other. Of each thing four numbers: offset, feature, and 1 if it is there."""

    beacons: int = 3
    told: bool = True
    """Whether the torso gets to know the features."""
    num_agents: int = 2
    num_actions: int = 3
    max_cycles: int = 5

    @property
    def observation_size(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        return 1 + 4 * (self.beacons + 1)

    def reset(self, key: Any, params: Any = ()) -> Any:
        return (), observe(jnp.zeros((2, self.observation_size)), num_actions=3)

    def step(self, state: Any, action: Any, key: Any, params: Any = ()) -> Any:
        raise NotImplementedError

    def entities(self, observation: Observation) -> Entities:
        things = observation.features[:, 1:].reshape(2, -1, 4)
        beacons, others = things[:, :-1], things[:, -1:]
        return Entities(
            own=observation.features[:, :1],
            landmarks=beacons[..., :2],
            agents=others[..., :2],
            landmark_mask=beacons[..., 3] > 0,
            agent_mask=others[..., 3] > 0,
            landmark_features=beacons[..., 2:3] if self.told else None,
            agent_features=others[..., 2:3] if self.told else None,
        )


FIRST_OTHER = [[0.5, -0.5, 0.0, 1.0]]
HERE = [[0.4, 0.2, 1.0, 1.0], [-0.6, 0.1, -1.0, 1.0], [0.3, -0.7, 0.5, 1.0]]
"""Three beacons as both agents see them."""


def look(beacons: list[list[float]], other: list[list[float]] = FIRST_OTHER, **settings: Any) -> np.ndarray:
    """The vectors of two agents: the first sees these beacons and this other agent, the second always the same."""
    told, rest = settings.pop("told", True), HERE[:1] * len(beacons)
    env = Beacons(len(beacons), told)
    rows = [[0.7, *np.ravel([*beacons, *other])], [0.7, *np.ravel([*rest, *FIRST_OTHER])]]
    seen = observe(jnp.asarray(rows, jnp.float32), num_actions=3)
    torso = drawn(torsos.make, env, config(**settings))
    return np.asarray(eqx.filter_jit(lambda torso, seen: torso(seen).hidden)(torso, seen))


def changed(things: list[list[float]], row: int, **numbers: float) -> list[list[float]]:
    """The same things, but for some numbers of one of them."""
    places = {"x": 0, "y": 1, "feature": 2, "there": 3}
    things = [list(thing) for thing in things]
    for name, number in numbers.items():
        things[row][places[name]] = number
    return things


@pytest.mark.parametrize("row", range(3))
def test_the_features_of_a_landmark_matter(row: int):
    """To the agent that sees them, and to no other; what the torso is not told, it does not know."""
    before, after = look(HERE), look(changed(HERE, row, feature=2.0))
    assert np.abs(after[0] - before[0]).max() > 0.01
    np.testing.assert_array_equal(after[1], before[1])
    np.testing.assert_array_equal(look(changed(HERE, row, feature=2.0), told=False), look(HERE, told=False))


def test_the_features_of_another_agent_matter():
    marked = changed(FIRST_OTHER, 0, feature=2.0)
    before, after = look(HERE), look(HERE, marked)
    assert np.abs(after[0] - before[0]).max() > 0.01
    np.testing.assert_array_equal(after[1], before[1])
    np.testing.assert_array_equal(look(HERE, marked, told=False), look(HERE, told=False))


def test_who_has_lost_sight_of_landmarks_can_learn_to_see_them_again():
    """Layers that are quiet for every landmark pass no gradient; with a slope they do."""

    def gradient(seen_slope: float) -> float:
        network = network_for(FOUR, seen_slope=seen_slope).torso
        layers = network.landmark.layers
        quiet = eqx.tree_at(lambda layer: layer.bias, layers[-1], layers[-1].bias - 100.0)
        network = eqx.tree_at(lambda net: net.landmark.layers, network, (*layers[:-1], quiet))

        def hidden(landmarks: jax.Array) -> jax.Array:
            state = world(4, 3)._replace(landmarks=landmarks)
            return jnp.square(network(FOUR.observe(state, FOUR.default_params())).hidden).sum()

        return float(jnp.abs(jax.grad(hidden)(world(4, 3).landmarks)).sum())

    assert gradient(0.0) == 0.0
    assert gradient(0.1) > 1e-4


def test_features_tell_apart_what_stands_at_the_same_place():
    """Two beacons at one place: it matters which features there are, and not which of them has which."""
    twins = [[0.4, 0.2, 1.0, 1.0], [0.4, 0.2, -1.0, 1.0], HERE[2]]
    exchanged = [twins[1], twins[0], twins[2]]
    np.testing.assert_allclose(look(exchanged), look(twins), atol=1e-6)
    alike = changed(twins, 1, feature=1.0)
    assert np.abs(look(alike)[0] - look(twins)[0]).max() > 0.01


def test_features_go_with_their_landmark():
    """The order of landmarks does not matter; whose feature it is does."""
    order = [2, 0, 1]
    np.testing.assert_allclose(look([HERE[k] for k in order]), look(HERE), atol=1e-6)
    features = [HERE[k][2] for k in order]
    mixed_up = [[*thing[:2], feature, 1.0] for thing, feature in zip(HERE, features, strict=True)]
    assert np.abs(look(mixed_up)[0] - look(HERE)[0]).max() > 0.01


@pytest.mark.parametrize(
    "nonsense",
    [
        {"x": 0.0, "y": 0.0, "feature": 0.0},
        {"x": 0.0, "y": 0.0, "feature": 100.0},
        {"x": 0.05, "y": -0.01, "feature": -3.0},
        {"x": -1e3, "y": 1e3, "feature": 1e3},
    ],
)
def test_what_is_masked_out_is_not_there_whatever_is_said_of_it(nonsense: dict[str, float]):
    """As if there were one landmark less, or no other agent."""
    absent = changed(HERE, 1, there=0.0)
    expected = look(absent)[0]
    np.testing.assert_array_equal(look(changed(absent, 1, **nonsense))[0], expected)
    np.testing.assert_allclose(look([HERE[0], HERE[2]])[0], expected, atol=1e-6)
    assert np.abs(look(HERE)[0] - expected).max() > 0.01
    nobody = changed(FIRST_OTHER, 0, there=0.0)
    alone = look(HERE, nobody)[0]
    np.testing.assert_array_equal(look(HERE, changed(nobody, 0, **nonsense))[0], alone)
    assert np.abs(look(HERE)[0] - alone).max() > 0.01


def test_what_stands_where_the_agent_is_is_there_if_the_mask_says_so():
    """Offset (0, 0) is a place like any other: that something is there matters, and what it is."""
    absent = changed(HERE, 1, x=0.0, y=0.0, there=0.0)
    present = changed(absent, 1, there=1.0)
    assert np.abs(look(present)[0] - look(absent)[0]).max() > 0.01
    assert np.abs(look(changed(present, 1, feature=2.0))[0] - look(present)[0]).max() > 0.01
    np.testing.assert_array_equal(look(changed(absent, 1, feature=2.0)), look(absent))
    close = changed(FIRST_OTHER, 0, x=0.0, y=0.0)
    gone = changed(close, 0, there=0.0)
    assert np.abs(look(HERE, close)[0] - look(HERE, gone)[0]).max() > 0.01


def test_the_nearest_bring_their_features_along():
    """One is looked at: the nearest that is there, also where the agent stands itself."""
    only = look([HERE[0]])[0]
    np.testing.assert_allclose(look(HERE, nearest_landmarks=1)[0], only, atol=1e-6)
    hidden = [*HERE, [0.0, 0.0, 5.0, 0.0]]  # nearer, and not there
    np.testing.assert_allclose(look(hidden, nearest_landmarks=1)[0], only, atol=1e-6)
    shown = changed(hidden, 3, there=1.0)
    np.testing.assert_allclose(look(shown, nearest_landmarks=1)[0], look([shown[3]])[0], atol=1e-6)
    assert np.abs(look([shown[3]])[0] - only).max() > 0.01


def test_a_network_learns_from_features():
    """Every weight of what is told has a slope, of landmarks for rivals as well."""
    env = Beacons()
    torso = drawn(torsos.make, env, config())
    rows = [[0.7, *np.ravel([*HERE, *FIRST_OTHER])], [0.2, *np.ravel([*HERE, *FIRST_OTHER])]]
    seen = observe(jnp.asarray(rows, jnp.float32), num_actions=3)
    seen = seen._replace(features=seen.features.at[:, -2].set(0.8))  # of the other agent
    slope = eqx.filter_jit(eqx.filter_grad(lambda torso: jnp.square(torso(seen).hidden).sum()))(torso)
    # Offsets are five numbers: of the rival to the landmark, and of the agent to it; then what is told of both.
    assert (np.abs(slope.rival.layers[0].weight).max(0)[10:] > 1e-4).all()
    assert np.abs(slope.landmark.layers[0].weight).max(0)[1 + 5] > 1e-4
    assert np.abs(slope.agent.layers[0].weight).max(0)[1 + 5] > 1e-4
    assert torso.rival.layers[0].weight.shape == (4, 5 + 5 + 1 + 1)
    assert torso.landmark.layers[0].weight.shape == (8, 1 + 5 + 1 + 4)
    assert torso.agent.layers[0].weight.shape == (4, 1 + 5 + 1)
