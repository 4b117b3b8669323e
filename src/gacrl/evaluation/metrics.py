"""From the measurements of steps to the metrics of episodes, under the names that users rely on."""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
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


def metric_names(measures: Sequence[str]) -> tuple[str, ...]:
    """The episode metrics of a task that measures these things, in the order of their vectors."""
    return tuple(name for name, metric in EPISODE_METRICS.items() if metric.measure in measures)


class Tally(NamedTuple):
    """An episode so far. Measurements stand in vectors, ordered by name: a training step that is a fraction of a
    millisecond long has no time for a program of a few scalars each."""

    total: Float[Array, " M"]
    last: Float[Array, " M"]
    steps: Int[Array, ""]


def no_steps(measures: Sequence[str]) -> Tally:
    """The tally before an episode's first step."""
    zeros = jnp.zeros(len(measures))
    return Tally(zeros, zeros, jnp.zeros((), jnp.int32))


def count_step(tally: Tally, info: Metrics) -> Tally:
    """Take in the measurements of one more step."""
    now = jnp.stack([info[name] for name in sorted(info)])
    return Tally(tally.total + now, now, tally.steps + 1)


def count_step_if(going: Bool[Array, ""], tally: Tally, info: Metrics) -> Tally:
    """The same for an episode that is still going on; one that has ended stays as it ended."""
    counted = count_step(tally, info)
    return jax.tree.map(lambda new, old: jnp.where(going, new, old), counted, tally)


def episode_metrics(tally: Tally, measures: Sequence[str]) -> Float[Array, " K"]:
    """The metrics of a finished episode, in the order of `metric_names(measures)`.

    measures: the names of the tally's measurements, sorted.
    """
    means = tally.total / jnp.maximum(tally.steps, 1)
    candidates = jnp.concatenate([means, tally.total, tally.last])
    offset = {"mean": 0, "sum": len(measures), "last": 2 * len(measures)}
    chosen = [EPISODE_METRICS[name] for name in metric_names(measures)]
    places = [offset[metric.over_steps] + measures.index(metric.measure) for metric in chosen]
    return candidates[np.array(places)]


class EpisodeSummary(NamedTuple):
    """The episodes that ended in a stretch of training: how many, sums for mean and spread, and the last."""

    ended: Int[Array, ""]
    total: Float[Array, " K"]
    squares: Float[Array, " K"]
    last: Float[Array, " K"]


def no_episodes(measures: Sequence[str]) -> EpisodeSummary:
    """Before any episode has ended."""
    zeros = jnp.zeros(len(metric_names(measures)))
    return EpisodeSummary(jnp.zeros((), jnp.int32), zeros, zeros, zeros)


def sum_up(episodes: Float[Array, "T E K"], done: Bool[Array, "T E"]) -> EpisodeSummary:
    """The episodes that ended in a rollout; of several that ended last, the first environment's is `last`."""
    finished = jnp.where(done[..., None], episodes, 0.0)
    when = done.shape[0] - 1 - jnp.argmax(done.any(1)[::-1])
    return EpisodeSummary(
        ended=done.sum(),
        total=finished.sum((0, 1)),
        squares=jnp.square(finished).sum((0, 1)),
        last=finished[when, jnp.argmax(done[when])],
    )
