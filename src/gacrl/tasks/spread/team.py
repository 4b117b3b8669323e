"""How agents join `spread` and leave it while a policy is watched: a place for each, and masks for who is there."""

from dataclasses import replace
from typing import TypeAlias

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from gacrl.tasks.spread.environment import SpreadParams, SpreadState
from gacrl.tasks.spread.settings import SpreadSettings
from gacrl.tasks.task import Team

MOST_AGENTS = 100
Count: TypeAlias = int | Int[Array, ""]


def least(settings: SpreadSettings) -> int:
    """Return how many agents there must be: those that see nothing, and one more; all where landmarks are counted."""
    return getattr(settings, "num_blind", 0) + 1 if settings.num_landmarks is None else settings.num_agents


def room(settings: SpreadSettings, places: int) -> SpreadSettings:
    """Return the same task with places for so many agents, all of them there from the start."""
    return replace(settings, num_agents=places, num_agents_start=None)


def params(settings: SpreadSettings, numbers: SpreadParams, places: int, count: int) -> SpreadParams:
    """Return the numbers with `count` agents there; the arena grows with them: it is as crowded as in training."""
    landmarks = count if settings.num_landmarks is None else settings.num_landmarks
    size = places if settings.num_landmarks is None else landmarks
    return numbers._replace(
        agent_mask=jnp.asarray(np.arange(places) < count),
        landmark_mask=jnp.asarray(np.arange(size) < landmarks),
        arena_scale=jnp.asarray(settings.arena_scale * (count / settings.num_agents) ** 0.5),
    )


def join(
    settings: SpreadSettings, state: SpreadState, fresh: SpreadState, before: Count, now: Count
) -> SpreadState:
    """Put newcomers, and the landmarks that come with them, where a fresh start has them."""

    def joined(old: Array, new: Array, first: Count) -> Array:
        index = np.arange(old.shape[0])
        return jnp.where(jnp.asarray((index >= first) & (index < now))[:, None], new, old)

    marks = before if settings.num_landmarks is None else now  # of a fixed number none come
    return SpreadState(
        positions=joined(state.positions, fresh.positions, before),
        velocities=joined(state.velocities, fresh.velocities, before),
        landmarks=joined(state.landmarks, fresh.landmarks, marks),
        landmark_velocities=joined(state.landmark_velocities, fresh.landmark_velocities, marks),
        clock=state.clock,
    )


TEAM = Team(least, MOST_AGENTS, room, params, join)
