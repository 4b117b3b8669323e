"""Statistics over seeds, against numbers worked out by hand and those of rliable."""

import subprocess
import sys
from collections.abc import Iterator

import numpy as np
import pytest

from gacrl.errors import UserError
from gacrl.evaluation import statistics
from gacrl.evaluation.statistics import (
    difference,
    equivalent,
    estimate,
    iqm,
    mean,
    median,
    performance_profile,
    probability_of_improvement,
    sample_efficiency,
)

# rliable is no dependency of these tests: version 1.2.0 brings eight packages (pandas, statsmodels, arch and
# others, 165 MB), and as pip resolves it today it cannot be imported, since arch 7.2 needs pandas below 3. The
# numbers below are what rliable 1.2.0 (with pandas 2) gives for A, B and C, each call after np.random.seed(3) and
# with 500 resamples; `rliables_resamples` draws the very same ones.
A = np.array(
    [
        [1.85, 0.77, 1.02],
        [1.2, 0.61, 1.0],
        [1.0, 0.12, 1.51],
        [1.3, 0.69, 0.91],
        [1.25, 0.87, 0.88],
        [0.27, 1.28, 1.06],
        [1.14, 0.24, 1.83],
    ]
)
B = np.array(
    [[0.78, 0.51, 1.71], [0.68, -0.03, 0.5], [-0.44, 1.22, 0.49], [0.33, 1.24, -0.13], [0.97, -0.33, 0.37]]
)
C = np.array(
    [
        [0.4, 2.13, 4.01, 4.85],
        [1.42, 2.33, 3.61, 4.23],
        [0.15, 0.25, 1.44, 3.56],
        [1.13, 1.87, 3.83, 4.95],
        [1.05, 2.18, 3.11, 3.96],
        [0.28, 1.53, 2.48, 4.08],
    ]
)
REPS = 500


def rliables_resamples(monkeypatch: pytest.MonkeyPatch, *sizes: int) -> None:
    """Let the next estimates draw as rliable does: sizes are the seeds of each side, three tasks."""
    state = np.random.RandomState(3)
    draws = [[state.choice(size, (size, 3), replace=True) for size in sizes] for _ in range(REPS)]
    sides: Iterator[np.ndarray] = iter([np.array([draw[k] for draw in draws]) for k in range(len(sizes))])
    monkeypatch.setattr(statistics, "_picks", lambda *shape: next(sides))


@pytest.mark.parametrize(
    ("statistic", "expected"),
    [
        (iqm, (1.009090909090909, 0.8686136363636363, 1.1336363636363636)),
        (mean, (0.9904761904761905, 0.8418809523809523, 1.14025)),
        (median, (1.1442857142857144, 0.8078214285714286, 1.2979642857142857)),
    ],
)
def test_estimates_are_rliables(monkeypatch: pytest.MonkeyPatch, statistic, expected):
    rliables_resamples(monkeypatch, 7)
    np.testing.assert_allclose(estimate(A, statistic, REPS), expected, rtol=0, atol=1e-6)


def test_the_probability_of_improvement_is_rliables(monkeypatch: pytest.MonkeyPatch):
    rliables_resamples(monkeypatch, 7, 5)
    expected = (0.7714285714285715, 0.5714285714285715, 0.9383333333333331)
    np.testing.assert_allclose(probability_of_improvement(A, B, REPS), expected, rtol=0, atol=1e-6)


def test_performance_profiles_are_rliables(monkeypatch: pytest.MonkeyPatch):
    rliables_resamples(monkeypatch, 7)
    profile = performance_profile(A, [0.0, 0.5, 1.0, 1.5], REPS)
    np.testing.assert_allclose(profile.point, [1, 18 / 21, 10 / 21, 3 / 21])
    np.testing.assert_allclose(profile.low, [1, 15 / 21, 6 / 21, 1 / 21], rtol=0, atol=1e-6)
    np.testing.assert_allclose(profile.high, [1, 1, 14 / 21, 6 / 21], rtol=0, atol=1e-6)


def test_sample_efficiency_is_an_estimate_at_every_evaluation():
    curve = sample_efficiency(C)
    np.testing.assert_allclose(curve.point, [0.715, 1.9275, 3.2575, 4.28])  # rliable's
    for k in range(4):
        assert (curve.point[k], curve.low[k], curve.high[k]) == pytest.approx(estimate(C[:, k]))
    np.testing.assert_array_equal(sample_efficiency(C[:, None]).low, curve.low)


def test_statistics_by_hand():
    assert iqm([4.0, 1.0, 100.0, 2.0, 3.0]) == 3.0  # without 1 and 100
    assert iqm([1.0, 5.0, 6.0]) == 4.0  # three quarters of a seed are none
    assert iqm([[1.0, 2.0], [3.0, 40.0]]) == 2.5  # over seeds and tasks together
    assert mean([[1.0, 2.0], [3.0, 40.0]]) == 11.5
    assert median([1.0, 2.0, 9.0]) == 2.0
    assert median([[0.0, 5.0, 7.0], [2.0, 5.0, 9.0]]) == 5.0  # of the tasks' means 1, 5 and 8
    np.testing.assert_array_equal(iqm(np.array([[[1.0], [2.0], [3.0], [10.0]], [[0.0]] * 4])), [2.5, 0.0])


def test_an_estimate_of_equal_seeds_has_no_width():
    assert estimate([2.0, 2.0, 2.0]) == (2.0, 2.0, 2.0)


def test_two_seeds_reach_from_one_to_the_other():
    assert estimate([1.0, 3.0]) == (2.0, 1.0, 3.0)


def test_the_same_seed_gives_the_same_interval():
    assert estimate(A, seed=1) == estimate(A, seed=1)
    assert estimate(A, seed=1) != estimate(A, seed=2)
    assert estimate(A[:, 0]) == estimate(A[:, :1])


def test_strata_are_resampled_by_themselves():
    """Tasks of other scales, without spread in any: resampling across tasks would give the interval a width."""
    assert estimate([[1.0, 50.0]] * 3, mean) == (25.5, 25.5, 25.5)


@pytest.mark.parametrize(
    ("a", "b", "verdict"),
    [
        ([5.0, 6.0, 7.0], [1.0, 2.0, 3.0], "higher"),
        ([1.0, 2.0, 3.0], [5.0, 6.0, 7.0], "lower"),
        ([1.0, 2.0, 3.0], [2.0, 3.0, 1.5], "cannot be told apart"),
        ([1.0, 1.0], [1.0, 1.0], "cannot be told apart"),
    ],
)
def test_the_verdict_is_where_the_interval_lies(a: list[float], b: list[float], verdict: str):
    found = difference(a, b)
    assert found.verdict == verdict
    assert found.point == pytest.approx(iqm(a) - iqm(b))
    assert found.low <= found.point <= found.high
    assert (found.low <= 0 <= found.high) == (verdict == "cannot be told apart")


def test_a_difference_of_other_statistics():
    assert difference([1.0, 2.0, 9.0], [0.0, 0.0], statistic=mean).point == 4.0
    assert difference([1.0, 2.0, 9.0], [0.0, 0.0], statistic=median).point == 2.0


@pytest.mark.parametrize(("seeds", "effect"), [(5, 2.0244), (10, 1.3249), (64, 0.4991)])
def test_the_detectable_difference_is_cohens(seeds: int, effect: float):
    """Cohen's d for two groups of so many, 5 % two-sided, 80 % power: his tables, and G*Power's."""
    scores = np.random.default_rng(0).normal(size=seeds)
    scores = (scores - scores.mean()) / scores.std(ddof=1)
    assert difference(scores, 3 + scores).detectable == pytest.approx(effect, abs=1e-3)
    assert difference(10 * scores, 10 * scores).detectable == pytest.approx(10 * effect, abs=1e-2)


def test_the_detectable_difference_pools_by_size():
    """Squares 2 and 6 over 2 + 2 degrees of freedom: sd √2, and 3 a side see 3.0709 of it."""
    found = difference([0.0, 1.0, 2.0], [0.0, np.sqrt(3), 2 * np.sqrt(3)])
    assert found.detectable == pytest.approx(3.0709 * np.sqrt(2), abs=1e-3)


def test_several_tasks_detect_smaller_differences():
    one = np.array([[-1.0], [0.0], [1.0], [-1.0], [1.0]])
    four = np.repeat(one, 4, axis=1)
    assert difference(four, four).detectable < 0.5 * difference(one, one).detectable


def test_no_spread_detects_anything():
    assert difference([1.0, 1.0], [2.0, 2.0]).detectable == 0.0


def test_the_probability_of_improvement_counts_pairs():
    assert probability_of_improvement([1.0, 3.0], [2.0, 0.0, 3.0]).point == pytest.approx((1 + 2.5) / 6)
    assert probability_of_improvement([5.0, 6.0], [1.0, 2.0]) == (1.0, 1.0, 1.0)
    assert probability_of_improvement([[5.0, 0.0]] * 2, [[1.0, 1.0]] * 2).point == 0.5  # one task each
    assert probability_of_improvement([1.0, 1.0], [1.0, 1.0]).point == 0.5


def test_equivalence_by_two_one_sided_tests():
    """Means 2 and 2, variances 1 over 3 seeds: error √(2/3), 4 degrees of freedom, t = 2 / 0.8165 = 2.449."""
    found = equivalent([1.0, 2.0, 3.0], [3.0, 2.0, 1.0], margin=2.0)
    assert found.point == 0.0
    assert found.p_value == pytest.approx(0.0352, abs=1e-4)
    assert found.equivalent
    assert not equivalent([1.0, 2.0, 3.0], [3.0, 2.0, 1.0], margin=1.0).equivalent  # t = 1.22


def test_an_interval_around_zero_shows_no_equivalence():
    a, b = [0.0, 1.0, 2.0, 3.0], [0.5, 1.5, 2.0, 3.5]
    assert difference(a, b).verdict == "cannot be told apart"
    assert not equivalent(a, b, margin=0.5).equivalent


def test_equivalence_is_symmetric_and_holds_without_spread():
    assert equivalent([1.0, 2.0, 4.0], [2.0, 2.5, 3.0], 1.0).p_value == pytest.approx(
        equivalent([2.0, 2.5, 3.0], [1.0, 2.0, 4.0], 1.0).p_value
    )
    assert equivalent([1.0, 1.0], [1.5, 1.5], 1.0)[2:] == (0.0, True)
    assert equivalent([1.0, 1.0], [2.5, 2.5], 1.0)[2:] == (1.0, False)


@pytest.mark.parametrize(
    ("call", "sentence"),
    [
        (lambda: estimate([1.0]), "an interval needs at least two seeds, not 1"),
        (lambda: estimate([]), "an interval needs at least two seeds, not 0"),
        (lambda: difference([1.0, 2.0], [1.0]), "at least two seeds, not 1"),
        (lambda: sample_efficiency([[1.0, 2.0]]), "at least two seeds, not 1"),
        (lambda: estimate([1.0, np.nan]), "not a finite number"),
        (lambda: sample_efficiency([[1.0, np.inf], [0.0, 1.0]]), "not a finite number"),
        (lambda: sample_efficiency([1.0, 2.0]), r"curves need scores \[S, P\] or \[S, K, P\], not 1 axes"),
        (lambda: estimate(np.zeros((2, 2, 2))), r"not of shape \[2, 2, 2\]"),
        (lambda: difference(np.zeros((2, 2)), np.zeros((2, 3))), "one side has 2, the other 3"),
        (lambda: equivalent([1.0, 2.0], [1.0, 2.0], 0.0), "must be positive, not 0.0"),
    ],
)
def test_what_cannot_be_computed_is_said(call, sentence: str):
    with pytest.raises(UserError, match=sentence):
        call()


NAN, INF = float("nan"), float("inf")


@pytest.mark.parametrize(
    ("call", "place"),
    [
        (lambda: iqm([1, 2, NAN, 4]), "a score (seed 2) is not a finite number, but nan"),
        (
            lambda: iqm(np.array([[[1.0], [INF]]])),
            "a score (sample 0, seed 1, task 0) is not a finite number, but inf",
        ),
        (lambda: mean([[1.0, 2.0], [3.0, -INF]]), "a score (seed 1, task 1) is not a finite number, but -inf"),
        (lambda: median([NAN, 1.0]), "a score (seed 0) "),
        (lambda: estimate([1.0, NAN]), "a score (seed 1) "),
        (lambda: difference([1.0, 2.0], [NAN, 2.0]), "a score (seed 0) "),
        (lambda: probability_of_improvement([1.0, 2.0], [1.0, INF]), "a score (seed 1) "),
        (lambda: equivalent([NAN, 2.0], [1.0, 2.0], 1.0), "a score (seed 0) "),
        (lambda: equivalent([1.0, 2.0], [1.0, 2.0], INF), "the margin of an equivalence is not"),
        (lambda: performance_profile([1.0, NAN], [0.0]), "a score (seed 1) "),
        (lambda: performance_profile([1.0, 2.0], [0.0, NAN]), "a threshold (number 1) is not"),
        (lambda: sample_efficiency([[1.0, 2.0], [3.0, NAN]]), "a score (seed 1, task 0, evaluation 1) "),
    ],
)
def test_what_is_no_number_is_refused_with_its_place(call, place: str):
    """Sorting takes NaN for the best score, and an interquartile mean would cut it off."""
    with pytest.raises(ValueError) as caught:
        call()
    assert str(caught.value).startswith(place)
    assert isinstance(caught.value, UserError)  # one sentence on the command line


@pytest.mark.parametrize("statistic", [iqm, mean, median])
def test_nothing_has_no_mean(statistic):
    with pytest.raises(UserError, match=r"one at the least, not of shape \[0, 1\]"):
        statistic([])


def test_statistics_load_nothing_that_takes_long():
    """scipy.stats and scipy.optimize take longer to load than most comparisons to compute."""
    code = "import sys, gacrl.evaluation.statistics; print([n for n in ('scipy.stats', 'scipy.optimize') if n in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout.strip() == "[]"
