"""From the measurements of steps to the metrics of episodes, under the names that users rely on."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from gacrl.envs.environment import Environment, EnvParams
from gacrl.rollout import measured
from gacrl.tasks.task import RETURN, Metric
from gacrl.types import Metrics


class Table(NamedTuple):
    """Which metrics an episode has: those of its task, and the mean of every measure that has none."""

    measures: tuple[str, ...]
    """What a step measures, sorted."""
    metrics: tuple[tuple[str, Metric], ...]
    """Names and definitions, in the order of their vectors."""

    @property
    def names(self) -> tuple[str, ...]:
        """Of the metrics, in the order of their vectors."""
        return tuple(name for name, _ in self.metrics)


def table_of(measures: Sequence[str], metrics: Mapping[str, Metric]) -> Table:
    """Return the metrics of a task that measures these things."""
    known = {**metrics, **{name: metric for name, metric in RETURN.items() if name not in metrics}}
    defined = {name: metric for name, metric in known.items() if metric.measure in measures}
    bare = sorted(set(measures) - {metric.measure for metric in defined.values()})
    return Table(tuple(sorted(measures)), (*defined.items(), *((name, Metric(name)) for name in bare)))


def measures_of(env: Environment, params: EnvParams) -> list[str]:
    """Return the names of what a step of this task measures."""

    def info() -> Metrics:
        key = jax.random.key(0)
        shape = (env.num_agents, env.num_actions)
        action = jnp.zeros(shape) if env.continuous_actions else jnp.zeros(shape[0], jnp.int32)
        return measured(env.step(env.reset(key, params)[0], action, key, params)[1])

    return list(jax.eval_shape(info))


class Tally(NamedTuple):
    """An episode so far. Measurements stand in vectors, ordered by name: a training step that is a fraction of a
    millisecond long has no time for a program of a few scalars each."""

    total: Float[Array, " M"]
    last: Float[Array, " M"]
    steps: Int[Array, ""]


def no_steps(table: Table) -> Tally:
    """Return the tally before an episode's first step."""
    zeros = jnp.zeros(len(table.measures))
    return Tally(zeros, zeros, jnp.zeros((), jnp.int32))


def count_step(tally: Tally, info: Metrics) -> Tally:
    """Take in the measurements of one more step."""
    now = jnp.stack([info[name] for name in sorted(info)])
    return Tally(tally.total + now, now, tally.steps + 1)


def count_step_if(going: Bool[Array, ""], tally: Tally, info: Metrics) -> Tally:
    """Return the same for an episode that is still going on; one that has ended stays as it ended."""
    counted = count_step(tally, info)
    return jax.tree.map(lambda new, old: jnp.where(going, new, old), counted, tally)


def episode_metrics(tally: Tally, table: Table) -> Float[Array, " K"]:
    """Return the metrics of a finished episode, in the order of the table."""
    means = tally.total / jnp.maximum(tally.steps, 1)
    candidates = jnp.concatenate([means, tally.total, tally.last])
    offset = {"mean": 0, "sum": len(table.measures), "last": 2 * len(table.measures)}
    places = [offset[metric.over] + table.measures.index(metric.measure) for _, metric in table.metrics]
    return candidates[np.array(places)]


class EpisodeSummary(NamedTuple):
    """The episodes that ended in a stretch of training: how many, sums for mean and spread, and the last."""

    ended: Int[Array, ""]
    total: Float[Array, " K"]
    squares: Float[Array, " K"]
    last: Float[Array, " K"]


def no_episodes(table: Table) -> EpisodeSummary:
    """Return the tallies before any episode has ended."""
    zeros = jnp.zeros(len(table.metrics))
    return EpisodeSummary(jnp.zeros((), jnp.int32), zeros, zeros, zeros)


def sum_up(episodes: Float[Array, "T E K"], done: Bool[Array, "T E"]) -> EpisodeSummary:
    """Return the episodes that ended in a rollout; of several that ended last, the first environment's is `last`."""
    finished = jnp.where(done[..., None], episodes, 0.0)
    when = done.shape[0] - 1 - jnp.argmax(done.any(1)[::-1])
    return EpisodeSummary(
        ended=done.sum(dtype=jnp.int32),
        total=finished.sum((0, 1)),
        squares=jnp.square(finished).sum((0, 1)),
        last=finished[when, jnp.argmax(done[when])],
    )
