"""A comparison as plain data: ours, marl-eval's, and a tidy table of every seed's every value."""

import csv
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gacrl.errors import UserError
from gacrl.evaluation.statistics import Difference, Estimate
from gacrl.experiments.compare import marl_eval
from gacrl.experiments.compare.compare import Comparison
from gacrl.experiments.compare.finished import Finished, Play, with_scores
from gacrl.experiments.compare.groups import Group

COLUMNS = ("run", "label", "seed", "env_steps", "stage", "metric", "value")
"""Of the tidy table."""


def to_dict(comparison: Comparison) -> dict[str, Any]:
    """Return the comparison as plain data: every seed's value, every interval."""
    names = [group.name for group in comparison.groups]
    return {
        "play": comparison.play,
        "statistic": "iqm",
        "episodes": comparison.episodes,
        "horizon": comparison.horizon,
        "groups": [_group_data(group, comparison.metrics) for group in comparison.groups],
        "references": {
            who: {metric: comparison.reference(who, metric) for metric in comparison.metrics}
            for who in comparison.references
        },
        "pairs": [
            {
                "a": pair.a,
                "b": pair.b,
                "metric": pair.metric,
                "difference": pair.point,
                "interval": _bounds(pair.difference),
                "detectable": None if pair.difference is None else pair.difference.detectable,
                "verdict": pair.verdict,
                "equivalence": None if pair.equivalence is None else pair.equivalence._asdict(),
                "probability_of_improvement": None if pair.better is None else pair.better.point,
                "probability_of_improvement_interval": _bounds(pair.better),
                "claimed": pair.claimed,
            }
            for pair in comparison.pairs
        ],
        "config_differences": {
            name: dict(zip(names, values, strict=True)) for name, values in comparison.config_differences.items()
        },
        "unequal_switches": list(comparison.unequal_switches),
        "notes": list(comparison.notes),
    }


def to_marl_eval(comparison: Comparison) -> dict[str, Any]:
    """Return the runs as marl-eval's raw data: a mean over the episodes of each evaluation."""
    config = comparison.groups[0].config
    agents = getattr(config.env, "num_agents", None)
    task = f"{comparison.horizon}_steps" if agents is None else f"{agents}_agents_{comparison.horizon}_steps"
    return marl_eval.to_marl_eval(
        [
            marl_eval.EvaluatedRun(
                environment=config.task,
                task=task,
                algorithm=group.name,
                run=f"seed_{seed}",
                env_steps=[
                    step for step, there in zip(group.evaluated_at, _there(group, k), strict=True) if there
                ],
                metrics={
                    name: [[value] for value in values[k][_there(group, k)]]
                    for name, values in group.along.items()
                },
                absolute={name: [values[k]] for name, values in group.final.items()},
            )
            for group in comparison.groups
            for k, seed in enumerate(group.seeds)
        ]
    )


def write_csv(comparison: Comparison, path: Path) -> None:
    """Write every seed's value of every metric, at each evaluation along training and the closing one, as a row.

    Its columns are COLUMNS. stage: training, closing, or diverged for a seed without a closing evaluation, whose values
    there are nan. Raises UserError for what is no number, and OSError where the file cannot be written.
    """
    with path.open("w", encoding="utf-8", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(COLUMNS)
        for group in comparison.groups:
            for run in group.members:
                try:
                    values = list(_values(run, comparison.play, comparison.metrics))
                except (KeyError, IndexError, TypeError, ValueError) as error:
                    what = f"{type(error).__name__}: {error}"
                    raise UserError(f"{run.path} holds an evaluation with what is no number ({what})") from error
                table.writerows((run.path, group.name, *value) for value in values)


def _values(run: Finished, play: Play, compared: Sequence[str]) -> Iterator[tuple[int, int, str, str, float]]:
    """Seed, environment steps, stage, metric and value of all that was measured of a run."""
    references, scale = run.summary["references"], run.facts["scale"]
    for row in run.rows:
        for metric, value in with_scores(row[play], references, scale).items():
            yield row["seed"], row["env_steps"], "training", metric, value
    final: Mapping[str, Any] = run.summary["final"][play] if run.diverged is None else {}
    end = run.config.num_updates * run.config.steps_per_update
    for member, seed in enumerate(run.config.seeds):
        for metric, entry in final.items():
            yield seed, end, "closing", metric, float(entry["values"][member])
        if run.diverged is not None:
            last = max((row["env_steps"] for row in run.rows if row["seed"] == seed), default=0)
            yield from ((seed, last, "diverged", metric, math.nan) for metric in compared)


def _there(group: Group, k: int) -> NDArray[np.bool_]:
    """At which steps the k-th of its seeds was evaluated [P]."""
    return np.isfinite(next(iter(group.along.values()))[k])


def _group_data(group: Group, metrics: Sequence[str]) -> dict[str, Any]:
    return {
        "name": group.name,
        "runs": list(group.runs),
        "seeds": list(group.seeds),
        "lost_seeds": list(group.lost),
        "diverged": list(group.diverged),
        "env_steps": list(group.evaluated_at),
        "metrics": {
            metric: {
                "point": group.point(metric),
                "interval": _bounds(group.estimate(metric)),
                "values": group.final[metric].tolist(),
                "along": [
                    [None if math.isnan(value) else value for value in seed] for seed in group.along[metric]
                ],
            }
            for metric in metrics
        },
    }


def _bounds(found: Estimate | Difference | None) -> list[float] | None:
    return None if found is None else [found.low, found.high]
