"""A comparison as a page: numbers, figures, episodes, settings, and the commands that repeat it."""

import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gacrl import tasks
from gacrl.config import files as configuration
from gacrl.evaluation import statistics
from gacrl.evaluation.statistics import with_interval
from gacrl.experiments.compare.compare import Comparison
from gacrl.experiments.compare.exploring import progress_metric, ways
from gacrl.experiments.compare.finished import Finished
from gacrl.experiments.compare.groups import Group
from gacrl.experiments.compare.report import about, everything, explained, listings, titled
from gacrl.export import bundle
from gacrl.training.recorder import RunFolder

if TYPE_CHECKING:
    from gacrl.experiments.compare.replays import Gallery
    from gacrl.report.figures import Look, Series
    from gacrl.report.page import Page

PAGE = "comparison"
"""The page's name in its folder."""
_STATISTICS = (statistics.mean, statistics.median)
"""What a page has beside the interquartile mean."""
_MARKS = 101
"""Thresholds of a performance profile."""


def file_of(out: Path) -> Path:
    """Return the HTML file of a report that is to be written there."""
    return out if out.suffix == ".html" else out / f"{PAGE}.html"


def write_page(comparison: Comparison, out: Path, command: str, galleries: "Sequence[Gallery]" = ()) -> Path:
    """Write the report: into the one file `out` where it ends in .html, else into the folder `out`.

    command: what was typed. galleries: the episodes of each group (`replays.record`); none: nobody played them. In a
    folder there are `comparison.html`, `comparison.md` and their figures. Returns the HTML file. Raises UserError where
    it cannot be written.
    """
    from gacrl.report import figures
    from gacrl.report.page import Page

    names = [group.name for group in comparison.groups]
    styles = figures.looks(names, {group.name: group.config.algorithm.name for group in comparison.groups})
    page = Page(f"{'Report of' if len(names) == 1 else 'Comparison of'} {', '.join(names)}")
    _numbers(page, comparison)
    for metric in comparison.metrics:
        _figures(page, comparison, metric, styles)
    _exploration(page, comparison, styles)
    if galleries:
        _episodes(page, comparison, galleries)
    _settings(page, comparison)
    _repeat(page, comparison, command)
    return page.write_html(out) if file_of(out) == out else page.write(out, PAGE)


def _numbers(page: "Page", comparison: Comparison) -> None:
    """The tables, and what must be known beside them."""
    page.text(about(comparison))
    if comparison.notes:
        page.heading("Read this first")
        for note in comparison.notes:
            page.text(note[:1].upper() + note[1:] + ".")
    results, *others = listings(comparison, None)
    page.table(results.columns, results.rows, "closing evaluation")
    for listing in others:
        page.table(listing.columns, listing.rows, listing.caption)
    if comparison.pairs:
        page.heading("How to read the differences", 3)
        for name, meaning in explained(comparison):
            page.text(f"{name[:1].upper()}{name[1:]}: {meaning}.")
    if summaries := _summaries(comparison):
        page.table(("metric", "group", "mean", "median"), summaries, "other statistics of the same seeds")
    columns, rows = everything(comparison)
    page.table(columns, rows, "every metric of the task, beside policies that learn nothing")


def _exploration(page: "Page", comparison: Comparison, styles: "Mapping[str, Look]") -> None:
    """How exploration followed progress, in groups whose rule looks at it."""
    from gacrl.report import figures

    found = {group.name: ways(group, comparison.play) for group in comparison.groups}
    found = {name: seeds for name, seeds in found.items() if seeds}
    if not found:
        return
    metric = progress_metric(comparison.groups[0].config)
    page.heading("Exploration against progress")
    page.figure(
        figures.paths(found, comparison.axis(metric), "share of random actions (ε)", styles),
        "Each seed's way along training: the share of random actions in its last update before each evaluation, over "
        "the progress in that evaluation. A dot marks the end.",
        "exploration",
    )


def _episodes(page: "Page", comparison: Comparison, galleries: "Sequence[Gallery]") -> None:
    """The player, and why there is nothing of some groups."""
    page.heading("Episodes")
    for gallery in galleries:
        if gallery.shown:
            of = "of the closing evaluation" if gallery.closing else "with starts of their own"
            page.text(
                f"{gallery.name}: the best, the median and the worst {max(len(gallery.shown) - 2, 0)} of "
                f"{gallery.of:,} episodes {of} by their return, over all seeds."
            )
        else:
            page.text(f"{gallery.name}: no episodes to play, since {gallery.because}.")
    if any(gallery.shown for gallery in galleries):
        from gacrl.experiments.compare.replays import data  # loads jax, as what is shown has

        style, script = bundle.source("report.css"), bundle.script("report.js")
        page.live(style, script, data(comparison, galleries), "The page as HTML plays these episodes.")


def _settings(page: "Page", comparison: Comparison) -> None:
    page.heading("Settings and versions")
    for group in comparison.groups:
        page.details(f"Settings of {group.name}", configuration.dumps(group.config).strip())
    runs = [run for group in comparison.groups for run in group.members]
    made = {str(run.path): run.summary.get("versions", {}) for run in runs}
    packages = list(dict.fromkeys(name for versions in made.values() for name in versions))
    rows = [(path, *(str(versions.get(name, "")) for name in packages)) for path, versions in made.items()]
    page.table(("run", *packages), rows, "versions that measured each run")


def _repeat(page: "Page", comparison: Comparison, command: str) -> None:
    """The commands that make the runs and this page again."""
    page.heading("To repeat it")
    task = comparison.groups[0].config.task
    made = [_made(run, task) for group in comparison.groups for run in group.members]
    page.code("\n".join([*made, command]))


def _made(run: Finished, task: str) -> str:
    """The command that trains a run again, into the next free folder."""
    begun_from = RunFolder.open(run.path).begun_from()
    start = "" if begun_from is None else f" --from {shlex.quote(begun_from)}"
    return f"gacrl train --config {shlex.quote(str(run.path / 'config.json'))}{start}{tasks.flag(task)}"


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
