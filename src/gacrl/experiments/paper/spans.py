"""Where a printed number would lie if it were ours, or random's: intervals that hold for all cells of a table at once.

A truly random Table II has some cell outside that cell's own 95 % interval in about half of all cases. The intervals
here are so much wider that it has one in 5 % of them: by the smallest p-value over all cells of a table
(Westfall and Young 1993), which minds that the cells of a row belong together. R draws, C cells of a row.
"""

from collections.abc import Sequence
from functools import lru_cache
from typing import Literal, NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Float, Int

from gacrl.experiments.paper.claims import Measure, Reading
from gacrl.experiments.paper.evidence import FINAL_EPISODES, Evidence, Metrics, Series, measured

Span: TypeAlias = tuple[float, float]
Draws: TypeAlias = Float[np.ndarray, "R C"]

ROUNDING = 0.005
"""The tables print two decimals."""
OUTSIDE = 0.05
"""How often a table that is truly random, or ours, has any cell outside."""
RESAMPLES = 10_000


class Row(NamedTuple):
    """Cells that are printed side by side: of one algorithm at the end, or of one stretch of its training."""

    who: str
    stretch: int | None
    measures: tuple[str, ...]


class Spans(NamedTuple):
    """Where each cell of a row lies, together with all other cells of the table."""

    ours: tuple[Span, ...]
    random: tuple[Span, ...]


@lru_cache(maxsize=256)
def table_spans(rows: tuple[Row, ...], reading: Reading, evidence: Evidence) -> tuple[Spans, ...]:
    """Return the intervals of every cell of a table, in its order. Raises MissingRun for a row that has no runs."""
    ours = family([_of_ours(row, reading, evidence) for row in rows])
    random = family([_of_random(row, reading, evidence) for row in rows])
    return tuple(Spans(*pair) for pair in zip(ours, random, strict=True))


def family(rows: Sequence[Draws]) -> list[tuple[Span, ...]]:
    """Return an interval for each cell, such that 5 % of all tables drawn like this have a cell outside.

    rows: of each row what its cells might be, drawn together; rows are independent of each other. A cell is printed
    with two decimals, and counts as inside where it may have been before it was rounded.
    """
    rng = np.random.default_rng(0)
    ordered = [np.sort(draws, 0) for draws in rows]
    smallest = [_p_values(held, draws.round(2)).min(1) for held, draws in zip(ordered, rows, strict=True)]
    size = min(map(len, smallest))
    over_tables = np.min([rng.permutation(p)[:size] for p in smallest], 0)
    level = min(float(np.quantile(over_tables, OUTSIDE, method="lower")), OUTSIDE)  # rounding may make it larger
    return [tuple(_interval(column, level) for column in held.T) for held in ordered]


def _p_values(ordered: Draws, values: Draws) -> Draws:
    """Two-sided, by rank among the draws, of values that are rounded."""

    def counted(half: float, side: Literal["left", "right"]) -> Int[np.ndarray, "R C"]:
        pairs = zip(ordered.T, values.T, strict=True)
        return np.stack([np.searchsorted(column, seen + half, side) for column, seen in pairs], 1)

    below, above = counted(ROUNDING, "right"), counted(-ROUNDING, "left")
    return np.minimum(2 * np.minimum(below, len(ordered) - above) / len(ordered), 1.0)


def _interval(ordered: Float[np.ndarray, " R"], level: float) -> Span:
    """The values whose p-value reaches the level."""
    tail = max(int(np.ceil(level / 2 * len(ordered) - 1e-9)), 1)
    return float(ordered[tail - 1]), float(ordered[-tail])


def inside(printed: float, span: Span) -> bool:
    """Return whether a printed number may lie there, before it was rounded."""
    return span[0] - ROUNDING <= printed <= span[1] + ROUNDING


def of_one(draws: Float[np.ndarray, " R"]) -> Span:
    """Return the 95 % interval of a number that stands alone."""
    low, high = np.percentile(draws, [2.5, 97.5])
    return float(low), float(high)


def best_of_random(measure: Measure, reading: Reading, evidence: Evidence) -> Span:
    """Return the 95 % interval of the best that a random policy shows in as many log lines of such difficulty."""
    rng = np.random.default_rng(0)
    stretches = evidence.reference(reading.column, "random").stretches
    lines = [measure.sign * measured(measure.weights, metrics)[:, None] for metrics in stretches]
    drawn = [_means(episodes, _episodes_in(reading), rng)[:, 0] for episodes in lines]
    return of_one(np.max(drawn, axis=0) * measure.sign)


def best_of_ours(measure: Measure, reading: Reading, evidence: Evidence) -> Span:
    """Return the same of one more training like ours."""
    rng = np.random.default_rng(0)
    series = evidence.trained(reading.column, "GACRL")
    member = rng.integers(len(series.config.seeds), size=RESAMPLES)
    lines = [
        _episodes_of(series, [measure], k, member, _episodes_in(reading), rng) for k in range(len(series.episodes))
    ]
    return of_one((measure.sign * np.stack(lines)[..., 0]).max(0) * measure.sign)


def random_interval(episodes: Float[np.ndarray, " E"], size: int) -> Span:
    """Return where 95 % of the means of so many episodes lie."""
    return of_one(_means(episodes[:, None], size, np.random.default_rng(0))[:, 0])


def _episodes_in(reading: Reading) -> int:
    """How many episodes a row of Table II is."""
    return 1 if reading.row == "episode" else FINAL_EPISODES


def _of_random(row: Row, reading: Reading, evidence: Evidence) -> Draws:
    """Cells of a random policy: each draw is one episode, or as many as the row is the mean of."""
    reference = evidence.reference(reading.column, "random")
    size = FINAL_EPISODES if row.stretch is None else _episodes_in(reading)
    if row.stretch is None:
        metrics = reference.stretches[-1] if reading.play == "training" else reference.final
    else:
        metrics = reference.stretches[row.stretch]
    episodes = np.stack([measured(reading.measure(name).weights, metrics) for name in row.measures], 1)
    return episodes if size == 1 else _means(episodes, size, np.random.default_rng(0))


def _means(episodes: Float[np.ndarray, "E C"], size: int, rng: np.random.Generator) -> Draws:
    """Means of so many episodes each, drawn again."""
    return episodes[rng.integers(len(episodes), size=(RESAMPLES, size))].mean(1)


def _of_ours(row: Row, reading: Reading, evidence: Evidence) -> Draws:
    """Cells of one more run of ours: a seed drawn again, and of that seed its episodes.

    A seed's own mean and standard deviation give place and spread (those of the end of training also for the closing
    evaluation). The shape, and how the cells of an episode belong together, come from all episodes that were logged
    one by one.
    """
    rng = np.random.default_rng(0)
    series = evidence.trained(reading.column, row.who)
    member = rng.integers(len(series.config.seeds), size=RESAMPLES)
    measures = [reading.measure(name) for name in row.measures]
    if row.stretch is not None:
        return _episodes_of(series, measures, row.stretch, member, _episodes_in(reading), rng)
    _, sd, _ = series.closing
    center = np.stack([evidence.values(m.weights, row.who, reading.play, reading.column) for m in measures], 1)
    spread = np.stack([_spread(m, sd) for m in measures], 1)
    return _around(center[member], spread[member], _shapes(series, measures), FINAL_EPISODES, measures, rng)


def _episodes_of(
    series: Series,
    measures: Sequence[Measure],
    stretch: int,
    member: np.ndarray,
    size: int,
    rng: np.random.Generator,
) -> Draws:
    """Means of so many episodes of a stretch of training, for each of the drawn seeds [R]."""
    center = np.stack([measured(m.weights, series.mean)[:, stretch] for m in measures], 1)
    spread = np.stack([_spread(m, series.sd)[:, stretch] for m in measures], 1)
    return _around(center[member], spread[member], _shapes(series, measures), size, measures, rng)


def _around(
    center: Draws,
    spread: Draws,
    shapes: Float[np.ndarray, "M C"],
    size: int,
    measures: Sequence[Measure],
    rng: np.random.Generator,
) -> Draws:
    """Means of so many episodes around the centers, within what the measures can be."""
    drawn = shapes[rng.integers(len(shapes), size=(len(center), size))].mean(1)
    least, most = np.array([(m.least, m.most) for m in measures]).T
    return np.clip(center + spread * drawn, least, most)


def _shapes(series: Series, measures: Sequence[Measure]) -> Float[np.ndarray, "M C"]:
    """All episodes logged one by one, in standard deviations from the mean of their stretch; their mean is 0."""
    columns: list[np.ndarray] = []
    for measure in measures:
        off = measured(measure.weights, series.last) - measured(measure.weights, series.mean)
        sd = _spread(measure, series.sd)
        columns.append(np.divide(off, sd, out=np.zeros_like(off), where=sd > 0).reshape(-1))
    shapes = np.stack(columns, 1)
    return shapes - shapes.mean(0)


def _spread(measure: Measure, sd: Metrics) -> np.ndarray:
    """The standard deviation of an episode; at most this for a measure of several metrics."""
    return measured({name: abs(weight) for name, weight in measure.weights.items()}, sd)
