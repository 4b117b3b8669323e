"""What agents choose among: the task's own actions, or where those are continuous a set of pushes.

MPE2's continuous action is five pushes in [0, 1]. Full, half and quarter pushes in the four directions, and none,
are a set with which an agent can stop anywhere; with full pushes alone it stops on a lattice of 0.2.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from gacrl.config.checks import require
from gacrl.envs.environment import Environment

STRENGTHS = (1.0, 0.5, 0.25)


class ActionSet(NamedTuple):
    """Choices by index; or what is drawn where actions are continuous, numbers [N A]."""

    size: int
    act: Callable[[Array], Array]
    """What the task takes: [N] indices, or [N A] pushes."""
    turn: Callable[[Array, Int[Array, ""]], Array]
    """The choices that do in a turned world what these do here."""
    mask: Callable[[Bool[Array, "*b N A"]], Bool[Array, "*b N K"]]
    """Which choices are available, from the task's mask of actions."""


def choices(env: Environment) -> ActionSet:
    """Return what the agents of this task choose among.

    Raises ConfigError for continuous actions that are no pushes.
    """
    if not env.continuous_actions:
        return ActionSet(env.num_actions, lambda choice: choice, env.turn_action, lambda mask: mask)

    require(
        env.pushes,
        "the task's actions are continuous, and this algorithm chooses among actions: take the preset ippo, mappo or "
        "commnet, or offer a choice (Discrete) in a wrapper of the environment",
    )
    table = np.concatenate([np.eye(env.num_actions)[:1], *[s * np.eye(env.num_actions)[1:] for s in STRENGTHS]])
    with jax.ensure_compile_time_eval():  # also where a program that uses it is being traced
        turned = [
            np.asarray(env.turn_action(jnp.asarray(table), jnp.asarray(g))) for g in range(env.num_symmetries)
        ]
    becomes = np.stack([np.abs(rows[:, None] - table).sum(-1).argmin(-1) for rows in turned])
    return ActionSet(
        size=len(table),
        act=lambda choice: jnp.asarray(table, jnp.float32)[choice],
        turn=lambda choice, symmetry: jnp.asarray(becomes)[symmetry][choice],
        mask=lambda mask: jnp.ones((*mask.shape[:-1], len(table)), bool),
    )


def greedy(values: Float[Array, "N A"], action_mask: Bool[Array, "N A"]) -> Int[Array, " N"]:
    """Return the best available action of each agent."""
    return jnp.where(action_mask, values, -jnp.inf).argmax(-1)
