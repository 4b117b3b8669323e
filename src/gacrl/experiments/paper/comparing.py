"""Comparisons of our runs: GACRL beside others and random, and along its training.

An interval is one of 95 %; a difference is one of seeds.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from gacrl.evaluation.statistics import Difference, Estimate, difference, equivalent, estimate
from gacrl.experiments.paper.claims import (
    AGREES,
    DISAGREES,
    EQUIVALENT,
    NO_CHANCE,
    NOT_TOLD,
    OPEN,
    TOLD,
    UNTESTED,
    Agreement,
    Chance,
    Claim,
    Measure,
    Outcome,
    Reading,
    measures,
)
from gacrl.experiments.paper.evidence import Evidence, measured
from gacrl.experiments.paper.tables import SCRIPTED

MARGIN = 0.1
"""Of an equivalence, as a share of the way from random to the oracle."""

Values = Float[np.ndarray, " S"]


def order(claim: Claim, reading: Reading, evidence: Evidence) -> Outcome:
    """Judge whether GACRL is better than some and worse than others, each by more than the seeds explain."""
    better, worse = claim.settings["better_than"], claim.settings.get("worse_than", ())
    found = _Ranking(claim, reading, evidence, [*better, *worse])
    ahead = [found.less[who] for who in better]
    behind = [found.less[who] for who in worse]
    agreement: Agreement = OPEN
    if any(d.high < 0 for d in ahead) or any(d.low > 0 for d in behind):
        agreement = DISAGREES
    elif all(d.low > 0 for d in ahead) and all(d.high < 0 for d in behind):
        agreement = AGREES
    return found.outcome(agreement)


def competitive(claim: Claim, reading: Reading, evidence: Evidence) -> Outcome:
    """Judge whether GACRL is behind nobody by more than the margin, a share of the way from random to the oracle."""
    found = _Ranking(claim, reading, evidence, claim.settings["others"])
    agreement: Agreement = OPEN
    if any(d.high < -found.margin for d in found.less.values()):
        agreement = DISAGREES
    elif all(d.low > -found.margin for d in found.less.values()):
        agreement = AGREES
    return found.outcome(agreement)


def similar(claim: Claim, reading: Reading, evidence: Evidence) -> Outcome:
    """Judge whether GACRL and the others are equivalent: two one-sided tests within the margin."""
    found = _Ranking(claim, reading, evidence, claim.settings["others"])
    tests = {who: equivalent(found.values["GACRL"], found.values[who], found.margin) for who in found.less}
    agreement: Agreement = OPEN
    if all(test.equivalent for test in tests.values()):
        agreement = AGREES
    elif any(d.high < -found.margin or d.low > found.margin for d in found.less.values()):
        agreement = DISAGREES
    said = "; ".join(f"{who} p = {test.p_value:.2g}" for who, test in tests.items())
    return found.outcome(agreement, f"; equivalent within that: {said}")


class _Ranking:
    """GACRL beside others and random in one measure, signed so that more is better."""

    def __init__(self, claim: Claim, reading: Reading, evidence: Evidence, others: Sequence[str]):
        self.measure = reading.measure(claim.settings["measure"])
        self.margin = _margin(claim, self.measure, reading, evidence)
        self.values = {
            who: self.measure.sign * evidence.values(self.measure.weights, who, reading.play, reading.column)
            for who in dict.fromkeys(["GACRL", *others, "random"])
        }
        self.less = {who: difference(self.values["GACRL"], self.values[who]) for who in others}
        self._reading, self._evidence = reading, evidence
        self._trained = set(self.values) - set(SCRIPTED)

    def outcome(self, agreement: Agreement, more: str = "") -> Outcome:
        """Return the verdict, and its numbers in the measure's own sign."""
        chance, random, test = against_random(self.values["GACRL"], self.values["random"], self.margin)
        because = (
            f"{self.measure.label}, GACRL less each: {_listed({**self.less, 'random': random}, self.measure)}, {test}; "
            f"margin {self.margin:.3g}{more}"
        )
        flight = ""
        if agreement == AGREES and self._reading.play == "greedy":
            flight = _flight(self._reading, self._evidence)
        numbers: dict[str, Any] = {"measure": self.measure.label, "margin": self.margin}
        for who, values in self.values.items():
            own = self.measure.sign * values  # of a scripted policy there are hundreds of blocks
            numbers[who] = (
                own if who in self._trained else {"mean": own.mean(), "sd": own.std(), "blocks": len(own)}
            )
        caveat = "only because the agents flee" if flight else ""
        return Outcome(agreement, chance, because + flight, numbers, caveat=caveat)


def _flight(reading: Reading, evidence: Evidence) -> str:
    """What to say where agents have left, for which equation (1) pays."""
    weights = measures()["distance"].weights, {"return_agent_mean": 1.0}
    (own, random), (earned, by_random) = (
        [evidence.values(w, who, reading.play, reading.column) for who in ("GACRL", "random")] for w in weights
    )
    if difference(own, random).low <= 0:
        return ""
    return (
        f"; the agents flee: they are {own.mean():.2g} from the nearest landmark (random "
        f"{random.mean():.2g}) and earn {earned.mean():.0f} of MPE2's reward an episode (random {by_random.mean():.0f})"
    )


def trend(claim: Claim, reading: Reading, evidence: Evidence) -> Outcome:
    """Return the change from a point of training to its end; and less the change of random, which the difficulty makes.

    "Not worse" is meant despite the difficulty: it is asked of the latter.
    """
    measure, direction = reading.measure(claim.settings["measure"]), claim.settings["direction"]
    series, random = evidence.trained(reading.column, "GACRL"), evidence.reference(reading.column, "random")
    values = measured(measure.weights, series.mean)
    first = int(claim.settings["from"] * values.shape[1])
    if first == values.shape[1] - 1:
        return Outcome(UNTESTED, NO_CHANCE, "these runs have a single stretch of episodes")
    ends = [measured(measure.weights, random.stretches[k]).mean() for k in (first, -1)]
    drift, change = ends[1] - ends[0], values[:, -1] - values[:, first]
    margin = _margin(claim, measure, reading, evidence)
    beyond = measure.sign * (change - drift)
    chance, _, test = against_random(beyond, np.zeros_like(beyond), margin)
    because = (
        f"{measure.label}, episodes up to {series.episodes[first]} to those up to {series.episodes[-1]}: "
        f"{values[:, first].mean():.3g} to {values[:, -1].mean():.3g}, {_estimate(estimate(change))}; random's change "
        f"{drift:+.3g}; better than that by {_estimate(estimate(beyond))}, {test}; margin {margin:.3g}"
    )
    numbers = {"first": values[:, first], "last": values[:, -1], "random": ends, "margin": margin}
    agreement = _moves(beyond if direction == "not worse" else measure.sign * change, direction, margin)
    return Outcome(agreement, chance, because, {"measure": measure.label, **numbers})


def _moves(change: Values, direction: str, margin: float) -> Agreement:
    """Whether a change goes the way that is said: no change is none by an equivalence test within the margin."""
    found = estimate(change)
    if direction == "not worse":
        return AGREES if found.low > -margin else DISAGREES if found.high < -margin else OPEN
    low, high = (-found.high, -found.low) if direction == "worse" else (found.low, found.high)
    if low > 0:
        return AGREES
    none = equivalent(change, np.zeros_like(change), margin).equivalent
    return DISAGREES if high < 0 or none else OPEN


# What both need


def against_random(
    own: Values, random: Float[np.ndarray, " blocks"], margin: float
) -> tuple[Chance, Difference, str]:
    """Return whether values of ours can be told from random's, their difference, and what the equivalence test says."""
    found, test = difference(own, random), equivalent(own, random, margin)
    told = found.low > 0 or found.high < 0
    chance = TOLD if told else EQUIVALENT if test.equivalent else NOT_TOLD
    return chance, found, f"equivalence p = {test.p_value:.2g}"


def _margin(claim: Claim, measure: Measure, reading: Reading, evidence: Evidence) -> float:
    random, oracle = (
        evidence.values(measure.weights, who, reading.play, reading.column).mean() for who in ("random", "oracle")
    )
    return float(claim.settings.get("margin", MARGIN) * abs(oracle - random))


def _estimate(change: Estimate) -> str:
    return f"{change.point:+.3g} [{change.low:.3g}, {change.high:.3g}]"


def _listed(differences: Mapping[str, Difference], measure: Measure) -> str:
    """Each difference in the measure's own sign."""
    said: list[str] = []
    for who, d in differences.items():
        low, high = sorted((measure.sign * d.low, measure.sign * d.high))
        said.append(f"{who} {measure.sign * d.point:+.3g} [{low:.3g}, {high:.3g}], detectable {d.detectable:.2g}")
    return "; ".join(said)
