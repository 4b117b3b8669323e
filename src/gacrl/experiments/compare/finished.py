"""A run that has ended or diverged, as its files tell it, and whether it may stand beside another.

Every run of a task reports its return in one convention, whatever it learned from, so that there is nothing to convert;
returns over different horizons cannot be compared, and are refused.
"""

import json
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

from gacrl import tasks
from gacrl.config import files as configuration
from gacrl.config.run import RunConfig
from gacrl.errors import UserError, reason
from gacrl.training.recorder import RunFolder

Play = Literal["greedy", "sampled"]
Warn = Callable[[str], None]


class Finished(NamedTuple):
    """A run folder, read."""

    path: Path
    config: RunConfig
    settings: dict[str, Any]
    """The same under dotted names."""
    summary: dict[str, Any]
    """Of a run that diverged: what evaluations along the way need of another run's."""
    facts: dict[str, Any]
    """What must be known of its task (`Task.facts`)."""
    rows: list[dict[str, Any]]
    """Of `metrics.jsonl`: an evaluation of a seed each."""
    diverged: str | None = None
    """Why it has no closing evaluation."""

    @property
    def horizon(self) -> int | None:
        """Steps of its evaluation episodes; None for one that diverged, in a task that has no such setting."""
        return self.summary["horizon"] if self.diverged is None else self.set_horizon

    @property
    def set_horizon(self) -> int | None:
        """What its settings say of them, also where it was played again over another one."""
        return self.config.evaluation.horizon or getattr(self.config.env, "max_cycles", None)


def load(path: Path, warn: Warn) -> Finished:
    """Read a run that has ended or diverged. Raises UserError for any other, and where one of its files is damaged."""
    folder = RunFolder.open(path)
    config = folder.config()
    because = folder.why_diverged()
    if because is not None:
        rows = _rows(folder, warn)
        measured = [name for row in rows[:1] if isinstance(row.get("greedy"), dict) for name in row["greedy"]]
        facts, settings = _former_facts(config, measured), flat(configuration.to_dict(config))
        return Finished(path, config, settings, {}, facts, rows, because)
    if not folder.summary_file.exists():
        raise UserError(f"{path} has not ended, and has no summary.json: `gacrl resume {path}` ends it")
    summary = _summary(folder, config)
    facts = summary.get("task") or _former_facts(config, list(summary["final"]["greedy"]))
    return Finished(path, config, flat(configuration.to_dict(config)), summary, facts, _rows(folder, warn))


_SUMMARY = {"final": dict, "references": dict, "episodes": int, "horizon": int, "seeds": list}
_FACTS = {
    "name": str,
    "shown": dict,
    "comparable": dict,
    "defined_by": dict,
    "scale": (list, type(None)),
    "lower_is_better": list,
}


def _summary(folder: RunFolder, config: RunConfig) -> dict[str, Any]:
    """What `summary.json` says of a run that has ended."""
    path = folder.path
    try:
        summary = json.loads(folder.summary_file.read_text(encoding="utf-8"))
        if not all(isinstance(summary[name], kind) for name, kind in _SUMMARY.items()):
            raise ValueError("it lacks what a run's summary has")
        if not all(isinstance(summary["final"].get(play), dict) for play in get_args(Play)):
            raise ValueError("it lacks a closing evaluation")
        facts = summary.get("task")
        if facts and not all(isinstance(facts[name], kind) for name, kind in _FACTS.items()):
            raise ValueError("it lacks facts of its task")
        if not isinstance(summary.get("versions", {}), dict):
            raise ValueError("its versions are none")
        planned = config.num_updates * config.steps_per_update
        if summary.get("env_steps", planned) != planned:
            raise UserError(
                f"{path} has trained {summary['env_steps']} of {planned} environment steps, and was measured then: "
                f"`gacrl resume {path}` ends it"
            )
        if summary["seeds"] != list(config.seeds):
            raise ValueError(f"it is of seeds {summary['seeds']}, config.json of {list(config.seeds)}")
    except OSError as error:
        raise UserError(f"cannot read {error.filename}: {reason(error)}") from error
    except UnicodeDecodeError as error:
        raise UserError(f"a file of {path} is damaged, it is not text: {error}") from error
    except (KeyError, TypeError, ValueError, RecursionError) as error:
        raise UserError(f"{folder.summary_file} is damaged: {error}") from error
    return summary


def _rows(folder: RunFolder, warn: Warn) -> list[dict[str, Any]]:
    """The evaluations along the way."""
    try:
        rows = folder.metrics()
        lines = len(folder.metrics_file.read_text(encoding="utf-8").splitlines())
    except OSError as error:
        raise UserError(f"cannot read {error.filename}: {reason(error)}") from error
    except UnicodeDecodeError as error:
        raise UserError(f"a file of {folder.path} is damaged, it is not text: {error}") from error
    if lines > len(rows):
        warn(f"the last line of {folder.metrics_file}, line {lines}, is cut off: compared without it")
    return rows


def _former_facts(config: RunConfig, measured: Sequence[str]) -> dict[str, Any]:
    """Of a run of version 0.1.0, whose summary does not have them; and as a file would have them."""
    return json.loads(json.dumps(tasks.find(config.task).facts(config.env, measured)))


def require_same_task(runs: Sequence[Finished]) -> None:
    """Raise UserError, naming two of them, for runs of different tasks, horizons or versions of MPE2."""
    first = runs[0]
    for run in runs[1:]:
        horizons = first.horizon, run.horizon
        if horizons[0] != horizons[1] and run.diverged is None:
            raise UserError(
                f"{first.path} was evaluated over {horizons[0]} steps, {run.path} over {horizons[1]}, and returns "
                f"over different horizons cannot be compared: --horizon {horizons[0]} plays the others again"
            )
        names = [run.facts.get("name") for run in (first, run)]
        if names[0] != names[1]:
            raise UserError(
                f"{first.path} and {run.path} are different tasks, {names[0]} and {names[1]}: compare runs of one task"
            )
        for name, ours in first.facts["comparable"].items():
            theirs = run.facts["comparable"].get(name)
            if ours != theirs:
                raise UserError(
                    f"{first.path} and {run.path} are different tasks, env.{name} is {ours} in one and {theirs} in "
                    "the other: compare runs of one task"
                )
        versions = [r.summary.get("versions", {}).get("mpe2") for r in (first, run)]
        if versions[0] != versions[1] and run.diverged is None:
            raise UserError(
                f"{first.path} was measured with MPE2 {versions[0]}, {run.path} with {versions[1]}: "
                "compare runs of one version of the environment"
            )


def require_same_meaning(runs: Sequence[Finished], metric: str) -> None:
    """Raise UserError for a metric that settings define, where these differ."""
    for setting in runs[0].facts["defined_by"].get(metric.removeprefix("score_"), ()):
        name = f"env.{setting}"
        for run in runs[1:]:
            ours, theirs = runs[0].settings[name], run.settings[name]
            if ours != theirs:
                raise UserError(
                    f"{metric} is measured with {name}, which is {ours} in {runs[0].path} and {theirs} in "
                    f"{run.path}: compare another metric"
                )


def closing_value(run: Finished, play: Play, metric: str, member: int) -> float:
    """Return a seed's value in the closing evaluation. Raises UserError where it is missing or no number."""
    try:
        value = float(run.summary["final"][play][metric]["values"][member])
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise UserError(
            f"{run.path / 'summary.json'} has no {play} {metric} of seed {run.config.seeds[member]}"
        ) from error
    if not math.isfinite(value):
        raise UserError(
            f"{run.path / 'summary.json'} has {value} as {metric} of seed {run.config.seeds[member]}: "
            "leave this run out, or compare another metric"
        )
    return value


def values_along(run: Finished, play: Play, metrics: Sequence[str], seed: int) -> dict[int, dict[str, float]]:
    """Return the metrics of one seed's evaluations under the environment steps at which they took place.

    Raises UserError, naming the line, for one that is not an evaluation, or holds what is no number.
    """
    found: dict[int, dict[str, float]] = {}
    for number, row in enumerate(run.rows, start=1):
        where = f"line {number} of {run.path / 'metrics.jsonl'}"
        try:
            if row["seed"] != seed:
                continue
            references, scale = run.summary["references"], run.facts["scale"]
            values = {metric: on_scale(row[play], references, metric, scale) for metric in metrics}
            found[int(row["env_steps"])] = values
        except (KeyError, TypeError, ValueError) as error:
            raise UserError(f"{where} is not an evaluation with {play} {', '.join(metrics)}") from error
        for metric, value in values.items():
            if not math.isfinite(value):
                raise UserError(f"{where} has {value} as {metric}: leave this run out, or compare another metric")
    return found


def require_references(run: Finished, metric: str) -> None:
    """Raise UserError where the summary of a run does not say what scripted policies get in a metric."""
    references = run.summary["references"]
    for who in references:
        try:
            if math.isfinite(on_scale(references[who], references, metric, run.facts["scale"])):
                continue
        except (AttributeError, KeyError, TypeError, ValueError, ZeroDivisionError, OverflowError):
            pass
        raise UserError(
            f"{run.path / 'summary.json'} does not say what {who} gets as {metric}: compare another metric"
        )


def on_scale(
    values: Mapping[str, Any], references: Mapping[str, Any], metric: str, scale: Sequence[str] | None
) -> float:
    """Return a metric among those of an evaluation; a score is made there, from the two references that are 0 and 1."""
    if metric in values or not metric.startswith("score_") or scale is None:
        return float(values[metric])
    name = metric.removeprefix("score_")
    low, high = (float(references[who][name]) for who in scale)
    return (float(values[name]) - low) / (high - low)


def with_scores(
    values: Mapping[str, Any], references: Mapping[str, Any], scale: Sequence[str] | None
) -> dict[str, float]:
    """Return the metrics of an evaluation, and the scores that its closing one would have."""
    plain = {name: float(value) for name, value in values.items()}
    if scale is None:
        return plain
    low, high = (references[who] for who in scale)
    scaled = [f"score_{name}" for name in plain if name in low and low[name] != high[name]]
    return {**plain, **{name: on_scale(plain, references, name, scale) for name in scaled}}


def flat(data: Mapping[str, Any], where: str = "") -> dict[str, Any]:
    """Return nested settings under dotted names."""
    found: dict[str, Any] = {}
    for name, value in data.items():
        found.update(flat(value, f"{where}{name}.") if isinstance(value, Mapping) else {where + name: value})
    return found
