"""How the scripted policies of a task fare, step by step: what stands beside a policy that is watched."""

from collections.abc import Mapping
from typing import Any, TypeAlias

import jax
import numpy as np
from jaxtyping import Bool, Float

from gacrl import rollout
from gacrl.envs.environment import Environment
from gacrl.evaluation import references
from gacrl.evaluation.evaluate import stream_key
from gacrl.tasks.task import RETURN, Task
from gacrl.types import Actor

EPISODES = 320
Curves: TypeAlias = dict[str, list[float]]


def yardsticks(
    task: Task, env: Environment, params: Any, measures: Mapping[str, str], episodes: int = EPISODES
) -> dict[str, Curves]:
    """Return, per scripted policy, the return so far after each step and other measures, means of so many episodes.

    measures: what else, {name: measure}. What an episode has when it ends it keeps until the time limit.
    """
    wanted = {"return": "reward_raw", **measures}
    summed = {metric.measure for metric in (*RETURN.values(), *task.metrics.values()) if metric.over == "sum"}
    curves: dict[str, Curves] = {}
    for name in (name for name in reversed(references.shown(task)) if name != "noop"):
        steps, going = _measured(references.actor(task, name, env), env, params, wanted, episodes)
        so_far = {key: _so_far(values, going, wanted[key] in summed) for key, values in steps.items()}
        curves[name] = {key: [round(float(value), 4) for value in values] for key, values in so_far.items()}
    return curves


def _so_far(values: Float[np.ndarray, "T K"], going: Bool[np.ndarray, "T K"], summed: bool) -> np.ndarray:
    """Return the mean over episodes after each step [T], of what they have by then or had when they ended."""
    if summed:
        return np.where(going, values, 0.0).cumsum(0).mean(1)
    last = np.where(going, np.arange(len(going))[:, None], going.sum(0) - 1)
    return np.take_along_axis(values, last, axis=0).mean(1)


def _measured(
    actor: Actor, env: Environment, params: Any, wanted: Mapping[str, str], episodes: int
) -> tuple[dict[str, np.ndarray], Bool[np.ndarray, "T K"]]:
    """Return each measure in each step of each episode, and which episodes had not ended before it [T, K]."""

    @jax.jit
    def play(params: Any) -> tuple[dict[str, jax.Array], jax.Array]:
        start_key, act_key = jax.random.split(stream_key("report"))
        carry = rollout.start(env, params, actor.initial_memory, start_key, episodes)
        _, played = rollout.collect(
            env, actor.policy, actor.initial_memory, params, carry, act_key, env.max_cycles
        )
        steps = played.transitions
        return {name: steps.info[measure] for name, measure in wanted.items()}, steps.terminated | steps.truncated

    steps, over = play(params)
    ended = np.asarray(over).cumsum(0) - np.asarray(over)
    return {name: np.asarray(values, float) for name, values in steps.items()}, ended == 0
