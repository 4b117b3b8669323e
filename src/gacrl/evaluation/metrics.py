"""From the measurements of steps to the metrics of episodes, under the names that users rely on."""

from collections.abc import Iterable
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from gacrl.types import Metrics

Reduction = Literal["mean", "sum", "last"]


class EpisodeMetric(NamedTuple):
    """How one number of an episode comes from a measurement of its steps."""

    measure: str
    over_steps: Reduction


_RADII = ("0.1", "0.2", "0.5")
EPISODE_METRICS: dict[str, EpisodeMetric] = {
    # MPE2's own reward at local ratio 0.5, the mean over agents: summed, and per step.
    "return_agent_mean": EpisodeMetric("reward_raw", "sum"),
    "reward_raw": EpisodeMetric("reward_raw", "mean"),
    # The paper's equation (1), the team's reward per step.
    "reward_shaped": EpisodeMetric("reward_shaped", "mean"),
    # Fraction of landmarks with an agent within the radius.
    **{f"coverage_mean_{r}": EpisodeMetric(f"coverage_{r}", "mean") for r in _RADII},
    **{f"coverage_final_{r}": EpisodeMetric(f"coverage_{r}", "last") for r in _RADII},
    "coverage_mean_theta": EpisodeMetric("coverage_theta", "mean"),
    "success_final_0.1": EpisodeMetric("success_0.1", "last"),
    # Arena units.
    "distance_agent_landmark": EpisodeMetric("distance_agent_landmark", "mean"),
    "distance_landmark_agent": EpisodeMetric("distance_landmark_agent", "mean"),
    "distance_agent_agent": EpisodeMetric("distance_agent_agent", "mean"),
    # Touching pairs, summed over the steps; and the paper's column: agents with a neighbour within 0.2.
    "collisions": EpisodeMetric("collisions", "sum"),
    "near_agents": EpisodeMetric("near_agents", "mean"),
}


class Tally(NamedTuple):
    """An episode so far: sums of its measurements, the latest ones, and the steps taken."""

    total: Metrics
    last: Metrics
    steps: Int[Array, ""]


def no_steps(measures: Iterable[str]) -> Tally:
    """The tally before an episode's first step."""
    zeros = {name: jnp.zeros(()) for name in measures}
    return Tally(zeros, zeros, jnp.zeros((), jnp.int32))


def count_step(tally: Tally, info: Metrics) -> Tally:
    """Take in the measurements of one more step."""
    return Tally(jax.tree.map(jnp.add, tally.total, info), info, tally.steps + 1)


def episode_metrics(tally: Tally) -> dict[str, Float[Array, ""]]:
    """The metrics of a finished episode, of those that its task measures."""
    steps = jnp.maximum(tally.steps, 1)

    def reduce(metric: EpisodeMetric) -> Float[Array, ""]:
        total = tally.total[metric.measure]
        return {"mean": total / steps, "sum": total, "last": tally.last[metric.measure]}[metric.over_steps]

    return {name: reduce(metric) for name, metric in EPISODE_METRICS.items() if metric.measure in tally.total}


class EpisodeSummary(NamedTuple):
    """The episodes that ended in a stretch of training: how many, sums for mean and spread, and the last."""

    ended: Int[Array, ""]
    total: Metrics
    squares: Metrics
    last: Metrics


def no_episodes(measures: Iterable[str]) -> EpisodeSummary:
    """Before any episode has ended."""
    zeros = episode_metrics(no_steps(measures))
    return EpisodeSummary(jnp.zeros((), jnp.int32), zeros, zeros, zeros)


def count_episodes(
    summary: EpisodeSummary, episodes: dict[str, Float[Array, " E"]], done: Bool[Array, " E"]
) -> EpisodeSummary:
    """Take in the episodes of those environments that are done."""

    def add(total: Metrics, power: int) -> Metrics:
        return {name: total[name] + jnp.where(done, values**power, 0.0).sum() for name, values in episodes.items()}

    any_done, newest = done.any(), jnp.argmax(done)
    last = {name: jnp.where(any_done, values[newest], summary.last[name]) for name, values in episodes.items()}
    return EpisodeSummary(summary.ended + done.sum(), add(summary.total, 1), add(summary.squares, 2), last)
