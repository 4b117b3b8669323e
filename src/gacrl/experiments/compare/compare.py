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

from gacrl.config import files as configuration
from gacrl.config.checks import unknown
from gacrl.errors import UserError
from gacrl.evaluation import statistics
from gacrl.evaluation.statistics import Difference, Equivalence, Estimate
from gacrl.experiments.compare.finished import (
    Finished,
    Play,
    Warn,
    flat,
    load,
    on_scale,
    require_references,
    require_same_meaning,
    require_same_task,
)
from gacrl.experiments.compare.groups import NOT_SETTINGS, Group, grouped
from gacrl.tasks.task import with_unit
from gacrl.versions import DIRTY

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
    lost: tuple[str, ...] = ()
    """The groups that lost seeds to divergence: what is left of them flatters them."""

    @property
    def verdict(self) -> str | None:
        """Return the verdict of a against b. Fewer than five seeds are told apart by chance too often to say so."""
        if self.difference is None:
            return None
        apart = self.difference.verdict != "cannot be told apart"
        return "too few seeds to tell" if apart and self.seeds < TOO_FEW else self.difference.verdict

    @property
    def claimed(self) -> str | None:
        """The group that may be claimed to be better: at 0.95 or more, with an interval on that side of 0.5.

        None that lost seeds is.
        """
        if self.better is None or self.seeds < TOO_FEW:
            return None
        point, low, high = self.better
        ahead = self.a if point >= 0.95 and low > 0.5 else self.b if point <= 0.05 and high < 0.5 else None
        return None if ahead in self.lost else ahead


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
        """Return what one of those gets; of a score, on its scale."""
        return on_scale(self.references[who], self.references, metric, self.facts["scale"])

    def label(self, metric: str) -> str:
        """Return what tables call it."""
        score, name = metric.startswith("score_"), metric.removeprefix("score_")
        label = self.facts["shown"].get(name, name.replace("_", " "))
        return f"score of {label}" if score else label

    def axis(self, metric: str) -> str:
        """Return the same for the axis of a figure: with its unit; of a score with what its ends mean."""
        if metric.startswith("score_"):
            low, high = self.facts["scale"]
            return f"{self.label(metric)} (0: {low}, 1: {high})"
        return with_unit(self.label(metric), self.facts.get("units", {}).get(metric, ""))  # version 0.1.0 has none

    def lower_is_better(self, metric: str) -> bool:
        """Return whether less of it is more."""
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
    labels: Sequence[str] = (),
    horizon: int | None = None,
) -> Comparison:
    """Read run folders and compare them.

    metrics: names as in `summary.json`; none: what the task has first in its tables. margin: in the units of the
    metric, of which there must then be one; groups are tested for differing by less. labels: a name for each run or
    group; none: those of the folders. horizon: runs that were evaluated over another one are played again over this
    one. Raises UserError for a run that is damaged or has not ended, for runs of different tasks, for a metric that
    there is not or that is not a number somewhere, and where all runs diverged.
    """
    if not runs:
        raise UserError("name at least one run folder: `gacrl compare RUN RUN`")
    if margin is not None:
        if len(metrics) != 1:
            raise UserError("a margin is in the units of a metric: name one with --metric")
        statistics.require_margin(margin)
    if horizon is not None and horizon < 1:
        raise UserError(f"--horizon must be at least 1 step, not {horizon}")
    notes: list[str] = []
    loaded = _over(horizon, [load(path, warn) for path in runs], warn, notes)
    ended = [run for run in loaded if run.diverged is None]
    if not ended:
        raise UserError(
            "none of these runs came to its end: " + "; ".join(f"{run.path}: {run.diverged}" for run in loaded)
        )
    first = ended[0]
    require_same_task([first, *(run for run in loaded if run is not first)])
    loaded = [run if run.diverged is None else _beside(run, first) for run in loaded]
    metrics = tuple(metrics) or tuple(first.facts["shown"])[:SHOWN]
    for metric in metrics:
        known = sorted(set.intersection(*(set(run.summary["final"][play]) for run in ended)))
        if metric not in known:
            raise UserError(unknown("metric", metric, known))
        require_references(first, metric)
        require_same_meaning(loaded, metric)
    groups = grouped(loaded, metrics, play, labels, notes)
    differences = _differences(groups)
    return Comparison(
        play=play,
        metrics=tuple(metrics),
        groups=groups,
        pairs=tuple(
            _pair(a, b, metric, margin, metric in first.facts["lower_is_better"])
            for metric in metrics
            for a, b in combinations([group for group in groups if group.seeds], 2)
        ),
        references=first.summary["references"],
        facts=first.facts,
        episodes=first.summary["episodes"],
        horizon=first.summary["horizon"],
        config_differences=differences,
        notes=(*_cautions(groups, differences), *_about_measurement(ended), *notes),
    )


def _over(horizon: int | None, runs: list[Finished], warn: Warn, notes: list[str]) -> list[Finished]:
    """The runs, those that were evaluated over another horizon played again; a note says which."""
    others = [run for run in runs if horizon is not None and run.horizon != horizon and run.diverged is None]
    if horizon is None or not others:
        return runs
    from gacrl.experiments.compare.again import played_again  # loads jax

    notes.append(
        f"played again over {horizon} steps, and without a curve, since the evaluations along training were over "
        f"another number of them: {', '.join(str(run.path) for run in others)}"
    )
    again = {run.path: played_again(run, horizon, warn) for run in others}
    return [again.get(run.path, run) for run in runs]


def _beside(run: Finished, ended: Finished) -> Finished:
    """A run that diverged, with the references of one that ended, and a curve if it was evaluated over that horizon."""
    rows = run.rows if run.horizon == ended.horizon else []
    return run._replace(summary={"references": ended.summary["references"]}, rows=rows)


def _pair(a: Group, b: Group, metric: str, margin: float | None, lower_is_better: bool) -> Pair:
    first, second = a.final[metric], b.final[metric]
    point = float(statistics.iqm(first) - statistics.iqm(second))
    lost = tuple(group.name for group in (a, b) if group.lost)
    if min(len(first), len(second)) < 2:
        return Pair(a.name, b.name, metric, point, None, None, 1, lost=lost)
    sign = -1.0 if lower_is_better else 1.0
    better = statistics.probability_of_improvement(sign * first, sign * second)
    difference = statistics.difference(first, second)
    equivalence = None if margin is None else statistics.equivalent(first, second, margin)
    return Pair(a.name, b.name, metric, point, difference, better, min(len(first), len(second)), equivalence, lost)


def _differences(groups: Sequence[Group]) -> dict[str, tuple[Any, ...]]:
    settings = [flat(configuration.to_dict(group.config)) for group in groups]
    names = dict.fromkeys(name for one in settings for name in one if name not in NOT_SETTINGS)
    values = {name: tuple(one.get(name, _ABSENT) for one in settings) for name in names}
    return {name: found for name, found in values.items() if len({show(value) for value in found}) > 1}


def _is_switch(name: str, values: Sequence[Any]) -> bool:
    if name.startswith(("curriculum.", "env.")):
        return True
    return name in _SWITCHES and len({show(_WITHOUT.get(name, v) if v == _ABSENT else v) for v in values}) > 1


def _cautions(groups: Sequence[Group], differences: Mapping[str, tuple[Any, ...]]) -> Iterator[str]:
    """Yield what weakens every sentence about these groups."""
    switches = {name: values for name, values in differences.items() if _is_switch(name, values)}
    if switches:
        told = "; ".join(f"{name}: {' | '.join(map(show, values))}" for name, values in switches.items())
        yield f"the groups differ in settings that a fair comparison has equal ({told})"
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
    versions = {
        json.dumps([run.summary.get("versions", {}).get(of) for of in ("gacrl", "git_commit")]) for run in runs
    }
    if len(versions) > 1:
        yield "the runs were made by different versions of gacrl"
    noted = {str(run.path): run.summary.get("versions", {}).get("git_commit") or "" for run in runs}
    changed = [path for path, commit in noted.items() if commit.endswith(DIRTY)]
    if changed:
        yield f"the sources had changes when {', '.join(changed)} ended: no commit has the code that made these numbers"


def show(value: Any) -> str:
    """Write a setting's value as a text."""
    return value if isinstance(value, str) else json.dumps(value)
