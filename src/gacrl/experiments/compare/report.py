"""A comparison in tables, and on the terminal."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from gacrl.evaluation import statistics
from gacrl.evaluation.statistics import Equivalence, with_interval
from gacrl.experiments.compare.compare import TOO_FEW, Comparison, Pair, show
from gacrl.experiments.compare.finished import closing_value
from gacrl.experiments.compare.groups import Group
from gacrl.report.screen import console
from gacrl.report.tables import print_table

_SHOWN_DIFFERENCES = 12
"""Settings listed in the terminal; the page and the JSON have all."""
_PAIR = (
    "first vs second",
    "first less second",
    "verdict",
    "would show from",
    "chance first is better",
    "shown better",
)
_PAIR_EXPLAINED = (
    (
        "first less second",
        "the difference of their interquartile means; if its interval includes 0 they cannot be told apart",
    ),
    (
        "would show from",
        "the smallest difference of means that so many seeds, spread so widely, show in 80 % of all repetitions",
    ),
    ("chance first is better", "that a seed of the first does better than a seed of the second"),
    (
        "shown better",
        f"the group whose chance is 0.95 or more, with all of its interval above 0.5, from {TOO_FEW} seeds on",
    ),
)
"""What stands under each column of a table of differences."""


class _Listing(NamedTuple):
    caption: str
    columns: tuple[str, ...]
    rows: list[tuple[str, ...]]


def print_comparison(comparison: Comparison) -> None:
    """Print the tables and what must be known beside them, on standard output; on a narrow screen blocks in their
    place.
    """
    screen = console()
    for listing in listings(comparison, _SHOWN_DIFFERENCES):
        screen.print(listing.caption, overflow="fold")
        print_table(screen, listing.columns, listing.rows)
    if comparison.pairs:
        for name, meaning in explained(comparison):
            screen.print(f"{name}: {meaning}", overflow="fold")
    for note in comparison.notes:
        screen.print(f"note: {note}", overflow="fold")


def titled(comparison: Comparison, metric: str) -> str:
    """Return what tables call a metric, and its name where that is another."""
    label = comparison.label(metric)
    return label if label == metric else f"{label}: {metric}"


def about(comparison: Comparison) -> str:
    return (
        f"Closing evaluations, {comparison.play}: {comparison.episodes} episodes of {comparison.horizon} steps. A "
        "number is the interquartile mean over seeds (the mean of the middle half of them), in brackets its 95 % "
        "interval (stratified bootstrap)."
    )


def listings(comparison: Comparison, most: int | None) -> list[_Listing]:
    """Return the tables; at most so many differing settings, None: all."""
    listings = [_results(comparison)]
    for metric in comparison.metrics if comparison.pairs else ():
        better = "lower" if comparison.lower_is_better(metric) else "higher"
        pairs = [pair for pair in comparison.pairs if pair.metric == metric]
        margins = _margins(pairs)
        rows = [_pair_row(pair, comparison.lower_is_better(metric), margins) for pair in pairs]
        columns = (*_PAIR, *(f"equivalent within {margin:g}" for margin in margins))
        listings.append(
            _Listing(f"differences in {titled(comparison, metric)} ({better} is better)", columns, rows)
        )
    if comparison.config_differences:
        differing = list(comparison.config_differences.items())
        # What makes the comparison unequal stands first.
        differing.sort(key=lambda item: item[0] not in comparison.unequal_switches)
        rows = [
            (name + (" *" if name in comparison.unequal_switches else ""), *map(show, values))
            for name, values in differing[:most]
        ]
        left = len(differing) - len(rows)
        caption = "settings that differ (* a fair comparison has it equal)"
        caption += f", the first {len(rows)} of {len(differing)}: --json and --out have all" if left else ""
        listings.append(_Listing(caption, ("setting", *(group.name for group in comparison.groups)), rows))
    return listings


def _results(comparison: Comparison) -> _Listing:
    rows = [
        (group.name, _seeds(group), *(_estimate(group, metric) for metric in comparison.metrics))
        for group in comparison.groups
    ]
    rows += [
        (who, "", *(f"{comparison.reference(who, metric):.3f}" for metric in comparison.metrics))
        for who in comparison.references
    ]
    labels = (comparison.label(metric) for metric in comparison.metrics)
    return _Listing(about(comparison), ("group", "seeds", *labels), rows)


def everything(comparison: Comparison) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Return the columns and rows of a table with every metric that the task has in its tables."""
    ended = [group for group in comparison.groups if group.seeds]
    metrics = [name for name in comparison.facts["shown"] if all(_has(group, comparison, name) for group in ended)]
    rows = [(group.name, *(_shown(_closing(group, comparison, name)) for name in metrics)) for group in ended]
    rows += [
        (who, *(f"{values[name]:.3f}" if name in values else "" for name in metrics))
        for who, values in comparison.references.items()
    ]
    return ("group", *map(comparison.label, metrics)), rows


def _has(group: Group, comparison: Comparison, metric: str) -> bool:
    return all(metric in run.summary["final"][comparison.play] for run in group.members if run.diverged is None)


def _closing(group: Group, comparison: Comparison, metric: str) -> Float[np.ndarray, " S"]:
    """The closing values of its seeds."""
    ended = [run for run in group.members if run.diverged is None]
    return np.array(
        [closing_value(run, comparison.play, metric, k) for run in ended for k in range(run.config.num_seeds)]
    )


def _seeds(group: Group) -> str:
    """How many there are, and how many of them have no closing evaluation."""
    many = len(group.seeds) + len(group.lost)
    return f"{many} ({len(group.lost)} in a run that diverged)" if group.lost else str(many)


def _estimate(group: Group, metric: str) -> str:
    return _shown(group.final[metric]) if group.seeds else "diverged"


def _shown(values: Float[np.ndarray, " S"]) -> str:
    """The interquartile mean over seeds with its interval."""
    if len(values) == 1:
        return f"{values[0]:.3f} (one seed: no interval)"
    return with_interval(statistics.estimate(values))


def _margins(pairs: Sequence[Pair]) -> list[float]:
    """The margin that pairs were tested for, if they were."""
    return list(dict.fromkeys(pair.equivalence.margin for pair in pairs if pair.equivalence is not None))


def _pair_row(pair: Pair, lower_is_better: bool, margins: Sequence[float]) -> tuple[str, ...]:
    start = f"{pair.a} vs {pair.b}"
    if pair.difference is None or pair.better is None:
        return (start, f"{pair.point:.3f}", "one seed: none", "", "", "", *[""] * len(margins))
    return (
        start,
        with_interval(pair.difference),
        _verdict(pair, lower_is_better),
        f"{pair.difference.detectable:.3f}",
        with_interval(pair.better, ".2f"),
        pair.claimed or "no",
        *([_equivalence(pair.equivalence)] if pair.equivalence else [""] * len(margins)),
    )


def _verdict(pair: Pair, lower_is_better: bool) -> str:
    """Which of the two is better, where the interval of the difference says so."""
    if pair.verdict not in ("higher", "lower"):
        return str(pair.verdict)
    first = (pair.verdict == "higher") != lower_is_better
    return f"{pair.a if first else pair.b} is better"


def explained(comparison: Comparison) -> list[tuple[str, str]]:
    """Return what the columns of the differences mean, those that are there."""
    says = "whether two one-sided tests show at 5 % that the means differ by less; p is the larger of theirs"
    return [*_PAIR_EXPLAINED, *((f"equivalent within {margin:g}", says) for margin in _margins(comparison.pairs))]


def _equivalence(test: Equivalence) -> str:
    return f"{'yes' if test.equivalent else 'not shown'} (p={test.p_value:.2g})"
