"""`gacrl sweep FILE.toml`: settings searched within ranges, every trial an ordinary run folder.

Here the trials follow a low-discrepancy sequence, one after the other; `ray_search` has Optuna propose them and a
cluster train them. What a trial is worth is read from its own metrics, so that whatever was stopped or killed goes on
with what is missing. A trial is judged by the evaluations along the way, never by the closing one.
"""

import hashlib
import json
import math
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from scipy.stats import qmc

from gacrl import tasks
from gacrl.config import files as configuration
from gacrl.config import presets
from gacrl.config.checks import unknown
from gacrl.config.run import RunConfig
from gacrl.errors import ConfigError, UserError, reason
from gacrl.evaluation.metrics import measures_of, table_of
from gacrl.experiments.results import why_diverged
from gacrl.experiments.study import Planned, Watch, claim_folder, train_missing
from gacrl.replacing import replace_json
from gacrl.report.page import Page
from gacrl.training.recorder import RunFolder

PRUNED = "pruned.json"
"""In the folder of a trial that was given up before its end."""

_MARKER = "search.json"
_KEYS = ("preset", "metric", "direction", "trials", "seeds", "seed", "env_steps", "fixed", "search")
_KINDS = ("uniform", "log", "integer", "choice")


@dataclass(frozen=True)
class Searched:
    """A setting and where it is looked for: from low to high, or among choices."""

    setting: str
    kind: Literal["uniform", "log", "integer", "choice"]
    values: tuple[Any, ...]
    """Lowest and highest, or the choices."""

    def at(self, share: float) -> Any:
        """Return the value at a share in [0, 1) of the range."""
        low, high = self.values[0], self.values[-1]
        if self.kind == "choice":
            return self.values[int(share * len(self.values))]
        if self.kind == "integer":
            return low + int(share * (high - low + 1))
        if self.kind == "log":
            return math.exp(math.log(low) + share * (math.log(high) - math.log(low)))
        return low + share * (high - low)


@dataclass(frozen=True)
class Spec:
    """What is searched, by what, and for how long."""

    config: RunConfig
    """Of every trial, but for what is searched."""
    searched: tuple[Searched, ...]
    metric: str
    """Of the greedy evaluations along the way, the mean over the seeds."""
    maximize: bool
    trials: int

    def settings_of(self, values: Mapping[str, Any]) -> RunConfig:
        """Return the trial with these values of the searched settings. Raises ConfigError."""
        return configuration.from_dict(_nested(values), self.config)

    def values_of(self, config: RunConfig) -> dict[str, Any]:
        """Return the values that a trial's settings have."""
        return {one.setting: _look_up(configuration.to_dict(config), one.setting) for one in self.searched}

    def trial(self, out: Path, values: Mapping[str, Any]) -> Planned:
        """Return the trial with these values, in a folder that is named by them."""
        config = self.settings_of(values)
        text = json.dumps(self.values_of(config), sort_keys=True)
        name = hashlib.sha256(text.encode()).hexdigest()[:8]
        return Planned(name, config, out / "trials" / name)


@dataclass(frozen=True)
class Trial:
    """A trial as its folder shows it."""

    name: str
    values: Mapping[str, Any]
    state: Literal["finished", "pruned", "diverged", "unfinished"]
    value: float | None
    """The metric at its last evaluation."""
    env_steps: int


@dataclass(frozen=True)
class Search:
    """A finished search, the best trial first."""

    out: Path
    report: Path
    trials: tuple[Trial, ...]

    def to_dict(self) -> dict[str, Any]:
        return {
            "out": str(self.out),
            "report": str(self.report),
            "trials": [vars(trial) for trial in self.trials],
        }


def load(path: Path, task: str | None = None) -> Spec:
    """Read a search from a TOML file (docs/guides/cluster.md).

    task: which it is about, in place of the preset's. Raises UserError with one sentence."""
    try:
        data = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise UserError(f"cannot read the search {path}: {reason(error)}; or is it 'paper-grid'?") from error
    except ValueError as error:
        raise UserError(f"{path} is not TOML: {error}") from error
    try:
        return _spec(data, task)
    except ConfigError as error:
        raise UserError(f"{path}: {error}") from error


def _spec(data: Mapping[str, Any], task: str | None) -> Spec:
    for key in data:
        if key not in _KEYS:
            raise ConfigError(unknown("key", key, list(_KEYS)))
    for key in ("metric", "trials", "search"):
        if key not in data:
            raise ConfigError(f"it does not say {key}: a search needs metric, trials and [search]")
    direction, trials = data.get("direction", "maximize"), data["trials"]
    if direction not in ("maximize", "minimize"):
        raise ConfigError(f"direction must be 'maximize' or 'minimize', not {direction!r}")
    if not isinstance(trials, int) or not 1 <= trials <= 100_000:
        raise ConfigError(f"trials must be a whole number between 1 and 100000, not {trials!r}")
    config = _base(data, task)
    ranges = _flat(data["search"], "")
    if not ranges:
        raise ConfigError(
            "[search] is empty: name a setting and its range, as algorithm.learning_rate = {log = [1e-4, 1e-2]}"
        )
    searched = tuple(_searched(setting, given, config) for setting, given in ranges.items())
    metrics = _metrics(config)
    if data["metric"] not in metrics:
        raise ConfigError(unknown("metric", str(data["metric"]), metrics))
    return Spec(config, searched, data["metric"], direction == "maximize", trials)


def _metrics(config: RunConfig) -> list[str]:
    """What an evaluation of this task holds."""
    task = tasks.find(config.task)
    env = task.make(config.env)
    return list(table_of(measures_of(env, task.numbers(config.env, env)), task.metrics).names)


def _base(data: Mapping[str, Any], task: str | None) -> RunConfig:
    """The settings that all trials share."""
    fixed = data.get("fixed", {})
    if not isinstance(fixed, Mapping):
        raise ConfigError("[fixed] must be a table of settings")
    changes: dict[str, Any] = {"preset": data.get("preset", presets.DEFAULT_PRESET)}
    for key, setting in (("seeds", "num_seeds"), ("seed", "seed")):
        if key in data:
            changes[setting] = data[key]
    named = presets.preset(str(changes["preset"]))
    base = named if task is None else configuration.on_task(named, task)
    config = configuration.from_dict({**changes, **fixed}, base)  # pyright: ignore[reportUnknownArgumentType]
    if "env_steps" in data:
        return configuration.from_dict({"training": {"env_steps": data["env_steps"]}}, config)
    return config


def _searched(setting: str, given: Any, config: RunConfig) -> Searched:
    """Raises ConfigError for a range that is empty, or that the setting cannot have."""
    if not isinstance(given, Mapping) or len(given) != 1 or next(iter(given)) not in _KINDS:  # pyright: ignore[reportUnknownArgumentType]
        raise ConfigError(f"{setting} must be one of {{uniform|log|integer = [low, high]}} or {{choice = [...]}}")
    [(kind, values)] = given.items()  # pyright: ignore[reportUnknownVariableType]
    if not isinstance(values, list) or not values:
        raise ConfigError(f"{setting} has an empty range: give {kind} a list of values")
    if kind != "choice":
        numbers = [value for value in values if isinstance(value, int | float) and not isinstance(value, bool)]  # pyright: ignore[reportUnknownVariableType]
        whole = kind != "integer" or all(isinstance(value, int) for value in numbers)  # pyright: ignore[reportUnknownVariableType]
        if len(numbers) != 2 or len(values) != 2 or not whole:  # pyright: ignore[reportUnknownArgumentType]
            raise ConfigError(f"{setting} needs two numbers, lowest and highest, not {values!r}")
        if not numbers[0] < numbers[1]:
            raise ConfigError(f"{setting} has an empty range: {numbers[0]!r} is not below {numbers[1]!r}")
        if kind == "log" and numbers[0] <= 0:
            raise ConfigError(f"{setting} cannot be searched by log down to {numbers[0]!r}: begin above 0")
    for value in values:  # pyright: ignore[reportUnknownVariableType]
        configuration.from_dict(_nested({setting: value}), config)
    return Searched(setting, kind, tuple(values))  # pyright: ignore[reportUnknownArgumentType, reportArgumentType]


def _flat(table: Any, before: str) -> dict[str, Any]:
    """Settings by their whole names; a table of one of the kinds of range is a value."""
    if not isinstance(table, Mapping):
        raise ConfigError(f"{before.rstrip('.') or '[search]'} must be a table")
    found: dict[str, Any] = {}
    for key, value in table.items():  # pyright: ignore[reportUnknownVariableType]
        if isinstance(value, Mapping) and not set(value) & set(_KINDS):  # pyright: ignore[reportUnknownArgumentType]
            found |= _flat(value, f"{before}{key}.")
        else:
            found[f"{before}{key}"] = value
    return found


def _nested(values: Mapping[str, Any]) -> dict[str, Any]:
    """`{"a.b": 1}` as `{"a": {"b": 1}}`."""
    data: dict[str, Any] = {}
    for name, value in values.items():
        *tables, last = name.split(".")
        inner = data
        for table in tables:
            inner = inner.setdefault(table, {})
        inner[last] = value
    return data


def _look_up(data: Mapping[str, Any], name: str) -> Any:
    for part in name.split("."):
        data = data[part]
    return data


def claim(spec: Spec, out: Path, proposed_by: str) -> None:
    """Make the folder of a search, or go on in it; its number of trials may have grown. Raises UserError."""
    asked = {
        "config": configuration.to_dict(spec.config),
        "searched": [vars(one) for one in spec.searched],
        "metric": spec.metric,
        "maximize": spec.maximize,
        "proposed_by": proposed_by,
    }
    other = "a search of other settings, or proposed in another way (--ray): choose another --out"
    claim_folder(out, _MARKER, asked, "search", lambda held: other)


def search(spec: Spec, out: Path, watch: Watch) -> Search | None:
    """Train what is missing under `out`, here; None where the watcher stopped it. Raises UserError."""
    out = out.absolute()
    claim(spec, out, "Halton")
    proposed = proposals(spec)
    planned = [spec.trial(out, values) for values in proposed]
    watch.planned({trial.name: _listed(values) for trial, values in zip(planned, proposed, strict=True)})
    return conclude(spec, out) if train_missing(planned, watch) else None


def proposals(spec: Spec) -> list[dict[str, Any]]:
    """Return values that fill the ranges evenly, each once; the first of many are those of few."""
    shares = qmc.Halton(len(spec.searched), rng=spec.config.seed).random(16 * spec.trials)
    points = [{one.setting: one.at(float(s)) for one, s in zip(spec.searched, row, strict=True)} for row in shares]
    distinct = {json.dumps(point): point for point in points}
    return list(distinct.values())[: spec.trials]


def trials_in(spec: Spec, out: Path) -> list[Trial]:
    """Return what has been tried under `out`."""
    found = [RunFolder(path.parent) for path in sorted(out.glob("trials/*/config.json"))]
    return [_trial(spec, folder) for folder in found]


def _trial(spec: Spec, folder: RunFolder) -> Trial:
    value, env_steps = value_of(spec, folder)
    state = "unfinished"
    if folder.summary_file.is_file():
        state = "finished"
    elif (folder.path / PRUNED).is_file():
        state = "pruned"
    elif why_diverged(folder.path) is not None:
        state = "diverged"
    return Trial(folder.path.name, spec.values_of(folder.config()), state, value, env_steps)


def value_of(spec: Spec, folder: RunFolder) -> tuple[float | None, int]:
    """Return the metric at the last evaluation, and the environment steps that it came after."""
    rows = folder.metrics() if folder.metrics_file.is_file() else []
    last = [row for row in rows if row["env_steps"] == rows[-1]["env_steps"]]
    return (mean_value(spec, last), last[0]["env_steps"]) if last else (None, 0)


def mean_value(spec: Spec, rows: Sequence[Mapping[str, Any]]) -> float:
    """Return the metric of one evaluation, over its seeds."""
    return sum(row["greedy"][spec.metric] for row in rows) / len(rows)


def conclude(spec: Spec, out: Path) -> Search:
    """Rank what was tried, and write `report.html`, `report.md`, `summary.json`, and the best trial's `best.json`."""
    sign = -1.0 if spec.maximize else 1.0

    def order(trial: Trial) -> tuple[bool, float]:
        return trial.state != "finished", math.inf if trial.value is None else sign * trial.value

    ranked = tuple(sorted(trials_in(spec, out), key=order))
    page = Page("Search")
    seeds = ", ".join(str(seed) for seed in spec.config.seeds)
    page.text(
        f"{len(ranked)} trials of {spec.config.preset}, seeds {seeds}, {spec.config.training.env_steps:,} environment "
        f"steps each, by {spec.metric} of the greedy evaluation after the last of them. The best of many is partly "
        "lucky: train it again on fresh seeds before saying how good it is."
    )
    names = [one.setting for one in spec.searched]
    rows = [
        [
            trial.name,
            *(_short(trial.values[name]) for name in names),
            "" if trial.value is None else f"{trial.value:.4g}",
            trial.state if trial.state == "finished" else f"{trial.state} at {trial.env_steps:,}",
        ]
        for trial in ranked
    ]
    page.table(("trial", *names, spec.metric, ""), rows)
    if ranked and ranked[0].state == "finished":
        config = replace(spec.settings_of(ranked[0].values), preset=spec.config.preset)
        (out / "best.json").write_text(configuration.dumps(config), encoding="utf-8")
        task = tasks.flag(spec.config.task, as_given=True)
        page.code(f"gacrl train --config {out / 'best.json'} --seed {spec.config.seeds[-1] + 1}{task}")
    page.write(out, "report")
    done = Search(out, out / "report.html", ranked)
    replace_json(out / "summary.json", done.to_dict())
    return done


def _listed(values: Mapping[str, Any]) -> str:
    return ", ".join(f"{name} = {_short(value)}" for name, value in values.items())


def _short(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)
