"""How exploration followed progress in the seeds of a group, where its rule looks at progress at all."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from gacrl import tasks
from gacrl.config.run import RunConfig
from gacrl.experiments.compare.finished import Play
from gacrl.experiments.compare.groups import Group

BY_THE_CLOCK = ("none", "linear", "fixed")
"""Rules of `config.kinds.EXPLORATION` that do not look at progress."""


def progress_metric(config: RunConfig) -> str:
    """Return the metric that progress is read from: at the end of an episode, where the task has one."""
    task = tasks.find(config.task)
    measure = task.progress or ""
    named = {metric.over: name for name, metric in task.metrics.items() if metric.measure == measure}
    return named.get("last", named.get("mean", measure))


def ways(group: Group, play: Play) -> list[tuple[Float[np.ndarray, " P"], Float[np.ndarray, " P"]]]:
    """Return of each seed the progress and ε at its evaluations, ([P], [P]); none where ε follows the clock."""
    config, metric = group.config, progress_metric(group.config)
    follows = getattr(config.algorithm, "exploration", "adaptive") not in BY_THE_CLOCK
    if not follows or tasks.find(config.task).progress is None:
        return []
    found = [
        np.array(
            [point for row in run.rows if row.get("seed") == seed for point in _point(row, play, metric)], float
        )
        for run in group.members
        for seed in run.config.seeds
    ]
    return [(way[:, 0], way[:, 1]) for way in found if len(way)]


def _point(row: Mapping[str, Any], play: Play, metric: str) -> list[tuple[float, float]]:
    """Progress and ε of an evaluation; nothing where it lacks one of them."""
    try:
        point = float(row[play][metric]), float(row["update"]["epsilon"])
    except (KeyError, TypeError, ValueError):
        return []
    return [point] if np.isfinite(point).all() else []
