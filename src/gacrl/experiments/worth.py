"""What a part is worth: seeds with it against seeds without, in every metric, and what may be said of it."""

from collections.abc import Mapping
from typing import Literal, NamedTuple, TypeAlias

from gacrl.evaluation.statistics import Difference, Estimate, difference, probability_of_improvement
from gacrl.experiments.results import Finals, Values
from gacrl.tasks.task import Task

Said: TypeAlias = Literal["helps", "costs", "may help", "may cost", ""]

CLAIMED_FROM = 10
"""Seeds. With fewer, an interval of a bootstrap is too narrow, and a difference indicates."""
_SURE = 0.95


class Worth(NamedTuple):
    """A part in one metric."""

    difference: Difference
    """With the part less without it, in the metric's own sign."""
    probability: Estimate
    """That a seed with the part does better than one without."""
    said: Said
    """Helps and costs are claims, for which it takes `CLAIMED_FROM` seeds; what may is indicated. Empty: neither."""


def worths(task: Task, whole: Finals, without: Finals) -> dict[str, Worth]:
    """Compare by every metric that both have."""
    return {metric: _worth(task, metric, whole[metric], without[metric]) for metric in whole if metric in without}


def remarkable(found: Mapping[str, Worth]) -> dict[str, Worth]:
    """Return those of which something may be said."""
    return {metric: worth for metric, worth in found.items() if worth.said}


def _worth(task: Task, metric: str, whole: Values, without: Values) -> Worth:
    sign = task.metric(metric).sign
    probability = probability_of_improvement(sign * whole, sign * without)
    enough = min(len(whole), len(without)) >= CLAIMED_FROM
    said: Said = ""
    if probability.point >= _SURE and probability.low > 0.5:
        said = "helps" if enough else "may help"
    elif probability.point <= 1 - _SURE and probability.high < 0.5:
        said = "costs" if enough else "may cost"
    return Worth(difference(whole, without), probability, said)
