"""marl-eval's raw data (Gorsane et al. 2022): written, and read back."""

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


def from_marl_eval(data: Mapping[str, Any]) -> list[EvaluatedRun]:
    """Return the runs of marl-eval's raw data, evaluations in the order of their step counts.

    Raises UserError where it is not of that form.
    """
    try:
        return [
            _read_run(environment, task, algorithm, run, content)
            for environment, tasks in data.items()
            for task, algorithms in tasks.items()
            for algorithm, named_runs in algorithms.items()
            for run, content in named_runs.items()
        ]
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise UserError(
            "this is not marl-eval's raw data, which nests environment, task, algorithm, run and evaluation "
            f"with a step_count: {type(error).__name__} {error}"
        ) from error


def _read_run(environment: str, task: str, algorithm: str, run: str, content: Mapping[str, Any]) -> EvaluatedRun:
    evaluations = [dict(step) for name, step in content.items() if name != "absolute_metrics"]
    evaluations.sort(key=lambda step: step["step_count"])
    names = [name for name in (evaluations[0] if evaluations else {}) if isinstance(evaluations[0][name], list)]
    return EvaluatedRun(
        environment,
        task,
        algorithm,
        run,
        [int(step["step_count"]) for step in evaluations],
        {name: [[float(value) for value in step[name]] for step in evaluations] for name in names},
        {name: [float(value) for value in values] for name, values in content.get("absolute_metrics", {}).items()},
    )
