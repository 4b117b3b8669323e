"""A comparison to read: tables for the terminal, and a page with figures."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from gacrl import tasks
from gacrl.cli.tables import print_table
from gacrl.evaluation import statistics
from gacrl.evaluation.statistics import Equivalence, with_interval
from gacrl.experiments.compare.compare import TOO_FEW, Comparison, Pair
from gacrl.experiments.compare.groups import Group
from gacrl.report.screen import console

if TYPE_CHECKING:
    from gacrl.report.figures import Look, Series
    from gacrl.report.page import Page

PAGE = "comparison"
"""The page's name in its folder."""
_SHOWN_DIFFERENCES = 12
"""Settings listed in the terminal; the page and the JSON have all."""
_STATISTICS = (statistics.mean, statistics.median)
"""What a page has beside the interquartile mean."""
_MARKS = 101
"""Thresholds of a performance profile."""
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
    """The tables and what must be known beside them, on standard output; on a narrow screen blocks in their place."""
    screen = console()
    for listing in _listings(comparison, _SHOWN_DIFFERENCES):
        screen.print(listing.caption, overflow="fold")
        print_table(screen, listing.columns, listing.rows)
    if comparison.pairs:
        for name, meaning in _explained(comparison):
            screen.print(f"{name}: {meaning}", overflow="fold")
    for note in comparison.notes:
        screen.print(f"note: {note}", overflow="fold")


def write_page(comparison: Comparison, folder: Path) -> Path:
    """Write `comparison.html`, `comparison.md` and their figures; returns the HTML file.

    Raises UserError where the folder cannot be written.
    """
    from gacrl.report import figures
    from gacrl.report.page import Page

    page = Page("Comparison of " + ", ".join(group.name for group in comparison.groups))
    page.text(_about(comparison))
    if comparison.notes:
        page.heading("Read this first")
        for note in comparison.notes:
            page.text(note[:1].upper() + note[1:] + ".")
    for listing in _listings(comparison, None):
        page.table(listing.columns, listing.rows, listing.caption)
    if comparison.pairs:
        page.heading("How to read the differences", 3)
        for name, meaning in _explained(comparison):
            page.text(f"{name[:1].upper()}{name[1:]}: {meaning}.")
    if summaries := _summaries(comparison):
        page.table(("metric", "group", "mean", "median"), summaries, "other statistics of the same seeds")
    names = [group.name for group in comparison.groups]
    styles = figures.looks(names, {group.name: group.config.algorithm.name for group in comparison.groups})
    for metric in comparison.metrics:
        _figures(page, comparison, metric, styles)
    page.heading("Runs")
    members = [run for group in comparison.groups for run in group.members]
    runs = " ".join(str(run.path) for run in members)
    again = any(run.set_horizon not in (None, comparison.horizon) for run in members)
    horizon = f" --horizon {comparison.horizon}" if again else ""
    page.code(f"gacrl compare {runs}{horizon}{tasks.flag(comparison.groups[0].config.task, as_given=True)}")
    return page.write(folder, PAGE)


def _figures(page: "Page", comparison: Comparison, metric: str, styles: "Mapping[str, Look]") -> None:
    """The figures of one metric: along training, at the end, and the profile."""
    from gacrl.report import figures

    label, name, groups = comparison.axis(metric), metric.replace(".", "-"), comparison.groups
    lines = {who: comparison.reference(who, metric) for who in comparison.references}
    better = f"{'lower' if comparison.lower_is_better(metric) else 'higher'} is better"
    page.heading(_titled(comparison, metric))
    drawn = [group for group in groups if group.evaluated_at]
    absent = [group.name for group in groups if not group.evaluated_at]
    if drawn:
        first = min(group.evaluated_at[0] for group in drawn)
        page.figure(
            figures.curves(
                {group.name: _series(group, metric) for group in drawn},
                "environment steps of each seed",
                label,
                lines,
                styles,
                stopped=[group.name for group in drawn if not group.seeds],
                begin=0.0,
            ),
            f"Along training, {better}: interquartile mean over the seeds that trained so far with its 95 % interval, "
            f"and each seed as a thin line. The first evaluation is after {first:,} steps: before training there was "
            "none. A cross marks where seeds end before others, or diverge; nothing is carried on behind it."
            + (f" Without evaluations along training: {', '.join(absent)}." if absent else ""),
            f"{name}-curves",
        )
    page.figure(
        figures.dots(
            {group.name: group.final[metric] for group in groups},
            {group.name: group.estimate(metric) for group in groups},
            label,
            lines,
            styles,
        ),
        f"Closing evaluation, {better}: every seed is a dot, below them the interquartile mean and its 95 % interval.",
        f"{name}-dots",
    )
    page.figure(
        figures.profile(_profiles([group for group in groups if group.seeds], metric), label, styles=styles),
        f"Performance profile, {better}: the share of seeds whose closing value is above the one below, with pointwise "
        "95 % intervals.",
        f"{name}-profile",
    )


def _titled(comparison: Comparison, metric: str) -> str:
    """What tables call a metric, and its name where that is another."""
    label = comparison.label(metric)
    return label if label == metric else f"{label}: {metric}"


def _about(comparison: Comparison) -> str:
    return (
        f"Closing evaluations, {comparison.play}: {comparison.episodes} episodes of {comparison.horizon} steps. A "
        "number is the interquartile mean over seeds (the mean of the middle half of them), in brackets its 95 % "
        "interval (stratified bootstrap)."
    )


def _listings(comparison: Comparison, most: int | None) -> list[_Listing]:
    """The tables; at most so many differing settings, None: all."""
    listings = [_results(comparison)]
    for metric in comparison.metrics if comparison.pairs else ():
        better = "lower" if comparison.lower_is_better(metric) else "higher"
        pairs = [pair for pair in comparison.pairs if pair.metric == metric]
        margins = _margins(pairs)
        rows = [_pair_row(pair, comparison.lower_is_better(metric), margins) for pair in pairs]
        columns = (*_PAIR, *(f"equivalent within {margin:g}" for margin in margins))
        listings.append(
            _Listing(f"differences in {_titled(comparison, metric)} ({better} is better)", columns, rows)
        )
    if comparison.config_differences:
        differing = list(comparison.config_differences.items())
        # What makes the comparison unequal stands first.
        differing.sort(key=lambda item: item[0] not in comparison.unequal_switches)
        rows = [
            (name + (" *" if name in comparison.unequal_switches else ""), *map(_value, values))
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
    return _Listing(_about(comparison), ("group", "seeds", *labels), rows)


def _seeds(group: Group) -> str:
    """How many there are, and how many of them have no closing evaluation."""
    many = len(group.seeds) + len(group.lost)
    return f"{many} ({len(group.lost)} in a run that diverged)" if group.lost else str(many)


def _estimate(group: Group, metric: str) -> str:
    found, point = group.estimate(metric), group.point(metric)
    if point is None:
        return "diverged"
    return f"{point:.3f} (one seed: no interval)" if found is None else with_interval(found)


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


def _explained(comparison: Comparison) -> list[tuple[str, str]]:
    """What the columns of the differences mean, those that are there."""
    says = "whether two one-sided tests show at 5 % that the means differ by less; p is the larger of theirs"
    return [*_PAIR_EXPLAINED, *((f"equivalent within {margin:g}", says) for margin in _margins(comparison.pairs))]


def _equivalence(test: Equivalence) -> str:
    return f"{'yes' if test.equivalent else 'not shown'} (p={test.p_value:.2g})"


def _summaries(comparison: Comparison) -> list[tuple[str, ...]]:
    """Means and medians with their intervals, beside which the interquartile mean is to be seen."""
    return [
        (
            comparison.label(metric),
            group.name,
            *(with_interval(statistics.estimate(group.final[metric], it)) for it in _STATISTICS),
        )
        for metric in comparison.metrics
        for group in comparison.groups
        if len(group.seeds) > 1
    ]


def _series(group: Group, metric: str) -> "Series":
    """What `figures.curves` draws of a group; a single seed is its own line."""
    curve, seeds = group.curve(metric), group.along[metric]
    return group.evaluated_at, curve.point, curve.low, curve.high, seeds if len(seeds) > 1 else None


def _profiles(groups: Sequence[Group], metric: str) -> dict[str, Any]:
    """Per group: thresholds over the range of all its values and a little beyond, shares and bounds."""
    everything = np.concatenate([group.final[metric] for group in groups])
    beyond = 0.05 * float(np.ptp(everything)) or 0.5
    marks = np.linspace(everything.min() - beyond, everything.max() + beyond, _MARKS)
    profiles: dict[str, Any] = {}
    for group in groups:
        if len(group.seeds) > 1:
            profiles[group.name] = (marks, *statistics.performance_profile(group.final[metric], marks))
        else:
            profiles[group.name] = (marks, (group.final[metric][:, None] > marks).mean(0), None, None)
    return profiles


def _value(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value)
