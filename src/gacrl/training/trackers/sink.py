"""What a tracker offers to the thread that feeds it."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from gacrl.training.trackers.rows import flat

Row = Mapping[str, Any]
"""What `metrics.jsonl` gets of a seed."""


class Sink(NamedTuple):
    """Functions that write down; each may raise anything, and take its time."""

    rows: Callable[[Sequence[Row]], None]
    """An evaluation: a row for each seed."""
    summary: Callable[[Mapping[str, Any], int], None]
    """The content of `summary.json`, and the step it belongs to."""
    picture: Callable[[Path, int], None]
    """A GIF of episodes at the end, and its step."""
    close: Callable[[], None]


def scalars(rows: Sequence[Row]) -> dict[str, float]:
    """Return the numbers of an evaluation by names with slashes: `greedy/return_agent_mean`.

    Of several seeds the mean stands there, and each seed's own under `seed-K/`.
    """
    each = [(row["seed"], _numbers(flat(row, joint="/"))) for row in rows]
    if len(each) == 1:
        return each[0][1]
    named = {f"seed-{seed}/{name}": value for seed, values in each for name, value in values.items()}
    shared = [name for name in each[0][1] if all(name in values for _, values in each)]
    return {name: sum(values[name] for _, values in each) / len(each) for name in shared} | named


def closing(summary: Mapping[str, Any]) -> dict[str, float]:
    """Return the means of the closing evaluation, `final/greedy/return_agent_mean`."""
    return {
        f"final/{kind}/{name}": float(value["mean"])
        for kind, values in summary["final"].items()
        for name, value in values.items()
        if value["mean"] is not None
    }


def _numbers(values: Mapping[str, Any]) -> dict[str, float]:
    kept = {name: value for name, value in values.items() if name not in ("seed", "env_steps")}
    return {name: float(value) for name, value in kept.items() if isinstance(value, (int, float))}
