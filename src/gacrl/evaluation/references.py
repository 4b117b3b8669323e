"""Policies that learn nothing, on the very starts of the closing evaluation."""

from collections.abc import Callable
from functools import cache

import jax
import numpy as np

from gacrl.evaluation.evaluate import evaluate, stream_key
from gacrl.tasks.spread import scripted
from gacrl.tasks.spread.environment import Spread


def evaluate_scripted(env: Spread, num_episodes: int) -> dict[str, dict[str, float]]:
    """The metrics of random, noop and oracle on the very starts of the closing evaluation."""
    return {name: play_scripted(name, env, num_episodes) for name in scripted.SCRIPTED}


def play_scripted(name: str, env: Spread, num_episodes: int) -> dict[str, float]:
    """The metrics of one scripted policy there."""
    metrics = scripted_program(name, env, num_episodes)(env.default_params(), stream_key("report"))
    return {metric: float(np.mean(values)) for metric, values in metrics.items()}


@cache
def scripted_program(name: str, env: Spread, num_episodes: int) -> Callable[..., dict[str, jax.Array]]:
    """A scripted policy's evaluation, traced once a process."""
    actor = scripted.make(name, env)
    return jax.jit(
        lambda params, key: evaluate(env, actor.policy, actor.initial_memory, params, key, num_episodes)
    )
