"""How the scripted policies of a task fare, step by step: what stands beside a policy that is watched."""

from collections.abc import Mapping
from typing import Any, TypeAlias

import jax
import numpy as np

from gacrl import rollout
from gacrl.envs.environment import Environment
from gacrl.evaluation import references
from gacrl.evaluation.evaluate import stream_key
from gacrl.tasks.task import RETURN, Task
from gacrl.types import Actor

EPISODES = 320
Curves: TypeAlias = dict[str, list[float]]


def yardsticks(task: Task, env: Environment, params: Any, measures: Mapping[str, str]) -> dict[str, Curves]:
    """Return, per scripted policy, the return so far after each step and other measures, means of 320 episodes.

    measures: what else, {name: measure}. For tasks whose episodes all last until the time limit.
    """
    wanted = {"return": "reward_raw", **measures}
    summed = {metric.measure for metric in (*RETURN.values(), *task.metrics.values()) if metric.over == "sum"}
    curves: dict[str, Curves] = {}
    for name in (name for name in reversed(references.shown(task)) if name != "noop"):
        steps = _measured(references.actor(task, name, env), env, params, wanted)
        so_far = {key: values.cumsum() if wanted[key] in summed else values for key, values in steps.items()}
        curves[name] = {key: [round(float(value), 4) for value in values] for key, values in so_far.items()}
    return curves


def _measured(actor: Actor, env: Environment, params: Any, wanted: Mapping[str, str]) -> dict[str, np.ndarray]:
    """Return the mean of each measure in each step, [T]."""

    @jax.jit
    def play(params: Any) -> dict[str, jax.Array]:
        start_key, act_key = jax.random.split(stream_key("report"))
        carry = rollout.start(env, params, actor.initial_memory, start_key, EPISODES)
        _, played = rollout.collect(
            env, actor.policy, actor.initial_memory, params, carry, act_key, env.max_cycles
        )
        return {name: played.transitions.info[measure].mean(1) for name, measure in wanted.items()}

    return {name: np.asarray(values, float) for name, values in play(params).items()}
