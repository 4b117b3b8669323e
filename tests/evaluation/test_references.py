"""The policies that every task has: random among what may be done, and nothing."""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gacrl.envs.environment import Environment, observe
from gacrl.errors import ConfigError
from gacrl.evaluation import references
from gacrl.tasks.task import Task
from gacrl.types import Actor

KEYS = jax.random.split(jax.random.key(0), 8_000)
AVAILABLE = np.array([[True, True, True, True], [False, True, False, True], [False, False, False, True]])


@dataclass(frozen=True)
class Corner(Environment):
    """Three agents of which not every one may do everything."""

    num_agents: int = 3
    num_actions: int = 4
    observation_size: int = 1
    max_cycles: int = 3
    continuous_actions: bool = False

    def reset(self, key: Any, params: Any = ()) -> Any:
        return (), observe(jnp.zeros((3, 1)), available=jnp.asarray(AVAILABLE))

    def step(self, state: Any, action: Any, key: Any, params: Any = ()) -> Any:
        raise NotImplementedError


def actions(actor: Actor, env: Environment) -> np.ndarray:
    """One for each key [K, N, …]."""
    _, seen = env.reset(KEYS[0])
    return np.asarray(jax.vmap(lambda key: actor.policy((), seen, key)[0].action)(KEYS))


def test_every_available_action_is_equally_likely_and_no_other_is_taken():
    env = Corner()
    drawn = actions(references.random(env), env)
    for agent, available in enumerate(AVAILABLE):
        counts = np.bincount(drawn[:, agent], minlength=4)
        assert (counts[~available] == 0).all()
        expected = len(KEYS) / available.sum()
        chi_square = (np.square(counts[available] - expected) / expected).sum()
        assert chi_square < 21.1, "the 0.9999 quantile at 3 degrees of freedom"
    # Agents draw apart.
    agree = ((drawn[:, 0] == 1) & (drawn[:, 1] == 1)).mean()
    assert abs(agree - 0.25 * 0.5) < 5 * np.sqrt(0.125 * 0.875 / len(KEYS))


def test_doing_nothing_is_the_first_action_that_there_is():
    env = Corner()
    np.testing.assert_array_equal(actions(references.noop(env), env), np.tile([0, 1, 3], (len(KEYS), 1)))


def test_pushes_are_uniform_or_none():
    env = Corner(continuous_actions=True)
    pushes = actions(references.random(env), env)
    assert pushes.shape == (len(KEYS), 3, 4) and pushes.min() >= 0 and pushes.max() < 1
    np.testing.assert_allclose(pushes.mean(0), 0.5, atol=5 * np.sqrt(1 / 12 / len(KEYS)))
    np.testing.assert_array_equal(actions(references.noop(env), env)[:2], np.zeros((2, 3, 4)))


def test_a_task_has_the_floors_and_its_own():
    plain = Task("corner", Corner, lambda settings: settings)
    assert references.playable(plain) == references.shown(plain) == ["random", "noop"]
    own = plain._replace(references={"clever": references.noop, "stubborn": references.noop})
    assert references.playable(own) == ["random", "noop", "clever", "stubborn"]
    assert references.shown(own) == ["random", "noop", "clever"]
    for name in references.playable(own):
        assert references.actor(own, name, Corner()).initial_memory == ()
    with pytest.raises(
        ConfigError, match=r"unknown scripted policy 'cleverer': did you mean 'clever'\? \(of corner\)"
    ):
        references.actor(own, "cleverer", Corner())
    with pytest.raises(ConfigError, match="unknown scripted policy 'oracle'"):
        references.actor(plain, "oracle", Corner())
