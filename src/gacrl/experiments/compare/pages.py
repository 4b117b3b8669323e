"""A comparison as a page: the tables of the terminal, and figures."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gacrl import tasks
from gacrl.evaluation import statistics
from gacrl.evaluation.statistics import with_interval
from gacrl.experiments.compare.compare import Comparison
from gacrl.experiments.compare.groups import Group
from gacrl.experiments.compare.report import about, explained, listings, titled

if TYPE_CHECKING:
    from gacrl.report.figures import Look, Series
    from gacrl.report.page import Page

PAGE = "comparison"
"""The page's name in its folder."""
_STATISTICS = (statistics.mean, statistics.median)
"""What a page has beside the interquartile mean."""
_MARKS = 101
"""Thresholds of a performance profile."""


def write_page(comparison: Comparison, folder: Path) -> Path:
    """Write `comparison.html`, `comparison.md` and their figures; returns the HTML file.

    Raises UserError where the folder cannot be written.
    """
    from gacrl.report import figures
    from gacrl.report.page import Page

    page = Page("Comparison of " + ", ".join(group.name for group in comparison.groups))
    page.text(about(comparison))
    if comparison.notes:
        page.heading("Read this first")
        for note in comparison.notes:
            page.text(note[:1].upper() + note[1:] + ".")
    for listing in listings(comparison, None):
        page.table(listing.columns, listing.rows, listing.caption)
    if comparison.pairs:
        page.heading("How to read the differences", 3)
        for name, meaning in explained(comparison):
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
    page.code(f"gacrl compare {runs}{horizon}{tasks.flag(comparison.groups[0].config.task)}")
    return page.write(folder, PAGE)


def _figures(page: "Page", comparison: Comparison, metric: str, styles: "Mapping[str, Look]") -> None:
    """The figures of one metric: along training, at the end, and the profile."""
    from gacrl.report import figures

    label, name, groups = comparison.axis(metric), metric.replace(".", "-"), comparison.groups
    lines = {who: comparison.reference(who, metric) for who in comparison.references}
    better = f"{'lower' if comparison.lower_is_better(metric) else 'higher'} is better"
    page.heading(titled(comparison, metric))
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
