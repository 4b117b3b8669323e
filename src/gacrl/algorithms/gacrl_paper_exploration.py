"""The paper's adaptive exploration, equations (13) to (16), and the coverage that it follows."""

from typing import Literal, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

CoverageSignal = Literal["episode_so_far", "last_episode"]


class Schedule(NamedTuple):
    """A level that falls linearly over the episodes, plus a bonus for what is not yet covered."""

    start: Float[Array, ""] | float
    end: Float[Array, ""] | float
    bonus: Float[Array, ""] | float
    """Added in full at coverage 0, not at all at coverage 1."""


def linear_decay(
    start: Float[Array, ""] | float,
    end: Float[Array, ""] | float,
    episode: Int[Array, ""],
    num_episodes: Float[Array, ""] | float,
) -> Float[Array, ""]:
    """Compute equations (15) and (16): max(end, start − episode × (start − end) / num_episodes), for start ≥ end."""
    return jnp.maximum(end, start - episode * ((start - end) / num_episodes))


def adaptive_level(
    schedule: Schedule,
    episode: Int[Array, ""],
    num_episodes: Float[Array, ""] | float,
    coverage: Float[Array, ""],
) -> Float[Array, ""]:
    """Compute equations (13) and (14): base(episode) + bonus × (1 − coverage)."""
    base = linear_decay(schedule.start, schedule.end, episode, num_episodes)
    return base + schedule.bonus * (1.0 - coverage)


class Coverage(NamedTuple):
    """The coverage that exploration follows, and the count of finished episodes."""

    total: Float[Array, ""]
    steps: Int[Array, ""]
    last_episode: Float[Array, ""]
    """Mean coverage of the episode that ended last; 0 before any did."""
    episode: Int[Array, ""]

    def signal(self, kind: CoverageSignal) -> Float[Array, ""]:
        """Return c of equations (13) and (14). `episode_so_far` is 0 at an episode's first step."""
        return self.last_episode if kind == "last_episode" else self.total / jnp.maximum(self.steps, 1)


def no_coverage() -> Coverage:
    """Return what is known before the first step."""
    zero, none = jnp.zeros(()), jnp.zeros((), jnp.int32)
    return Coverage(total=zero, steps=none, last_episode=zero, episode=none)


def follow_coverage(past: Coverage, coverage: Float[Array, " E"], done: Bool[Array, " E"]) -> Coverage:
    """Take in one step of E environments that keep time together (the paper has one).

    The mean over the environments counts, and starts anew when any environment's episode ends. Every
    finished episode is counted.
    """
    total, steps = past.total + coverage.mean(), past.steps + 1
    over = done.any()
    return Coverage(
        total=jnp.where(over, 0.0, total),
        steps=jnp.where(over, 0, steps),
        last_episode=jnp.where(over, total / steps, past.last_episode),
        episode=past.episode + done.sum(dtype=jnp.int32),
    )
