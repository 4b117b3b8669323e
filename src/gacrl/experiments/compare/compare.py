"""Finished runs side by side: what their seeds allow one to say, and what else differs between them.

Runs whose settings differ in the seed alone are one group. Groups are compared by their closing evaluations,
after the protocol of Gorsane et al. 2022.

Loads no jax: it starts at once.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gacrl.config import files as configuration
from gacrl.config.checks import unknown
from gacrl.config.run import RunConfig
from gacrl.errors import UserError
from gacrl.evaluation import statistics
from gacrl.evaluation.statistics import Curve, Difference, Equivalence, Estimate
from gacrl.experiments.compare.finished import (
    Finished,
    Play,
    Warn,
    closing_value,
    flat,
    load,
    on_scale,
    require_same_meaning,
    require_same_task,
    values_along,
)

SHOWN = 2
"""Metrics that are compared unless some are asked for: the first of those that the task has in its tables."""
INDICATIVE = 10
"""Fewer seeds than this indicate, and do not claim."""
TOO_FEW = 5
"""Fewer than this, and the interval of a bootstrap is much too narrow for a verdict."""

_SWITCHES = (
    *("algorithm.network.torso", "algorithm.network.recurrent", "algorithm.network.communication"),
    *(
        "algorithm.augment",
        "algorithm.symmetric_play",
        "algorithm.n_step",
        "algorithm.double_q",
        "algorithm.averaged",
    ),
    *("algorithm.reward", "algorithm.gamma", "training.env_steps"),
)
_WITHOUT: Mapping[str, Any] = {
    "algorithm.network.torso": "mlp",
    "algorithm.network.recurrent": False,
    "algorithm.augment": False,
    "algorithm.symmetric_play": False,
    "algorithm.double_q": False,
    "algorithm.averaged": False,
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
    equivalence: Equivalence | None = None
    """Whether they differ by less than the margin that was asked for."""

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
    """What policies that learn nothing get in the same task."""
    facts: Mapping[str, Any]
    """What must be known of the task (`Task.facts`)."""
    episodes: int
    horizon: int
    config_differences: Mapping[str, tuple[Any, ...]]
    """Per setting in which the groups differ: its value in each."""
    notes: tuple[str, ...]
    """What a reader must know before believing it, a sentence each."""

    def reference(self, who: str, metric: str) -> float:
        """What one of those gets; of a score, on its scale."""
        return on_scale(self.references[who], self.references, metric, self.facts["scale"])

    def lower_is_better(self, metric: str) -> bool:
        """Whether less of it is more."""
        return metric in self.facts["lower_is_better"]

    @property
    def unequal_switches(self) -> tuple[str, ...]:
        """Settings in which the groups differ beside what tells algorithms apart."""
        return tuple(name for name in self.config_differences if _is_switch(name, self.config_differences[name]))


def compare(
    runs: Sequence[Path],
    metrics: Sequence[str] = (),
    play: Play = "greedy",
    warn: Warn = lambda sentence: None,
    margin: float | None = None,
) -> Comparison:
    """Read run folders and compare them.

    metrics: names as in `summary.json`; none: what the task has first in its tables. margin: in the units of the
    metric, of which there must then be one; groups are tested for differing by less. Raises UserError for a run that is
    damaged or has not ended, for runs of different tasks, and for a metric that there is not or that is not a number
    somewhere.
    """
    if not runs:
        raise UserError("name at least one run folder: `gacrl compare RUN RUN`")
    if margin is not None:
        if len(metrics) != 1:
            raise UserError("a margin is in the units of a metric: name one with --metric")
        statistics.require_margin(margin)
    loaded = [load(path, warn) for path in runs]
    require_same_task(loaded)
    facts = loaded[0].facts
    metrics = tuple(metrics) or tuple(facts["shown"])[:SHOWN]
    for metric in metrics:
        known = sorted(set.intersection(*(set(run.summary["final"][play]) for run in loaded)))
        if metric not in known:
            raise UserError(unknown("metric", metric, known))
        require_same_meaning(loaded, metric)
    notes: list[str] = []
    groups = _groups(loaded, metrics, play, notes)
    first = loaded[0].summary
    differences = _differences(groups)
    return Comparison(
        play=play,
        metrics=tuple(metrics),
        groups=groups,
        pairs=tuple(
            _pair(a, b, metric, margin, metric in facts["lower_is_better"])
            for metric in metrics
            for a, b in combinations(groups, 2)
        ),
        references=first["references"],
        facts=facts,
        episodes=first["episodes"],
        horizon=first["horizon"],
        config_differences=differences,
        notes=(*_cautions(groups, differences), *_about_measurement(loaded), *notes),
    )


def _groups(runs: Sequence[Finished], metrics: Sequence[str], play: Play, notes: list[str]) -> tuple[Group, ...]:
    together: dict[str, list[Finished]] = {}
    for run in runs:
        same = {name: value for name, value in run.settings.items() if name not in _NOT_SETTINGS}
        together.setdefault(json.dumps(same, sort_keys=True), []).append(run)
    names = _names([members[0] for members in together.values()])
    return tuple(
        _group(name, members, metrics, play, notes) for name, members in zip(names, together.values(), strict=True)
    )


_NOT_SETTINGS = ("seed", "num_seeds", "preset")


def _names(runs: Sequence[Finished]) -> list[str]:
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


def _group(name: str, members: Sequence[Finished], metrics: Sequence[str], play: Play, notes: list[str]) -> Group:
    owner: dict[int, Finished] = {}
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
                final[metric].append(closing_value(run, play, metric, member))
            along.append(values_along(run, play, metrics, seed))
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


def _pair(a: Group, b: Group, metric: str, margin: float | None, lower_is_better: bool) -> Pair:
    first, second = a.final[metric], b.final[metric]
    point = a.point(metric) - b.point(metric)
    if min(len(first), len(second)) < 2:
        return Pair(a.name, b.name, metric, point, None, None, 1)
    sign = -1.0 if lower_is_better else 1.0
    better = statistics.probability_of_improvement(sign * first, sign * second)
    difference = statistics.difference(first, second)
    equivalence = None if margin is None else statistics.equivalent(first, second, margin)
    return Pair(a.name, b.name, metric, point, difference, better, min(len(first), len(second)), equivalence)


def _differences(groups: Sequence[Group]) -> dict[str, tuple[Any, ...]]:
    settings = [flat(configuration.to_dict(group.config)) for group in groups]
    names = dict.fromkeys(name for one in settings for name in one if name not in _NOT_SETTINGS)
    values = {name: tuple(one.get(name, _ABSENT) for one in settings) for name in names}
    return {name: found for name, found in values.items() if len({_show(value) for value in found}) > 1}


def _is_switch(name: str, values: Sequence[Any]) -> bool:
    if name.startswith(("curriculum.", "env.")):
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


def _about_measurement(runs: Sequence[Finished]) -> Iterator[str]:
    episodes = sorted({run.summary["episodes"] for run in runs})
    if len(episodes) > 1:
        yield f"the closing evaluations have {' and '.join(map(str, episodes))} episodes: not the same starts"
    versions = {run.summary.get("versions", {}).get("gacrl") for run in runs}
    commits = {run.summary.get("versions", {}).get("git_commit") for run in runs}
    if len(versions) > 1 or len(commits) > 1:
        yield "the runs were made by different versions of gacrl"


def _short(name: str) -> str:
    return name.rpartition(".")[2].replace("_", " ")


def _show(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value)
