"""Finished runs side by side: what their seeds allow one to say, and what else differs between them.

Runs whose settings differ in the seed alone are one group. Groups are compared by their closing evaluations,
after the protocol of Gorsane et al. 2022. Every run reports its return in one convention (MPE2's reward at its
default local ratio, the mean over agents, summed over the episode), whatever it learned from, so that there is
nothing to convert; returns of other horizons have no exact conversion, and are refused.

Loads no jax: it starts at once.
"""

import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gacrl import config as configuration
from gacrl.config import RunConfig
from gacrl.errors import UserError, reason
from gacrl.evaluation import statistics
from gacrl.evaluation.statistics import Curve, Difference, Estimate
from gacrl.training.recorder import RunFolder

Play = Literal["greedy", "sampled"]
Warn = Callable[[str], None]

METRICS = ("return_agent_mean", "coverage_final_0.1")
"""What is compared unless something is asked for."""
LOWER_IS_BETTER = ("distance_agent_landmark", "distance_landmark_agent", "collisions", "near_agents")
INDICATIVE = 10
"""Fewer seeds than this indicate, and do not claim."""
TOO_FEW = 5
"""Fewer than this, and the interval of a bootstrap is much too narrow for a verdict."""

_TASK = (
    *("env.name", "env.num_agents", "env.num_landmarks", "env.arena_scale", "env.landmark_speed"),
    *("env.terminate_on_success", "env.reset_on_collision", "env.reset_distance"),
)
"""Settings that make another task, in which every number means something else."""
_MEASURED_WITH = {
    "reward_shaped": (
        *("env.local_ratio", "env.coverage_threshold"),
        *("env.collision_term", "env.collision_distance"),
    ),
    "coverage_mean_theta": ("env.coverage_threshold",),
}
"""Metrics that are defined by settings."""
_SWITCHES = (
    *("env.reward", "env.max_cycles", "env.local_ratio", "env.num_agent_neighbors", "env.num_landmark_neighbors"),
    *("algorithm.network.torso", "algorithm.network.recurrent", "algorithm.network.communication"),
    *("algorithm.augment", "algorithm.n_step", "algorithm.reward", "algorithm.gamma", "training.env_steps"),
)
_WITHOUT: Mapping[str, Any] = {
    "algorithm.network.torso": "mlp",
    "algorithm.network.recurrent": False,
    "algorithm.augment": False,
    "algorithm.n_step": 1,
}
"""What an algorithm that lacks a switch does."""
_ABSENT = "not there"


class Group(NamedTuple):
    """Runs of the same settings: an algorithm, with a seed or more."""

    name: str
    runs: tuple[str, ...]
    config: RunConfig
    seeds: tuple[int, ...]
    final: Mapping[str, NDArray[np.float64]]
    """Per metric of the closing evaluation: each seed's value [S]."""
    evaluated_at: tuple[int, ...]
    """Environment steps at which all its seeds were evaluated [P]."""
    along: Mapping[str, NDArray[np.float64]]
    """Per metric of the evaluations along the way: [S, P]."""

    def estimate(self, metric: str) -> Estimate | None:
        """The interquartile mean of the closing evaluation; None for a single seed, which has no interval."""
        return statistics.estimate(self.final[metric]) if len(self.seeds) > 1 else None

    def point(self, metric: str) -> float:
        """The same without its interval."""
        return float(statistics.iqm(self.final[metric]))

    def curve(self, metric: str) -> Curve | None:
        """The interquartile mean at each evaluation along the way; None for a single seed."""
        return statistics.sample_efficiency(self.along[metric]) if len(self.seeds) > 1 else None


class Pair(NamedTuple):
    """Two groups in one metric; without intervals where one of them has a single seed."""

    a: str
    b: str
    metric: str
    point: float
    """The interquartile mean of a less that of b."""
    difference: Difference | None
    better: Estimate | None
    """The probability that a seed of a is better than one of b: lower, where lower is better."""

    seeds: int
    """Of the group that has fewer."""

    @property
    def verdict(self) -> str | None:
        """Of a against b. Fewer than five seeds are told apart by chance too often to say so."""
        if self.difference is None:
            return None
        apart = self.difference.verdict != "cannot be told apart"
        return "too few seeds to tell" if apart and self.seeds < TOO_FEW else self.difference.verdict

    @property
    def claimed(self) -> str | None:
        """The group that may be claimed to be better: at 0.95 or more, with an interval on that side of 0.5."""
        if self.better is None or self.seeds < TOO_FEW:
            return None
        point, low, high = self.better
        return self.a if point >= 0.95 and low > 0.5 else self.b if point <= 0.05 and high < 0.5 else None


@dataclass(frozen=True)
class Comparison:
    """All that can be said about some runs."""

    play: Play
    metrics: tuple[str, ...]
    groups: tuple[Group, ...]
    pairs: tuple[Pair, ...]
    references: Mapping[str, Mapping[str, float]]
    """What random, noop and oracle get in the same task."""
    episodes: int
    horizon: int
    config_differences: Mapping[str, tuple[Any, ...]]
    """Per setting in which the groups differ: its value in each."""
    notes: tuple[str, ...]
    """What a reader must know before believing it, a sentence each."""

    def reference(self, who: str, metric: str) -> float:
        """What random, noop or oracle gets; of a score, on its scale from random to oracle."""
        return _on_scale(self.references[who], self.references, metric)

    @property
    def unequal_switches(self) -> tuple[str, ...]:
        """Settings in which the groups differ beside what tells algorithms apart."""
        return tuple(name for name in self.config_differences if _is_switch(name, self.config_differences[name]))


class _Loaded(NamedTuple):
    path: Path
    config: RunConfig
    settings: dict[str, Any]
    summary: dict[str, Any]
    rows: list[dict[str, Any]]


def compare(
    runs: Sequence[Path],
    metrics: Sequence[str] = METRICS,
    play: Play = "greedy",
    warn: Warn = lambda sentence: None,
) -> Comparison:
    """Read run folders and compare them.

    metrics: names as in `summary.json`. Raises UserError for a run that is damaged or has not ended, for runs
    of different tasks, and for a metric that there is not or that is not a number somewhere.
    """
    if not runs:
        raise UserError("name at least one run folder: `gacrl compare RUN RUN`")
    loaded = [_load(path, warn) for path in runs]
    _require_same_task(loaded)
    for metric in metrics:
        known = sorted(set.intersection(*(set(run.summary["final"][play]) for run in loaded)))
        if metric not in known:
            raise UserError(configuration.unknown("metric", metric, known))
        _require_same_meaning(loaded, metric)
    notes: list[str] = []
    groups = _groups(loaded, metrics, play, notes)
    first = loaded[0].summary
    differences = _differences(groups)
    return Comparison(
        play=play,
        metrics=tuple(metrics),
        groups=groups,
        pairs=tuple(_pair(a, b, metric) for metric in metrics for a, b in combinations(groups, 2)),
        references=first["references"],
        episodes=first["episodes"],
        horizon=first["horizon"],
        config_differences=differences,
        notes=(*_cautions(groups, differences), *_about_measurement(loaded), *notes),
    )


def to_dict(comparison: Comparison) -> dict[str, Any]:
    """The comparison as plain data: every seed's value, every interval."""
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
    """The runs as marl-eval's raw data: a mean over the episodes of each evaluation."""
    env = comparison.groups[0].config.env
    task = f"{env.num_agents}_agents_{comparison.horizon}_steps"
    return statistics.to_marl_eval(
        [
            statistics.EvaluatedRun(
                environment=env.name,
                task=task,
                algorithm=group.name,
                run=f"seed_{seed}",
                env_steps=group.evaluated_at,
                metrics={name: [[value] for value in values[k]] for name, values in group.along.items()},
                absolute={name: [values[k]] for name, values in group.final.items()},
            )
            for group in comparison.groups
            for k, seed in enumerate(group.seeds)
        ]
    )


def _group_data(group: Group, metrics: Sequence[str]) -> dict[str, Any]:
    return {
        "name": group.name,
        "runs": list(group.runs),
        "seeds": list(group.seeds),
        "env_steps": list(group.evaluated_at),
        "metrics": {
            metric: {
                "point": group.point(metric),
                "interval": _bounds(group.estimate(metric)),
                "values": group.final[metric].tolist(),
                "along": group.along[metric].tolist(),
            }
            for metric in metrics
        },
    }


def _bounds(found: Estimate | Difference | None) -> list[float] | None:
    return None if found is None else [found.low, found.high]


def _load(path: Path, warn: Warn) -> _Loaded:
    """A run that has ended. Raises UserError where it has not, or where one of its files is damaged."""
    folder = RunFolder.open(path)
    config = folder.config()
    if not folder.summary_file.exists():
        raise UserError(f"{path} has not ended, and has no summary.json: `gacrl resume {path}` ends it")
    try:
        summary = json.loads(folder.summary_file.read_text(encoding="utf-8"))
        shape = {"final": dict, "references": dict, "episodes": int, "horizon": int, "seeds": list}
        if not all(isinstance(summary[name], kind) for name, kind in shape.items()):
            raise ValueError("it lacks what a run's summary has")
        if summary["seeds"] != list(config.seeds):
            raise ValueError(f"it is of seeds {summary['seeds']}, config.json of {list(config.seeds)}")
        rows = folder.metrics()
        lines = len(folder.metrics_file.read_text(encoding="utf-8").splitlines())
    except OSError as error:
        raise UserError(f"cannot read {error.filename}: {reason(error)}") from error
    except UnicodeDecodeError as error:
        raise UserError(f"a file of {path} is damaged, it is not text: {error}") from error
    except (KeyError, TypeError, ValueError, RecursionError) as error:
        raise UserError(f"{folder.summary_file} is damaged: {error}") from error
    if lines > len(rows):
        warn(f"the last line of {folder.metrics_file}, line {lines}, is cut off: compared without it")
    return _Loaded(path, config, _flat(configuration.to_dict(config)), summary, rows)


def _require_same_task(runs: Sequence[_Loaded]) -> None:
    first = runs[0]
    for run in runs[1:]:
        horizons = first.summary["horizon"], run.summary["horizon"]
        if horizons[0] != horizons[1]:
            raise UserError(
                f"{first.path} was evaluated over {horizons[0]} steps, {run.path} over {horizons[1]}, and returns "
                "of one are not to be had from the other: train with the same --evaluation.horizon"
            )
        for name in _TASK:
            ours, theirs = _task_setting(first, name), _task_setting(run, name)
            if ours != theirs:
                raise UserError(
                    f"{first.path} and {run.path} are different tasks, {name} is {ours} in one and {theirs} in "
                    "the other: compare runs of one task"
                )
        versions = [r.summary.get("versions", {}).get("mpe2") for r in (first, run)]
        if versions[0] != versions[1]:
            raise UserError(
                f"{first.path} was measured with MPE2 {versions[0]}, {run.path} with {versions[1]}: "
                "compare runs of one version of the environment"
            )


def _task_setting(run: _Loaded, name: str) -> Any:
    env = run.config.env
    if name == "env.num_landmarks":
        return env.landmarks  # as many as agents, or said so
    if name == "env.reset_distance" and env.reset_on_collision == "off":
        return None
    return run.settings[name]


def _require_same_meaning(runs: Sequence[_Loaded], metric: str) -> None:
    for name in _MEASURED_WITH.get(metric.removeprefix("score_"), ()):
        for run in runs[1:]:
            ours, theirs = runs[0].settings[name], run.settings[name]
            if ours != theirs:
                raise UserError(
                    f"{metric} is measured with {name}, which is {ours} in {runs[0].path} and {theirs} in "
                    f"{run.path}: compare another metric"
                )


def _groups(runs: Sequence[_Loaded], metrics: Sequence[str], play: Play, notes: list[str]) -> tuple[Group, ...]:
    together: dict[str, list[_Loaded]] = {}
    for run in runs:
        same = {name: value for name, value in run.settings.items() if name not in _NOT_SETTINGS}
        together.setdefault(json.dumps(same, sort_keys=True), []).append(run)
    names = _names([members[0] for members in together.values()])
    return tuple(
        _group(name, members, metrics, play, notes) for name, members in zip(names, together.values(), strict=True)
    )


_NOT_SETTINGS = ("seed", "num_seeds", "preset")


def _names(runs: Sequence[_Loaded]) -> list[str]:
    """The preset's name where one group has it, else with what sets its groups apart, or the folder's name."""
    names: list[str] = []
    for run in runs:
        others = [other for other in runs if other.config.preset == run.config.preset]
        apart = [name for name in run.settings if len({_show(o.settings.get(name)) for o in others}) > 1]
        apart = [name for name in apart if name not in _NOT_SETTINGS]
        name = run.config.preset
        if 0 < len(apart) <= 2:
            told = ", ".join(f"{_short(setting)} {_show(run.settings[setting])}" for setting in apart)
            name = f"{name}, {told}"
        elif apart or len(others) > 1:
            name = f"{name}, {run.path.name}"
        names.append(name if name not in names else f"{name} ({run.path})")
    return names


def _group(name: str, members: Sequence[_Loaded], metrics: Sequence[str], play: Play, notes: list[str]) -> Group:
    owner: dict[int, _Loaded] = {}
    final: dict[str, list[float]] = {metric: [] for metric in metrics}
    along: list[dict[int, dict[str, float]]] = []
    for run in members:
        for member, seed in enumerate(run.config.seeds):
            if seed in owner:
                raise UserError(
                    f"seed {seed} of the same settings is in {owner[seed].path} and in {run.path}: "
                    "a seed counts once, name one of them"
                )
            owner[seed] = run
            for metric in metrics:
                final[metric].append(_final(run, play, metric, member))
            along.append(_along(run, play, metrics, seed))
    common = sorted(set.intersection(*(set(steps) for steps in along)))
    by_count: dict[int, list[int]] = {}
    for seed, steps in zip(owner, along, strict=True):
        by_count.setdefault(len(steps), []).append(seed)
    if len(by_count) > 1:
        told = "; ".join(f"{count} times: seeds {', '.join(map(str, who))}" for count, who in by_count.items())
        notes.append(
            f"{name} was not evaluated equally often ({told}); its curve is over the {len(common)} environment "
            "steps that all its seeds share"
        )
    order = np.argsort(list(owner))
    return Group(
        name=name,
        runs=tuple(str(run.path) for run in members),
        config=members[0].config,
        seeds=tuple(sorted(owner)),
        final={metric: np.array(values, float)[order] for metric, values in final.items()},
        evaluated_at=tuple(common),
        along={
            metric: np.array([[along[k][step][metric] for step in common] for k in order], float)
            for metric in metrics
        },
    )


def _final(run: _Loaded, play: Play, metric: str, member: int) -> float:
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


def _along(run: _Loaded, play: Play, metrics: Sequence[str], seed: int) -> dict[int, dict[str, float]]:
    """The metrics of one seed's evaluations under the environment steps at which they took place."""
    found: dict[int, dict[str, float]] = {}
    for number, row in enumerate(run.rows, start=1):
        where = f"line {number} of {run.path / 'metrics.jsonl'}"
        try:
            if row["seed"] != seed:
                continue
            values = {metric: _on_scale(row[play], run.summary["references"], metric) for metric in metrics}
            found[int(row["env_steps"])] = values
        except (KeyError, TypeError, ValueError) as error:
            raise UserError(f"{where} is not an evaluation with {play} {', '.join(metrics)}") from error
        for metric, value in values.items():
            if not math.isfinite(value):
                raise UserError(f"{where} has {value} as {metric}: leave this run out, or compare another metric")
    return found


def _on_scale(values: Mapping[str, Any], references: Mapping[str, Any], metric: str) -> float:
    """A metric among those of an evaluation; a score is made there, from what random and oracle got."""
    if metric in values or not metric.startswith("score_"):
        return float(values[metric])
    name = metric.removeprefix("score_")
    low, high = float(references["random"][name]), float(references["oracle"][name])
    return (float(values[name]) - low) / (high - low)


def _pair(a: Group, b: Group, metric: str) -> Pair:
    first, second = a.final[metric], b.final[metric]
    point = a.point(metric) - b.point(metric)
    if min(len(first), len(second)) < 2:
        return Pair(a.name, b.name, metric, point, None, None, 1)
    sign = -1.0 if metric in LOWER_IS_BETTER else 1.0
    better = statistics.probability_of_improvement(sign * first, sign * second)
    difference = statistics.difference(first, second)
    return Pair(a.name, b.name, metric, point, difference, better, min(len(first), len(second)))


def _differences(groups: Sequence[Group]) -> dict[str, tuple[Any, ...]]:
    settings = [_flat(configuration.to_dict(group.config)) for group in groups]
    names = dict.fromkeys(name for one in settings for name in one if name not in _NOT_SETTINGS)
    values = {name: tuple(one.get(name, _ABSENT) for one in settings) for name in names}
    return {name: found for name, found in values.items() if len({_show(value) for value in found}) > 1}


def _is_switch(name: str, values: Sequence[Any]) -> bool:
    if name.startswith("curriculum."):
        return True
    return name in _SWITCHES and len({_show(_WITHOUT.get(name, v) if v == _ABSENT else v) for v in values}) > 1


def _cautions(groups: Sequence[Group], differences: Mapping[str, tuple[Any, ...]]) -> Iterator[str]:
    """What weakens every sentence about these groups."""
    switches = {name: values for name, values in differences.items() if _is_switch(name, values)}
    if switches:
        told = "; ".join(f"{name}: {' | '.join(map(_show, values))}" for name, values in switches.items())
        yield f"the comparison is not at equal switches ({told})"
    alone = [group.name for group in groups if len(group.seeds) == 1]
    if alone:
        yield f"a single seed has no interval: {', '.join(alone)}"
    few = [f"{group.name} {len(group.seeds)}" for group in groups if 1 < len(group.seeds) < TOO_FEW]
    if few:
        yield f"intervals from fewer than {TOO_FEW} seeds are much too narrow to tell groups apart ({', '.join(few)})"
    elif any(len(group.seeds) < INDICATIVE for group in groups):
        yield f"fewer than {INDICATIVE} seeds a side: this indicates, it does not settle"


def _about_measurement(runs: Sequence[_Loaded]) -> Iterator[str]:
    episodes = sorted({run.summary["episodes"] for run in runs})
    if len(episodes) > 1:
        yield f"the closing evaluations have {' and '.join(map(str, episodes))} episodes: not the same starts"
    versions = {run.summary.get("versions", {}).get("gacrl") for run in runs}
    commits = {run.summary.get("versions", {}).get("git_commit") for run in runs}
    if len(versions) > 1 or len(commits) > 1:
        yield "the runs were made by different versions of gacrl"


def _flat(data: Mapping[str, Any], where: str = "") -> dict[str, Any]:
    """Nested settings under dotted names."""
    flat: dict[str, Any] = {}
    for name, value in data.items():
        flat.update(_flat(value, f"{where}{name}.") if isinstance(value, Mapping) else {where + name: value})
    return flat


def _short(name: str) -> str:
    return name.rpartition(".")[2].replace("_", " ")


def _show(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value)
