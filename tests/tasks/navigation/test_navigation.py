"""The navigation tasks: step for step MPE2's, symmetric, and of the floors and ceilings that make talk worth something."""

from dataclasses import replace
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mpe2 import simple_reference_v3, simple_speaker_listener_v4

import gacrl
from gacrl import tasks
from gacrl.adapters import mpe2
from gacrl.envs.symmetry import NUM_SYMMETRIES, turn_vectors
from gacrl.evaluation import references
from gacrl.tasks.navigation.environment import MOVES, Navigation, NavigationState, make
from gacrl.tasks.navigation.settings import ColoursSettings, ReferenceSettings, SpeakerListenerSettings
from gacrl.types import Entities

MPE2: dict[str, ModuleType] = {
    "reference": simple_reference_v3,
    "speaker_listener": simple_speaker_listener_v4,
}
PLAIN: dict[str, Any] = {"goal_bonus": 0.0, "identity": False}
"""MPE2's own task."""


def environment(name: str, **settings: Any) -> Navigation:
    return make(replace(tasks.default_settings(name), **settings))


def features_of(things: Entities) -> np.ndarray:
    assert things.landmark_features is not None
    return np.asarray(things.landmark_features)


def heard(env: Navigation) -> np.ndarray:
    adjacency = env.reset(jax.random.key(0))[1].adjacency
    assert adjacency is not None
    return np.asarray(adjacency)


def state_of(world: Any, words: np.ndarray, clock: int) -> NavigationState:
    """The state of one of MPE2's worlds."""
    state = jax.tree.map(lambda leaf: leaf[0], mpe2.navigation_state([world]))
    return state._replace(words=jnp.asarray(words, jnp.int32), clock=jnp.int32(clock))


@pytest.mark.parametrize(
    ("name", "talk", "actions"),
    [
        ("reference", "actions", [50, 50]),
        ("reference", "messages", [5, 5]),
        ("speaker_listener", "actions", [3, 5]),
        ("speaker_listener", "messages", [1, 5]),
    ],
)
def test_the_spaces_are_mpe2s(name: str, talk: str, actions: list[int]):
    """Each agent sees MPE2's numbers and has MPE2's actions; with messages it moves, and says the first utterance."""
    env, theirs = environment(name, talk=talk, **PLAIN), MPE2[name].parallel_env()
    seen, _ = theirs.reset(seed=0)
    numbers = [np.arange(1.0, 1.0 + row.size) for row in seen.values()]
    kept = [set(row[row > 0]) for row in env.stack(numbers)]
    lost = [set(row) - left for row, left in zip(numbers, kept, strict=True)]
    words = {"reference": [10, 10], "speaker_listener": [0, 3]}[name]
    assert [len(row) for row in lost] == ([0, 0] if talk == "actions" else words), (
        "what MPE2's agents say is not heard"
    )
    available = np.asarray(env.reset(jax.random.key(0))[1].action_mask)
    assert available.sum(1).tolist() == actions
    spaces = [theirs.action_space(agent) for agent in theirs.possible_agents]
    if talk == "actions":
        assert [space.n for space in spaces] == actions
    for agent, space in enumerate(spaces):
        possible = [env.unstack(np.full(2, action))[agent] for action in np.flatnonzero(available[agent])]
        expected = range(space.n) if talk == "actions" else range(actions[agent])
        assert possible == list(expected)


@pytest.mark.parametrize("talk", ["messages", "actions"])
@pytest.mark.parametrize("name", MPE2)
def test_every_step_is_mpe2s(name: str, talk: str):
    """Places, velocities, rewards and observations, from MPE2's state at every step; with its own utterances or none."""
    env = environment(name, talk=talk, max_cycles=12, **PLAIN)
    theirs = MPE2[name].parallel_env(max_cycles=12)
    params, step, show = env.default_params(), jax.jit(env.step), jax.jit(env.observe)
    draw = np.random.default_rng(3)
    compared = 0
    for seed in range(8):
        seen, _ = theirs.reset(seed=seed)
        world, agents = theirs.unwrapped.world, theirs.possible_agents
        words, clock = np.full(2, -1), 0
        while theirs.agents:
            state = state_of(world, words, clock)
            ours = np.asarray(show(state).features)
            np.testing.assert_allclose(env.stack([seen[agent] for agent in agents]), ours, atol=1e-5)
            possible = np.asarray(show(state).action_mask)
            action = np.array([draw.choice(np.flatnonzero(row)) for row in possible])
            after, result = step(state, jnp.asarray(action), jax.random.key(0), params)
            seen, rewards, _, truncated, _ = theirs.step(dict(zip(agents, env.unstack(action), strict=True)))
            words, clock = action // MOVES if talk == "actions" else words, clock + 1
            there = state_of(world, words, clock)
            for part in ("positions", "velocities", "landmarks", "goals"):
                np.testing.assert_allclose(getattr(after, part), getattr(there, part), atol=1e-5, err_msg=part)
            np.testing.assert_allclose(result.reward, [rewards[agent] for agent in agents], rtol=2e-5)
            np.testing.assert_allclose(result.info["reward_raw"], np.mean(list(rewards.values())), rtol=2e-5)
            assert bool(result.truncated) == all(truncated.values())
            compared += 1
    assert compared == 8 * 12


@pytest.mark.parametrize(
    ("name", "settings"),
    [
        ("speaker_listener", {}),
        ("speaker_listener", {"talk": "actions"}),
        ("reference", {}),
        ("reference", {"talk": "actions"}),
        ("colours", {"graph": "full"}),
        ("colours", {"named": False}),
    ],
)
def test_the_turned_world_is_the_same_task(name: str, settings: dict[str, Any]):
    env = environment(name, **settings)
    state, seen = env.reset(jax.random.key(4))
    action = jnp.array([np.flatnonzero(row)[-1] for row in np.asarray(seen.action_mask)])
    after = env.step(state, action, jax.random.key(0))[1]
    for symmetry in range(NUM_SYMMETRIES):
        turn = jnp.int32(symmetry)
        places = ("positions", "velocities", "landmarks")
        turned = state._replace(**{part: turn_vectors(getattr(state, part), turn) for part in places})
        result = env.step(turned, env.turn_action(action, turn), jax.random.key(0))[1]
        expected = env.turn(after.observation, turn)
        np.testing.assert_allclose(result.observation.features, expected.features, atol=1e-6)
        np.testing.assert_allclose(np.asarray(result.observation.state), np.asarray(expected.state), atol=1e-6)
        np.testing.assert_allclose(result.reward, after.reward, atol=1e-6)


def test_what_is_seen_thing_by_thing():
    """Goals are bright whatever MPE2's colours; who cannot move sees no landmarks; an own order has no names."""
    listener = environment("speaker_listener")
    state, seen = listener.reset(jax.random.key(1))
    things = listener.entities(seen)
    goal = int(state.goals[1])
    np.testing.assert_allclose(things.own[:, 2:5], [np.eye(3)[goal], np.zeros(3)], atol=1e-6)
    np.testing.assert_array_equal(things.landmark_mask, [[False] * 3, [True] * 3])
    np.testing.assert_allclose(things.landmarks[1], state.landmarks - state.positions[1][None], atol=1e-6)
    np.testing.assert_array_equal(features_of(things)[1], np.eye(3))
    assert things.agents.shape == (2, 0, 2)

    places = environment("colours", named=False)
    state, seen = places.reset(jax.random.key(2))
    things = places.entities(seen)
    for agent in range(3):
        known = state.landmarks[state.goals[(agent + 1) % 3]] - state.positions[agent]
        marked = np.flatnonzero(features_of(things)[agent, :, 0])
        assert marked.size == 1
        np.testing.assert_allclose(things.landmarks[agent, marked[0]], known, atol=1e-6)
    assert len({tuple(row) for row in np.asarray(state.order)}) > 1, "everyone has an order of its own"
    others = state.positions[1:] - state.positions[0][None]
    np.testing.assert_allclose(things.agents[0], others, atol=1e-6)
    names = things.agent_features
    assert names is not None, "one's own number and the order of the row tell who the others are"
    np.testing.assert_array_equal(np.asarray(names).argmax(-1), [[1, 2], [0, 2], [0, 1]])
    nameless = environment("colours", identity=False)
    assert nameless.entities(nameless.reset(jax.random.key(2))[1]).agent_features is None


def test_rings_and_full_graphs():
    ring, full = environment("colours"), environment("colours", graph="full", num_agents=4)
    np.testing.assert_array_equal(heard(ring), np.roll(np.eye(3), 1, 0).astype(bool))
    np.testing.assert_array_equal(heard(full), ~np.eye(4, dtype=bool))
    utters = environment("reference", talk="actions")
    assert not heard(utters).any(), "nothing is heard but the utterances"


def test_the_bonus_is_learned_from_and_not_measured():
    env = environment("reference", goal_bonus=2.0)
    state, _ = env.reset(jax.random.key(0))
    state = state._replace(positions=state.landmarks[state.goals], velocities=jnp.zeros((2, 2)))
    after = env.step(state, jnp.zeros(2, int), jax.random.key(0))[1]
    np.testing.assert_allclose(after.reward, 2.0, atol=1e-6)
    np.testing.assert_allclose(after.info["reward_raw"], 0.0, atol=1e-6)
    assert after.info["success_0.1"] == 1.0 and after.info["reached_0.2"] == 1.0


@pytest.mark.parametrize(
    ("name", "policy", "low", "high"),
    [
        ("speaker_listener", "random", -42.5, -37.5),
        ("speaker_listener", "silent", -16.5, -14.0),
        ("speaker_listener", "told", -7.6, -6.7),
        ("reference", "random", -29.5, -27.0),
        ("reference", "silent", -18.0, -16.5),
        ("reference", "told", -7.7, -7.0),
        ("colours", "silent", -18.0, -16.5),
        ("colours", "told", -7.8, -7.1),
    ],
)
def test_floors_and_ceilings(name: str, policy: str, low: float, high: float):
    played = references.play_scripted(policy, name, tasks.default_settings(name), 512)
    assert low < played["return_agent_mean"] < high
    assert (played["success_final_0.1"] > 0.99) == (policy == "told")


@pytest.mark.parametrize(
    ("name", "settings", "sentence"),
    [
        ("colours", {"talk": "actions"}, "env.talk must be messages, not actions: this task has no utterances"),
        ("colours", {"num_agents": 1}, "env.num_agents must be between 2 and 10, not 1"),
        ("colours", {"num_agents": 99}, "env.num_agents must be between 2 and 10, not 99"),
        ("reference", {"local_ratio": 2.0}, "env.local_ratio must be between 0 and 1, not 2.0"),
        ("speaker_listener", {"num_agents": 3}, "unknown setting 'env.num_agents'"),
    ],
)
def test_settings_out_of_range_are_named(name: str, settings: dict[str, Any], sentence: str):
    with pytest.raises(gacrl.ConfigError, match=sentence):
        gacrl.make_env(name, **settings)


def test_settings_that_are_made_by_hand_are_looked_over_too():
    for kind in (SpeakerListenerSettings, ReferenceSettings, ColoursSettings):
        with pytest.raises(gacrl.ConfigError, match="max_cycles"):
            kind(max_cycles=0)
