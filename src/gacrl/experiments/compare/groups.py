"""Runs that differ in the seed alone, as one group: its name, its seeds' values, and its curve along training."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gacrl.config.run import RunConfig
from gacrl.errors import UserError
from gacrl.evaluation import statistics
from gacrl.evaluation.statistics import Curve, Estimate
from gacrl.experiments.compare.finished import Finished, Play, closing_value, values_along

NOT_SETTINGS = ("seed", "num_seeds", "preset")
"""What may differ within a group."""
_NAMED = 2
"""Runs of a group that stand in its name."""


class Group(NamedTuple):
    """Runs of the same settings: an algorithm, with a seed or more."""

    name: str
    members: tuple[Finished, ...]
    seeds: tuple[int, ...]
    """Those with a closing evaluation [S]."""
    lost: tuple[int, ...]
    """Those of runs that diverged [D]; they have evaluations along the way alone."""
    final: Mapping[str, NDArray[np.float64]]
    """Per metric of the closing evaluation: each seed's value [S]."""
    evaluated_at: tuple[int, ...]
    """Environment steps at which all seeds were evaluated that trained so far, or further [P]."""
    along: Mapping[str, NDArray[np.float64]]
    """Per metric of the evaluations along the way, seeds first, then lost ones: [S + D, P]. NaN behind a seed's end."""

    @property
    def runs(self) -> tuple[str, ...]:
        """The run folders."""
        return tuple(str(run.path) for run in self.members)

    @property
    def config(self) -> RunConfig:
        """The settings of its runs."""
        return self.members[0].config

    @property
    def diverged(self) -> tuple[str, ...]:
        """Why runs of it diverged, a reason each."""
        return tuple(run.diverged for run in self.members if run.diverged is not None)

    def estimate(self, metric: str) -> Estimate | None:
        """Return the interquartile mean of the closing evaluation; None for less than two seeds, which have no
        interval.
        """
        return statistics.estimate(self.final[metric]) if len(self.seeds) > 1 else None

    def point(self, metric: str) -> float | None:
        """Return the same without its interval; None where no seed came to its end."""
        return float(statistics.iqm(self.final[metric])) if self.seeds else None

    def reached(self) -> NDArray[np.int64]:
        """Return how many seeds stand behind each point of its curve [P]."""
        any_metric = next(iter(self.along.values()))
        return np.isfinite(any_metric).sum(0)

    def curve(self, metric: str) -> Curve:
        """Return the interquartile mean at each evaluation along the way, over the seeds that came so far.

        The interval is NaN where that is a single one. Nothing is carried on behind a seed's end.
        """
        values = self.along[metric]
        there = np.isfinite(values)
        found = np.full((3, values.shape[1]), np.nan)
        for who in np.unique(there, axis=1).T:
            at = (there == who[:, None]).all(0)
            some = values[who][:, at]
            found[:, at] = (
                statistics.sample_efficiency(some) if len(some) > 1 else [some[0], *[np.nan * some[0]] * 2]
            )
        return Curve(*found)


def grouped(
    runs: Sequence[Finished], metrics: Sequence[str], play: Play, labels: Sequence[str], notes: list[str]
) -> tuple[Group, ...]:
    """Form the groups of these runs, in the order of their first ones; what must be noted of them is added to the
    notes.

    labels: a name for each run, or for each group; none: those of the folders. Raises UserError for another number of
    labels, one that stands for two groups, and a seed that is there twice.
    """
    together: dict[str, list[int]] = {}
    for k, run in enumerate(runs):
        same = {name: value for name, value in run.settings.items() if name not in NOT_SETTINGS}
        together.setdefault(json.dumps(same, sort_keys=True), []).append(k)
    members = list(together.values())
    names = _names([run.path for run in runs], members, labels)
    return tuple(
        _group(name, [runs[k] for k in which], metrics, play, notes)
        for name, which in zip(names, members, strict=True)
    )


def short_names(paths: Sequence[Path]) -> list[str]:
    """Return the last name of each path, with as many of those before it as tell it from the other paths."""
    whole = [path.resolve() if ".." in path.parts else path.absolute() for path in paths]

    def short(path: Path) -> str:
        others = {other for other in whole if other != path}
        for many in range(1, len(path.parts)):
            if all(other.parts[-many:] != path.parts[-many:] for other in others):
                return "/".join(path.parts[-many:])
        return str(path)

    return [short(path) for path in whole]


def _names(paths: Sequence[Path], members: Sequence[Sequence[int]], labels: Sequence[str]) -> list[str]:
    """A name for each group: its labels, or the folders of its runs."""
    per_run = short_names(paths)
    named = [_joined([per_run[k] for k in which]) for which in members]
    if labels and len(labels) == len(members):
        chosen = list(labels)
    elif len(labels) == len(paths):
        chosen = [_joined([labels[k] for k in which]) for which in members]
    elif labels:
        raise UserError(
            f"--label has {len(labels)} names for {len(paths)} runs in {len(members)} groups ({'; '.join(named)}): "
            "give one for each run, or one for each group"
        )
    else:
        chosen = named
    for k, name in enumerate(chosen):
        if name in chosen[:k]:
            first, second = named[chosen.index(name)], named[k]
            raise UserError(f"--label {name!r} stands for {first} and for {second}: give each a name of its own")
    return chosen


def _joined(names: Sequence[str]) -> str:
    names = list(dict.fromkeys(names))
    if len(names) <= _NAMED:
        return " + ".join(names)
    return f"{names[0]} + {len(names) - 1} more"


def _group(name: str, members: Sequence[Finished], metrics: Sequence[str], play: Play, notes: list[str]) -> Group:
    owner: dict[int, Finished] = {}
    final: dict[int, dict[str, float]] = {}
    along: dict[int, dict[int, dict[str, float]]] = {}
    for run in members:
        for member, seed in enumerate(run.config.seeds):
            if seed in owner:
                raise UserError(
                    f"seed {seed} of the same settings is in {owner[seed].path} and in {run.path}: "
                    "a seed counts once, name one of them"
                )
            owner[seed] = run
            if run.diverged is None:
                final[seed] = {metric: closing_value(run, play, metric, member) for metric in metrics}
            along[seed] = values_along(run, play, metrics, seed)
    seeds, lost = sorted(final), sorted(along.keys() - final.keys())
    steps = _shared_steps(list(along.values()))
    notes += [*_lost(name, members, seeds, lost), *_unequal(name, along, steps)]
    missing = dict.fromkeys(metrics, np.nan)
    return Group(
        name=name,
        members=tuple(members),
        seeds=tuple(seeds),
        lost=tuple(lost),
        final={metric: np.array([final[seed][metric] for seed in seeds], float) for metric in metrics},
        evaluated_at=tuple(steps),
        along={
            metric: np.array(
                [[along[seed].get(step, missing)[metric] for step in steps] for seed in [*seeds, *lost]], float
            ).reshape(len(seeds) + len(lost), len(steps))
            for metric in metrics
        },
    )


def _shared_steps(along: Sequence[Mapping[int, object]]) -> list[int]:
    """Where every seed was evaluated that came so far: between two of its evaluations nothing is known of one."""
    ends = [max(steps, default=0) for steps in along]
    everywhere = sorted({step for steps in along for step in steps})
    return [
        step
        for step in everywhere
        if all(step in steps for steps, end in zip(along, ends, strict=True) if end >= step)
    ]


def _lost(name: str, members: Sequence[Finished], seeds: Sequence[int], lost: Sequence[int]) -> list[str]:
    """What must be said of a group some of whose runs diverged."""
    if not lost:
        return []
    because = "; ".join(f"{run.path}: {run.diverged}" for run in members if run.diverged is not None)
    if not seeds:
        return [f"{name} diverged and has no closing evaluation ({because})"]
    return [
        f"{len(lost)} of the {len(lost) + len(seeds)} seeds of {name} are in a run that diverged ({because}): its "
        "closing values are of the others alone, and flatter it"
    ]


def _unequal(name: str, along: Mapping[int, Mapping[int, object]], steps: Sequence[int]) -> list[str]:
    """What must be said of a group whose seeds were not evaluated equally often."""
    by_count: dict[int, list[int]] = {}
    for seed, evaluations in along.items():
        by_count.setdefault(len(evaluations), []).append(seed)
    if len(by_count) < 2:
        return []
    told = "; ".join(f"{count} times: seeds {', '.join(map(str, who))}" for count, who in by_count.items())
    return [
        f"{name} was not evaluated equally often ({told}); its curve has {len(steps)} points, each over the seeds that "
        "trained so far"
    ]
