"""A comparison to read: tables for the terminal, and a page with figures."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table

from gacrl import tasks
from gacrl.evaluation import statistics
from gacrl.evaluation.statistics import with_interval
from gacrl.experiments.compare.compare import Comparison, Group, Pair

PAGE = "comparison"
"""The page's name in its folder."""
_SHOWN_DIFFERENCES = 12
"""Settings listed in the terminal; the page and the JSON have all."""
_STATISTICS = (statistics.mean, statistics.median)
"""What a page has beside the interquartile mean."""
_MARKS = 101
"""Thresholds of a performance profile."""


class _Listing(NamedTuple):
    caption: str
    columns: tuple[str, ...]
    rows: list[tuple[str, ...]]


def print_comparison(comparison: Comparison) -> None:
    """The tables and what must be known beside them, on standard output."""
    console = Console(highlight=False, markup=False, emoji=False)
    if not console.is_terminal:
        console.width = 130
    for listing in _listings(comparison, _SHOWN_DIFFERENCES):
        console.print(listing.caption, soft_wrap=True)
        table = Table(*listing.columns, box=box.SIMPLE_HEAD)
        for row in listing.rows:
            table.add_row(*row)
        console.print(table)
    for note in comparison.notes:
        console.print(f"note: {note}", soft_wrap=True)


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
    if summaries := _summaries(comparison):
        page.table(("metric", "", "mean", "median"), summaries, "other statistics of the same seeds")
    for metric in comparison.metrics:
        page.heading(metric)
        lines = {who: comparison.reference(who, metric) for who in comparison.references}
        better = ", lower is better" if comparison.lower_is_better(metric) else ""
        name = metric.replace(".", "-")
        series = {group.name: _series(group, metric) for group in comparison.groups if group.evaluated_at}
        if series:
            page.figure(
                figures.curves(series, "environment steps", metric, lines),
                f"{metric} along training{better}: interquartile mean over seeds with its 95 % interval, "
                "and each seed as a thin line.",
                f"{name}-curves",
            )
        page.figure(
            figures.dots(
                {group.name: group.final[metric] for group in comparison.groups},
                {group.name: group.estimate(metric) for group in comparison.groups},
                metric,
                lines,
            ),
            f"{metric} of the closing evaluation{better}: every seed is a dot, below them the interquartile mean "
            "and its 95 % interval.",
            f"{name}-dots",
        )
        page.figure(
            figures.profile(_profiles(comparison.groups, metric), metric),
            f"Performance profile: the share of seeds whose {metric} is above the value below, with pointwise "
            "95 % intervals.",
            f"{name}-profile",
        )
    page.heading("Runs")
    runs = " ".join(run for group in comparison.groups for run in group.runs)
    page.code(f"gacrl compare {runs}{tasks.flag(comparison.groups[0].config.task)}")
    return page.write(folder, PAGE)


def _about(comparison: Comparison) -> str:
    return (
        f"Closing evaluations, {comparison.play}: {comparison.episodes} episodes of {comparison.horizon} steps; "
        "interquartile mean over seeds, 95 % stratified-bootstrap interval."
    )


def _listings(comparison: Comparison, most: int | None) -> list[_Listing]:
    """The tables; at most so many differing settings, None: all."""
    listings = [_results(comparison)]
    if comparison.pairs:
        rows = [_pair_row(pair) for pair in comparison.pairs]
        columns = ("metric", "a", "b", "a − b", "verdict on a", "detectable", "P(a better)", "claimed better")
        listings.append(_Listing("differences", columns, rows))
    if comparison.config_differences:
        differing = list(comparison.config_differences.items())
        # What makes the comparison unequal stands first.
        differing.sort(key=lambda item: item[0] not in comparison.unequal_switches)
        rows = [
            (name + (" *" if name in comparison.unequal_switches else ""), *map(_value, values))
            for name, values in differing[:most]
        ]
        left = len(differing) - len(rows)
        caption = "settings that differ (* a switch that should be equal)"
        caption += f", the first {len(rows)} of {len(differing)}: --json and --out have all" if left else ""
        listings.append(_Listing(caption, ("setting", *(group.name for group in comparison.groups)), rows))
    return listings


def _results(comparison: Comparison) -> _Listing:
    rows = [
        (group.name, str(len(group.seeds)), *(_estimate(group, metric) for metric in comparison.metrics))
        for group in comparison.groups
    ]
    rows += [
        (who, "", *(f"{comparison.reference(who, metric):.3f}" for metric in comparison.metrics))
        for who in comparison.references
    ]
    return _Listing(_about(comparison), ("", "seeds", *comparison.metrics), rows)


def _estimate(group: Group, metric: str) -> str:
    found = group.estimate(metric)
    return f"{group.point(metric):.3f} (one seed: no interval)" if found is None else with_interval(found)


def _pair_row(pair: Pair) -> tuple[str, ...]:
    start = (pair.metric, pair.a, pair.b)
    if pair.difference is None or pair.better is None:
        return (*start, f"{pair.point:.3f}", "one seed: none", "", "", "")
    difference, better = pair.difference, pair.better
    return (
        *start,
        with_interval(difference),
        f"{pair.verdict}{_equivalence(pair)}",
        f"{difference.detectable:.3f}",
        with_interval(better, ".2f"),
        pair.claimed or "no",
    )


def _equivalence(pair: Pair) -> str:
    if pair.equivalence is None:
        return ""
    test = pair.equivalence
    found = "equivalent" if test.equivalent else "not shown to be equivalent"
    return f"; {found} within {test.margin:g} (p = {test.p_value:.2g})"


def _summaries(comparison: Comparison) -> list[tuple[str, ...]]:
    """Means and medians with their intervals, beside which the interquartile mean is to be seen."""
    return [
        (metric, group.name, *(with_interval(statistics.estimate(group.final[metric], it)) for it in _STATISTICS))
        for metric in comparison.metrics
        for group in comparison.groups
        if len(group.seeds) > 1
    ]


def _series(group: Group, metric: str) -> Any:
    """What `figures.curves` draws of a group."""
    curve, seeds = group.curve(metric), group.along[metric]
    if curve is None:
        return group.evaluated_at, seeds[0], None, None, None
    return group.evaluated_at, curve.point, curve.low, curve.high, seeds


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
