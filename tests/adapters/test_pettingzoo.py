"""Our tasks under PettingZoo's API: its own tests, and the very numbers of the task."""

import warnings
from dataclasses import replace
from functools import partial
from types import SimpleNamespace
from typing import Any

import jax
import numpy as np
import pettingzoo
import pytest
from gymnasium.utils.env_checker import data_equivalence
from pettingzoo.utils.conversions import parallel_to_aec

import gacrl
from gacrl import tasks
from gacrl.adapters.pettingzoo import ParallelTask

with warnings.catch_warnings():  # one of its tests imports an environment in a way that it warns of
    warnings.simplefilter("ignore", DeprecationWarning)
    from pettingzoo.test import max_cycles_test, parallel_api_test, parallel_seed_test, render_test


def aec(**settings: Any) -> Any:
    """Make the turn-based form, which two of PettingZoo's tests want."""
    return parallel_to_aec(gacrl.to_pettingzoo("speaker_listener", **settings))


@pytest.mark.parametrize("task", ["spread", "speaker_listener", "traffic_junction"])
def test_pettingzoos_own_tests_pass(task: str):
    parallel_api_test(gacrl.to_pettingzoo(task), num_cycles=60)
    parallel_seed_test(partial(gacrl.to_pettingzoo, task), num_cycles=20)


def test_they_stand_in_pettingzoos_registry():
    env = pettingzoo.make("parallel", "gacrl/spread-v0", num_agents=4, max_cycles=7)
    assert (len(env.possible_agents), env.max_cycles, env.metadata["name"]) == (4, 7, "gacrl_spread_v0")
    assert isinstance(env, ParallelTask)
    assert isinstance(pettingzoo.make("aec", "gacrl/reference"), pettingzoo.AECEnv)


def test_episodes_end_when_max_cycles_says():
    max_cycles_test(SimpleNamespace(parallel_env=partial(gacrl.to_pettingzoo, "speaker_listener"), env=aec))


def test_pictures_pass_pettingzoos_test(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    render_test(aec)  # both render modes


def played(env: Any, seed: int | None, steps: int) -> list[Any]:
    """Everything that an environment hands out under drawn actions, over several episodes."""
    draws = np.random.default_rng(3)
    seen: list[Any] = [env.reset(seed=seed)]
    for _ in range(steps):
        if not env.agents:
            seen.append(env.reset())
        actions = {agent: int(draws.integers(env.action_space(agent).n)) for agent in env.agents}
        seen.append((env.step(actions), env.state()))
    return seen


def test_a_seed_fixes_all_that_follows():
    make = partial(gacrl.to_pettingzoo, "reference", max_cycles=7)
    first, again = played(make(), 5, 30), played(make(), 5, 30)
    used = make()
    played(used, 1, 11)
    assert data_equivalence(first, again)
    assert data_equivalence(first, played(used, 5, 30)), "what was played before does not matter"
    assert not data_equivalence(first, played(make(), 6, 30))
    assert not data_equivalence(played(make(), None, 3), played(make(), None, 3)), (
        "without a seed, another episode"
    )
    openings = [step[0]["agent_0"] for step in first if isinstance(step[1], dict) and len(step) == 2]
    assert len({row.tobytes() for row in openings}) == len(openings) == 5, "episodes of a seed differ"


def test_numbers_are_those_of_the_task():
    """The same key, the same actions: observations, rewards, end and measurements of the bare task."""
    task, settings = tasks.find("spread"), replace(tasks.default_settings("spread"), num_agents=4, max_cycles=6)
    env, bare = gacrl.to_pettingzoo("spread", num_agents=4, max_cycles=6), task.make(settings)
    params = task.numbers(settings, bare)
    seen, _ = env.reset(seed=9)
    key, start = jax.random.split(jax.random.key(9))
    state, observation = bare.reset(start, params)
    for step in range(6):
        assert np.array_equal(np.stack(list(seen.values())), observation.features)
        action = np.full(4, step % 5)
        key, draw = jax.random.split(key)
        state, after = jax.jit(bare.step)(state, action, draw, params)
        seen, rewards, _, truncated, infos = env.step(dict(zip(env.agents, action, strict=True)))
        observation = after.observation
        np.testing.assert_allclose(list(rewards.values()), after.reward, rtol=1e-6)
        assert set(truncated.values()) == {step == 5}
        assert infos["agent_3"]["coverage_0.1"] == float(after.info["coverage_0.1"])
    assert env.agents == [] and env.step({}) == ({}, {}, {}, {}, {})
    assert env.state().shape == env.state_space.shape


def test_an_action_that_an_agent_lacks_is_its_first():
    env = gacrl.to_pettingzoo("speaker_listener")
    _, infos = env.reset(seed=0)
    mask = infos["agent_0"]["action_mask"]
    assert mask.sum() < mask.size
    lacking, first = ({agent: int(action) for agent in env.agents} for action in (mask.argmin(), mask.argmax()))
    lacking["agent_1"] = first["agent_1"] = 1
    one = env.step(lacking)
    env.reset(seed=0)
    assert data_equivalence(one, env.step(first))


class Unseen(gacrl.Environment):
    """A task without places."""

    num_agents, num_actions, observation_size, max_cycles = 2, 2, 1, 3

    def reset(self, key: Any, params: Any = ()) -> Any:
        return jax.numpy.zeros(()), gacrl.observe(jax.numpy.zeros((2, 1)), num_actions=2)

    def step(self, state: Any, action: Any, key: Any, params: Any = ()) -> Any:
        seen = gacrl.observe(jax.numpy.zeros((2, 1)), num_actions=2)
        false = jax.numpy.zeros((), bool)
        return state, gacrl.TimeStep(seen, jax.numpy.zeros(2), false, false)


def wrong_action(env: Any) -> None:
    env.reset(seed=0)
    env.step({"agent_0": 1, "agent_1": 2})


@pytest.mark.parametrize(
    ("use", "sentence"),
    [
        (lambda: gacrl.to_pettingzoo("spread", colour=1), "colour"),
        (lambda: gacrl.to_pettingzoo("spred"), "did you mean 'spread'"),
        (lambda: gacrl.to_pettingzoo("spread", "rgb"), "did you mean 'rgb_array'"),
        (lambda: gacrl.to_pettingzoo(Unseen()).step({}), None),
        (lambda: wrong_action(gacrl.to_pettingzoo(Unseen())), "the action of agent_1 is 2"),
        (lambda: gacrl.to_pettingzoo(Unseen()).render(), 'render_mode="rgb_array"'),
        (lambda: gacrl.to_pettingzoo(Unseen(), "rgb_array").reset(), "does not say where things are"),
        (lambda: gacrl.to_pettingzoo("spread").state(), "before the first reset"),
    ],
)
def test_mistakes_are_one_sentence(use: Any, sentence: str | None, unchecked: None):
    if sentence is None:
        assert use() == ({}, {}, {}, {}, {})
        return
    with pytest.raises(gacrl.UserError, match=sentence.replace("(", r"\(")):
        use()
