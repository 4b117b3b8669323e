"""Numbers over seeds, and on the scale from random to the task's own reference."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy import special  # not scipy.stats: a run would start half a second later

from gacrl.tasks.task import SILENT, TOLD

CONFIDENCE = 0.95


class Estimate(NamedTuple):
    """A mean with its 95 % Student interval."""

    mean: float
    low: float
    high: float
    values: np.ndarray
    """What the interval is of: a number for each seed; of a single seed, for each of its episodes."""

    def __repr__(self) -> str:
        return f"{self.mean:.4g} [{self.low:.4g}, {self.high:.4g}]"


def estimated(values: Float[np.ndarray, "S K"]) -> Estimate:
    """Estimate the mean of a metric over S seeds, or over the K episodes of a single one."""
    numbers = np.asarray(values.mean(1) if len(values) > 1 else values[0], float)
    entry = _one(numbers)
    low, high = entry["interval"] or (float("nan"), float("nan"))
    return Estimate(entry["mean"], low, high, numbers)


def over_seeds(values: dict[str, np.ndarray]) -> dict[str, dict[str, Any]]:
    """Return per metric: the mean over the seeds, its 95 % Student interval (null for one seed), each seed's value."""
    return {name: _one(np.asarray(per_seed, float)) for name, per_seed in values.items()}


def _one(values: np.ndarray) -> dict[str, Any]:
    interval = None
    if len(values) > 1:
        error = values.std(ddof=1) / np.sqrt(len(values))
        half = special.stdtrit(len(values) - 1, 0.5 + CONFIDENCE / 2) * error
        interval = [float(values.mean() - half), float(values.mean() + half)]
    return {"mean": float(values.mean()), "interval": interval, "values": [float(v) for v in values]}


def normalised(
    metrics: dict[str, dict[str, Any]],
    references: dict[str, dict[str, float]],
    facts: Mapping[str, Any],
) -> dict[str, dict[str, Any]]:
    """Add to the metrics a `score_` of each, in which one reference is 0 and another is 1, where the two differ.

    facts: those of the task. Where they know a silent and a told policy, `score_talk` is the headline between the best
    silent one, 0, and everybody told, 1.
    """
    scores: dict[str, dict[str, Any]] = {}
    if facts["scale"] is not None:
        low, high = (references[name] for name in facts["scale"])
        scores = {
            f"score_{name}": _scaled(entry, low[name], high[name])
            for name, entry in metrics.items()
            if low[name] != high[name]
        }
    talk = facts.get("talk")
    if talk is not None and talk[SILENT] != talk[TOLD]:
        scores["score_talk"] = _scaled(metrics[facts["headline"]], talk[SILENT], talk[TOLD])
    return {**metrics, **scores}


def _scaled(entry: dict[str, Any], low: float, high: float) -> dict[str, Any]:
    def scale(value: float) -> float:
        return (value - low) / (high - low)

    interval = entry["interval"]
    return {
        "mean": scale(entry["mean"]),
        "interval": None if interval is None else sorted(scale(bound) for bound in interval),
        "values": [scale(value) for value in entry["values"]],
    }
