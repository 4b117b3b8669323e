"""Policies that learn nothing, on the very starts of the closing evaluation: random, noop, and the task's own."""

from collections.abc import Callable
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gacrl import tasks
from gacrl.config.checks import unknown
from gacrl.envs.environment import Environment, EnvParams
from gacrl.errors import ConfigError
from gacrl.evaluation.episodes import Look
from gacrl.evaluation.evaluate import evaluate, stream_key
from gacrl.tasks.task import SILENT, Task
from gacrl.types import Actor, Decision, Memory, Observation, PRNGKey

FLOORS = ("random", "noop")
"""Every task has them."""


def random(env: Environment) -> Actor:
    """Act at random: every available action is equally likely."""

    def policy(memory: Memory, observation: Observation, key: PRNGKey):
        if env.continuous_actions:
            return Decision(jax.random.uniform(key, (env.num_agents, env.num_actions))), memory
        available = observation.action_mask
        drawn = jax.random.randint(key, (env.num_agents,), 0, available.sum(-1))
        return Decision((jnp.cumsum(available, -1) > drawn[:, None]).argmax(-1)), memory

    return Actor(policy, ())


def noop(env: Environment) -> Actor:
    """Do nothing: every agent takes its first available action, or pushes nowhere."""

    def policy(memory: Memory, observation: Observation, key: PRNGKey):
        if env.continuous_actions:
            return Decision(jnp.asarray(env.idle())), memory
        return Decision(observation.action_mask.argmax(-1)), memory

    return Actor(policy, ())


def playable(task: Task) -> list[str]:
    """Return the scripted policies of a task, by name."""
    return [*FLOORS, *task.references]


def shown(task: Task) -> list[str]:
    """Return those that stand beside every number: the floors, the first of the task's own, and the silent one."""
    own = [name for i, name in enumerate(task.references) if i == 0 or name == SILENT]
    return [*FLOORS, *own]


def actor(task: Task, name: str, env: Environment) -> Actor:
    """Return the scripted policy of that name in this environment. Raises ConfigError where there is none."""
    makers: dict[str, Callable[[Any], Actor]] = {"random": random, "noop": noop, **task.references}
    if name not in makers:
        raise ConfigError(unknown("scripted policy", name, list(makers), f"of {task.name}"))
    return makers[name](env)


def evaluate_scripted(task: str, settings: Any, num_episodes: int) -> dict[str, dict[str, float]]:
    """Return the metrics of those that are shown, on the very starts of the closing evaluation."""
    return {name: play_scripted(name, task, settings, num_episodes) for name in shown(tasks.find(task))}


def play_scripted(name: str, task: str, settings: Any, num_episodes: int) -> dict[str, float]:
    """Return the mean of each metric of one scripted policy there."""
    played = scripted_episodes(name, task, settings, num_episodes)
    return {metric: float(np.mean(values)) for metric, values in played.items()}


def scripted_episodes(name: str, task: str, settings: Any, num_episodes: int) -> dict[str, jax.Array]:
    """Return the metrics of each episode [K] of one scripted policy there."""
    found = tasks.find(task)
    params = found.numbers(settings, found.make(settings))
    return scripted_program(name, task, settings, num_episodes)(params, stream_key("report"))


@cache
def scripted_program(
    name: str, task: str, settings: Any, num_episodes: int
) -> Callable[..., dict[str, jax.Array]]:
    """Return a scripted policy's evaluation, traced once a process."""
    found = tasks.find(task)
    env = found.make(settings)

    def play(params: EnvParams, key: PRNGKey) -> dict[str, jax.Array]:
        policy, memory = actor(found, name, env)  # in here: its numbers have the precision of the trace
        return evaluate(env, policy, memory, params, key, num_episodes, metrics=found.metrics)

    return play if env.hosted else jax.jit(play)


def look_of(task: Task, settings: Any) -> Look | None:
    """Return what there is to see of a state of this task as it is set; None: where agents are, if that is known."""
    return None if task.scene is None else partial(task.scene, settings)
