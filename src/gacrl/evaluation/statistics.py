"""Statistics over seeds: what a handful of runs allows one to say, and what it does not.

After Agarwal et al. 2021 ("Deep reinforcement learning at the edge of the statistical precipice", whose package
rliable computes the same) and Gorsane et al. 2022 (the protocol that marl-eval implements). Scores are [S] (the
seeds of one task) or [S, K] (of K tasks). Every interval is the 2.5th to the 97.5th percentile of a stratified
bootstrap: seeds are drawn again with replacement, within each task. Few seeds make it too narrow, so that five
seeds indicate and ten may claim.

Every function refuses a score that is NaN or infinite, and names its place: sorting would take NaN for the best.

A leaf: numpy and scipy only. `scipy.special` has what is needed of scipy.stats, and loads in half a second less.
"""

from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import special

from gacrl.errors import UserError

CONFIDENCE = 0.95
POWER = 0.8
"""Probability of seeing a difference that is there, for the smallest detectable one."""

Numbers: TypeAlias = ArrayLike | Sequence[Any]
Floats: TypeAlias = NDArray[np.float64]
Statistic: TypeAlias = Callable[[Floats], Any]
"""Reduces scores [..., S, K] to [...], so that all resamples are one call."""
Verdict: TypeAlias = Literal["higher", "lower", "cannot be told apart"]


class NotFinite(UserError, ValueError):
    """A score, threshold or margin is NaN or infinite."""


class Estimate(NamedTuple):
    """A number and its 95 % interval."""

    point: float
    low: float
    high: float


class Difference(NamedTuple):
    """The statistic of a less that of b."""

    point: float
    low: float
    high: float
    detectable: float
    """The smallest difference of means that so many seeds, spread so widely, show in 80 % of all repetitions."""
    verdict: Verdict
    """Of a against b; they cannot be told apart where the interval includes 0."""


class Equivalence(NamedTuple):
    """Whether two means differ by less than a margin, by two one-sided tests."""

    point: float
    """Mean of a less mean of b."""
    margin: float
    p_value: float
    """The larger one of the two tests' p-values."""
    equivalent: bool
    """p_value < 0.05; False leaves it open, it does not show a difference."""


class Curve(NamedTuple):
    """A statistic at each of P points with its 95 % interval, each [P]."""

    point: Floats
    low: Floats
    high: Floats


def with_interval(found: Estimate | Difference | tuple[float, float, float], form: str = ".3f") -> str:
    """Return a number and its bounds, to be read: "0.973 [0.971, 0.976]"."""
    point, low, high = (f"{number:{form}}" for number in found[:3])
    return f"{point} [{low}, {high}]"


def iqm(values: Numbers) -> Any:
    """Return the interquartile mean: of all S × K scores, without the ⌊S K / 4⌋ lowest and as many of the highest.

    values: [S] or [..., S, K]. Returns [...]; a number for [S] and [S, K]. Raises NotFinite, a ValueError, for NaN,
    and UserError where there are no scores.
    """
    scores = _some(values)
    ordered = np.sort(scores.reshape(*scores.shape[:-2], -1), axis=-1)
    cut = ordered.shape[-1] // 4
    return ordered[..., cut : ordered.shape[-1] - cut].mean(-1)


def mean(values: Numbers) -> Any:
    """Return the mean of all scores: [S] or [..., S, K] to [...]. Raises as `iqm` does."""
    return _some(values).mean((-2, -1))


def median(values: Numbers) -> Any:
    """Return the median over tasks of each task's mean, as in rliable; with [S] scores of one task, that of its seeds.

    [S] or [..., S, K] to [...]. With one task as [S, 1] it is the median of the seeds as well (rliable: the mean).
    Raises as `iqm` does.
    """
    scores = _some(values)
    if scores.shape[-1] == 1:
        return np.median(scores, axis=(-2, -1))
    return np.median(scores.mean(-2), axis=-1)


def estimate(values: Numbers, statistic: Statistic = iqm, reps: int = 2000, seed: int = 0) -> Estimate:
    """Return a statistic of scores [S] or [S, K] with its 95 % stratified-bootstrap interval.

    statistic: reduces [..., S, K] to [...]. Raises UserError for fewer than two seeds, or what is not a number.
    """
    scores = _checked(values)
    resampled = statistic(_resample(scores, reps, np.random.default_rng(seed)))
    return Estimate(float(statistic(scores)), *_interval(resampled))


def difference(a: Numbers, b: Numbers, statistic: Statistic = iqm, reps: int = 2000, seed: int = 0) -> Difference:
    """Return the statistic of a less that of b, with its 95 % interval: both are resampled, independently.

    a: [S] or [S, K]; b: [S'] or [S', K]. Raises UserError for fewer than two seeds, other tasks, or NaN.
    """
    first, second = _checked_pair(a, b)
    rng = np.random.default_rng(seed)
    resampled = statistic(_resample(first, reps, rng)) - statistic(_resample(second, reps, rng))
    low, high = _interval(resampled)
    verdict: Verdict = "higher" if low > 0 else "lower" if high < 0 else "cannot be told apart"
    return Difference(float(statistic(first) - statistic(second)), low, high, _detectable(first, second), verdict)


def probability_of_improvement(a: Numbers, b: Numbers, reps: int = 2000, seed: int = 0) -> Estimate:
    """Return P(a seed of a scores higher than a seed of b), ties half, the mean over tasks, with its 95 % interval.

    The Mann-Whitney U statistic over the number of pairs (Agarwal et al. 2021). Scores as for `difference`. A
    protocol that claims an improvement asks for a point of at least 0.95 and a low above 0.5
    (Gorsane et al. 2022).
    """
    first, second = _checked_pair(a, b)
    rng = np.random.default_rng(seed)
    resampled = _improvement(_resample(first, reps, rng), _resample(second, reps, rng))
    return Estimate(float(_improvement(first, second)), *_interval(resampled))


def equivalent(a: Numbers, b: Numbers, margin: float) -> Equivalence:
    """Return whether the means of a and b differ by less than `margin`: two one-sided Welch tests (Schuirmann 1987).

    That an interval includes 0 shows no equality; only this does. Scores as for `difference`; of K tasks it is
    the means over tasks that are compared. Raises UserError for a margin that is not positive.
    """
    require_margin(margin)
    first, second = _checked_pair(a, b)
    point = float((first.mean(0) - second.mean(0)).mean())
    tasks = first.shape[1]
    shares = np.concatenate([scores.var(0, ddof=1) / len(scores) for scores in (first, second)]) / tasks**2
    error = float(np.sqrt(shares.sum()))
    if error == 0.0:
        p_value = 0.0 if abs(point) < margin else 1.0
    else:
        freedom = np.repeat([len(first) - 1, len(second) - 1], tasks)
        degrees = shares.sum() ** 2 / (shares**2 / freedom).sum()  # Welch-Satterthwaite
        p_value = float(special.stdtr(degrees, (abs(point) - margin) / error))
    return Equivalence(point, float(margin), p_value, p_value < 1 - CONFIDENCE)


def require_margin(margin: float) -> None:
    """Raise UserError for one that is not positive, or infinite."""
    _require_finite(margin, "the margin of an equivalence")
    if not margin > 0:
        raise UserError(f"the margin of an equivalence must be positive, not {margin}")


def performance_profile(values: Numbers, thresholds: Numbers, reps: int = 2000, seed: int = 0) -> Curve:
    """Return the share of runs that score above each of P thresholds, with pointwise 95 % intervals.

    values: [S] or [S, K]; thresholds: [P]. Raises UserError as `estimate` does.
    """
    scores, marks = _checked(values), np.asarray(thresholds, float)
    _require_finite(marks, "a threshold", ("number",))
    resampled = _resample(scores, reps, np.random.default_rng(seed))
    bounds = [_interval((resampled > mark).mean((-2, -1))) for mark in marks]
    point = (scores[..., None] > marks).mean((0, 1))
    low, high = np.array(bounds, float).reshape(-1, 2).T
    return Curve(point, low, high)


def sample_efficiency(values: Numbers, statistic: Statistic = iqm, reps: int = 2000, seed: int = 0) -> Curve:
    """Return a statistic at each of P evaluations, pointwise 95 % intervals; a resampled seed brings its whole curve.

    values: [S, P] of one task or [S, K, P]. Raises UserError for fewer than two seeds, or what is not a number.
    """
    scores = np.asarray(values, float)
    if scores.ndim == 2:
        scores = scores[:, None]
    if scores.ndim != 3:
        raise UserError(f"curves need scores [S, P] or [S, K, P], not {scores.ndim} axes")
    _require_finite(scores, "a score", ("seed", "task", "evaluation"))
    _require_seeds(scores)
    picks = _picks(scores.shape[0], scores.shape[1], reps, np.random.default_rng(seed))
    columns = [
        (float(statistic(now)), *_interval(statistic(np.take_along_axis(now[None], picks, axis=1))))
        for now in np.moveaxis(scores, -1, 0)
    ]
    return Curve(*np.array(columns, float).reshape(-1, 3).T)


def _require_finite(values: Any, what: str, axes: Sequence[str] = ()) -> None:
    """Raises NotFinite for NaN and infinities, with the place of the first: "(seed 2, task 0)", counted from 0.

    axes: names of the last axes of the values; what stands before them is resamples.
    """
    numbers = np.asarray(values, float)
    finite = np.isfinite(numbers)
    if finite.all():
        return
    place = tuple(int(k) for k in np.argwhere(~finite)[0])
    names = (("sample",) * numbers.ndim + tuple(axes))[len(axes) :]
    where = ", ".join(f"{name} {k}" for name, k in zip(names, place, strict=True))
    raise NotFinite(f"{what}{where and f' ({where})'} is not a finite number, but {numbers[place]}")


def _scores(values: Numbers) -> Floats:
    """[..., S, K], finite; seeds of one task, [S], become [S, 1]."""
    scores = np.asarray(values, float)
    _require_finite(scores, "a score", ("seed",) if scores.ndim == 1 else ("seed", "task"))
    return scores[:, None] if scores.ndim == 1 else scores


def _some(values: Numbers) -> Floats:
    """The same. Raises UserError where there are none: they have no mean."""
    scores = _scores(values)
    if scores.ndim < 2 or 0 in scores.shape:
        raise UserError(
            f"scores must be [seeds] or [seeds, tasks], one at the least, not of shape {list(scores.shape)}"
        )
    return scores


def _checked(values: Numbers) -> Floats:
    """[S, K], finite, of at least two seeds."""
    scores = _scores(values)
    if scores.ndim != 2 or scores.shape[1] == 0:
        raise UserError(f"scores must be [seeds] or [seeds, tasks], not of shape {list(scores.shape)}")
    _require_seeds(scores)
    return scores


def _checked_pair(a: Numbers, b: Numbers) -> tuple[Floats, Floats]:
    first, second = _checked(a), _checked(b)
    if first.shape[1] != second.shape[1]:
        raise UserError(
            f"what is compared needs the same tasks: one side has {first.shape[1]}, the other {second.shape[1]}"
        )
    return first, second


def _require_seeds(scores: Floats) -> None:
    if len(scores) < 2:
        raise UserError(f"an interval needs at least two seeds, not {len(scores)}: train more with --num-seeds")


def _picks(seeds: int, tasks: int, reps: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Which seed stands in each place of each resample, for every task by itself: [R, S, K]."""
    return rng.integers(seeds, size=(reps, seeds, tasks))


def _resample(scores: Floats, reps: int, rng: np.random.Generator) -> Floats:
    """Scores [S, K] with the seeds of each task drawn again: [R, S, K]."""
    picks = _picks(scores.shape[0], scores.shape[1], reps, rng)
    return np.take_along_axis(scores[None], picks, axis=1)


def _interval(resampled: Floats) -> tuple[float, float]:
    """The bounds of the middle 95 % of [R] resampled statistics."""
    tail = 50 * (1 - CONFIDENCE)
    low, high = np.percentile(resampled, [tail, 100 - tail])
    return float(low), float(high)


def _improvement(first: Floats, second: Floats) -> Any:
    """[..., S, K] and [..., S', K] to [...]: the share of pairs that the first wins, ties half."""
    x, y = first[..., :, None, :], second[..., None, :, :]
    return ((x > y) + 0.5 * (x == y)).mean((-3, -2, -1))


def _detectable(first: Floats, second: Floats) -> float:
    """The smallest difference of means that a two-sided t-test at 5 % sees with 80 % power (Cohen 1988, ch. 2).

    The spread is pooled over both, within tasks. An IQM of scores that are about normal spreads some 10 % wider than
    their mean: for it, read this as a lower bound.
    """
    tasks = first.shape[1]
    sizes = len(first), len(second)
    degrees = sizes[0] + sizes[1] - 2
    squares = ((first - first.mean(0)) ** 2).sum(0) + ((second - second.mean(0)) ** 2).sum(0)
    pooled_sd = np.sqrt((squares / degrees).mean() / tasks)  # of the mean over the tasks
    error = float(pooled_sd * np.sqrt(1 / sizes[0] + 1 / sizes[1]))
    return error * _noncentrality(degrees * tasks)


def _noncentrality(degrees: int) -> float:
    """The shift, in standard errors, that a two-sided t-test at 5 % sees with 80 % power.

    The chance to see it with the wrong sign is left out: it is below 1e-4 from two seeds on.
    """
    critical = special.stdtrit(degrees, 0.5 + CONFIDENCE / 2)
    return float(special.nctdtrinc(degrees, 1 - POWER, critical))
