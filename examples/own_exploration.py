"""A rule of exploration of your own, in one function and one line; any learner takes it.

python examples/own_exploration.py
gacrl train --preset commnet --use examples/own_exploration.py --algorithm.exploration halving
"""

from dataclasses import replace

import jax.numpy as jnp

import gacrl
from gacrl.algorithms.exploration import Level, in_time
from gacrl.config.kinds import EXPLORATION


def halving(settings, planned_steps, progress):
    """Halve the share of random actions ten times, down to `epsilon_end`; messages are as soft as at the end."""

    def level(env_steps):
        share = settings.epsilon * 0.5 ** (10 * env_steps / planned_steps)
        return Level(jnp.maximum(share, settings.epsilon_end), settings.temperature_end)

    return in_time(level)


EXPLORATION["halving"] = halving


def main(preset="gacrl", env_steps=15_000, out=None):
    """Train a preset with this rule on the task of examples/own_task.py."""
    config = gacrl.preset(preset)
    config = replace(
        config,
        algorithm=replace(config.algorithm, exploration="halving"),
        training=replace(config.training, env_steps=env_steps),
    )
    return gacrl.train(config, env="examples/own_task.py:Beacon", out=out)


if __name__ == "__main__":
    print(main().summary["final"]["greedy"]["return_agent_mean"])
