"""`scouts` is `spread`, except for what the blind see: no landmarks, in whatever way they look."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import gacrl
from gacrl import tasks
from gacrl.envs.symmetry import NUM_SYMMETRIES, turn_vectors
from gacrl.evaluation import references
from gacrl.scene import PLAIN
from gacrl.tasks.spread.environment import Spread
from gacrl.tasks.spread.scouts import Scouts, scene
from gacrl.tasks.spread.settings import ScoutsSettings
from gacrl.tasks.spread.task import SCOUTS

KEY = jax.random.key(3)


def test_it_is_spread_but_for_what_the_blind_see():
    scouts, spread = Scouts(num_agents=4, num_blind=2), Spread(num_agents=4, reward="coverage")
    state, seen = scouts.reset(KEY)
    everything = spread.reset(KEY)[1]
    hidden = np.zeros_like(seen.features, bool)
    hidden[:2, 4:12] = True
    np.testing.assert_array_equal(seen.features, np.where(hidden, 0.0, everything.features))
    things = scouts.entities(seen)
    np.testing.assert_array_equal(things.landmark_mask, [[False] * 4, [False] * 4, [True] * 4, [True] * 4])
    assert np.asarray(things.agent_mask).all(), "the blind see the others, and are seen"
    np.testing.assert_array_equal(scouts.from_features(everything.features).features, seen.features)

    action = jnp.array([1, 2, 3, 4])
    after, result = scouts.step(state, action, KEY)
    expected, theirs = spread.step(state, action, KEY)
    jax.tree.map(np.testing.assert_array_equal, after, expected)
    np.testing.assert_array_equal(result.reward, theirs.reward)
    np.testing.assert_array_equal(np.asarray(result.observation.state), np.asarray(theirs.observation.state))
    assert set(result.info) == {*theirs.info, "success_0.2"}


def test_copies_side_by_side_are_blinded_too():
    env = Scouts(num_landmark_neighbors=2)
    states, seen = jax.vmap(env.reset)(jax.random.split(KEY, 5))
    np.testing.assert_array_equal(env.observe_many(states).features, seen.features)
    assert not np.asarray(seen.features)[:, 0, 4:8].any()


@pytest.mark.parametrize("symmetry", range(NUM_SYMMETRIES))
def test_the_turned_world_is_the_same_task(symmetry: int):
    env, turn, action = Scouts(), jnp.int32(symmetry), jnp.array([1, 3, 4])
    state, _ = env.reset(KEY)
    turned = state._replace(**{part: turn_vectors(getattr(state, part), turn) for part in state._fields[:3]})
    after, there = env.step(state, action, KEY)[1], env.step(turned, env.turn_action(action, turn), KEY)[1]
    expected = env.turn(after.observation, turn)
    np.testing.assert_allclose(there.observation.features, expected.features, atol=1e-6)
    np.testing.assert_allclose(there.reward, after.reward, atol=1e-6)
    landmarks = env.entities(there.observation).landmark_mask
    np.testing.assert_array_equal(landmarks, [[False] * 3, [True] * 3, [True] * 3])


def test_who_is_absent_is_absent_and_the_blind_are_there_first():
    settings = ScoutsSettings(num_agents=4, num_agents_start=2)
    env = SCOUTS.make(settings)
    params = SCOUTS.difficulty(settings, SCOUTS.numbers(settings, env), jnp.zeros(()))
    seen = env.reset(KEY, params)[1]
    np.testing.assert_array_equal(seen.agent_mask, [True, True, False, False])
    things = env.entities(seen)
    np.testing.assert_array_equal(np.asarray(things.landmark_mask).sum(1), [0, 2, 0, 0])
    np.testing.assert_array_equal(np.asarray(things.agent_mask).sum(1), [1, 1, 0, 0])


@pytest.mark.soak
def test_floors_and_ceilings():
    played = {
        who: references.play_scripted(who, "scouts", ScoutsSettings(), 512) for who in ("random", "silent", "told")
    }
    returns = {who: metrics["return_agent_mean"] for who, metrics in played.items()}
    assert -28.5 < returns["random"] < -25.5
    assert -12.0 < returns["silent"] < -10.5
    assert -7.4 < returns["told"] < -6.5
    assert played["silent"]["success_final_0.2"] < 0.2 and played["told"]["success_final_0.2"] > 0.98
    assert references.shown(SCOUTS) == ["random", "noop", "told", "silent"]


@pytest.mark.parametrize("continuous", [False, True])
def test_the_silent_blind_do_nothing_that_depends_on_landmarks(continuous: bool):
    env = Scouts(num_agents=5, num_blind=2, continuous_actions=continuous)
    actor = references.actor(SCOUTS, "silent", env)
    act = jax.jit(lambda memory, seen: actor.policy(memory, seen, KEY))
    (state, seen), memory = env.reset(KEY), actor.initial_memory
    for _ in range(5):
        decision, memory = act(memory, seen)
        assert not np.asarray(decision.action)[:2].any()
        assert np.asarray(decision.action)[2:].any()
        state, after = env.step(state, decision.action, KEY)
        seen = after.observation


def test_a_picture_shows_who_is_blind():
    settings = ScoutsSettings(num_agents=3, num_blind=2)
    env = SCOUTS.make(settings)
    shown = scene(settings, env.reset(KEY)[0], env.default_params())
    np.testing.assert_array_equal(shown.agents.colour, [0, 0, PLAIN])


def test_a_task_is_found_by_its_own_settings():
    """Though those of scouts are spread's, and more."""
    for thing, name in ((Scouts(num_blind=2), "scouts"), (Spread(), "spread"), (ScoutsSettings(), "scouts")):
        found = tasks.ours(thing)
        assert found is not None and found[0] == name
        assert found[1] == type(found[1])(**{key: getattr(thing, key) for key in vars(found[1])})


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        ({"num_blind": 3}, "env.num_blind must be below env.num_agents, 3, not 3: somebody must see"),
        ({"num_blind": 0}, "env.num_blind must be between 1 and 10000, not 0"),
        ({"num_agents": 1}, "env.num_blind must be below env.num_agents, 1, not 1"),
        ({"max_cycles": 0}, "env.max_cycles must be between 1 and 1000000, not 0"),
    ],
)
def test_settings_out_of_range_are_named(settings: dict[str, Any], sentence: str):
    with pytest.raises(gacrl.ConfigError, match=sentence):
        gacrl.make_env("scouts", **settings)
