"""marl-eval's raw data (Gorsane et al. 2022), written from runs."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from gacrl.errors import UserError


@dataclass(frozen=True)
class EvaluatedRun:
    """One seed of one algorithm on one task, as marl-eval's JSON has it."""

    environment: str
    task: str
    algorithm: str
    run: str
    """A name for the seed."""
    env_steps: Sequence[int]
    """At which it was evaluated [P]."""
    metrics: Mapping[str, Sequence[Sequence[float]]]
    """Per metric and evaluation: a number for each episode, or their mean alone."""
    absolute: Mapping[str, Sequence[float]] = field(default_factory=dict[str, Sequence[float]])
    """Per metric: the closing evaluation, likewise."""


def to_marl_eval(runs: Sequence[EvaluatedRun]) -> dict[str, Any]:
    """Return the runs as marl-eval's raw data, ready for `json.dump`: environment, task, algorithm, run, evaluation.

    Raises UserError for a run that is there twice.
    """
    data: dict[str, Any] = {}
    for run in runs:
        algorithm = data.setdefault(run.environment, {}).setdefault(run.task, {}).setdefault(run.algorithm, {})
        if run.run in algorithm:
            raise UserError(f"{run.run} of {run.algorithm} on {run.task} is there twice: name each run once")
        steps: dict[str, Any] = {
            f"step_{number}": {
                "step_count": int(count),
                **{name: [float(value) for value in values[number]] for name, values in run.metrics.items()},
            }
            for number, count in enumerate(run.env_steps)
        }
        absolute = {name: [float(value) for value in values] for name, values in run.absolute.items()}
        algorithm[run.run] = {**steps, "absolute_metrics": absolute}
    return data
