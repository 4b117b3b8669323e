"""Judging the claims: a few kinds of comparison, each a function of claim, reading and evidence.

Each returns a verdict and the numbers that decide it. An interval is one of 95 %; a difference is one of seeds.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import TypeAlias

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy import stats

from gacrl.evaluation.statistics import Difference, difference, equivalent, estimate
from gacrl.experiments.paper import tables as paper_tables
from gacrl.experiments.paper.claims import (
    AS_RANDOM,
    FAILS,
    HOLDS,
    IRREPRODUCIBLE,
    OPEN,
    UNTESTED,
    Claim,
    Judged,
    Measure,
    Outcome,
    Reading,
    Verdict,
    claims,
    measures,
)
from gacrl.experiments.paper.evidence import FINAL_EPISODES, Evidence, MissingRun, measured
from gacrl.tasks.spread.shaping import paper_shaped_reward

Span: TypeAlias = tuple[float, float]

ROUNDING = 0.005
"""The tables print two decimals."""
RESAMPLES = 2_000


def judge_all(evidence: Evidence) -> tuple[Judged, ...]:
    """Every claim under every reading."""
    return tuple(judge(claim, evidence) for claim in claims())


def judge(claim: Claim, evidence: Evidence) -> Judged:
    """One claim under every reading."""

    def under(reading: Reading) -> Outcome:
        try:
            outcome = KINDS[claim.kind](claim, reading, evidence)
        except MissingRun as missing:
            outcome = Outcome(IRREPRODUCIBLE, str(missing))
        return replace(outcome, reading=reading)

    return Judged(claim, under(Reading()), tuple(under(reading) for reading in claim.readings), in_print(claim))


def in_print(claim: Claim) -> str:
    """Whether an order among the four algorithms is there in the paper's own Table III."""
    table = paper_tables.printed()["table_3"]
    others = [*claim.settings.get("better_than", ()), *claim.settings.get("worse_than", ())]
    if claim.kind != "order" or not set(others) <= set(table["rows"]):
        return ""
    measure = measures()[claim.settings["measure"]]
    place = table["columns"].index(measure.printed)
    printed = {who: measure.sign * row[place][0] for who, row in table["rows"].items()}
    shown = all(printed["GACRL"] > printed[who] for who in claim.settings["better_than"])
    shown &= all(printed["GACRL"] < printed[who] for who in claim.settings.get("worse_than", ()))
    rank = 1 + sum(value > printed["GACRL"] for value in printed.values())
    return f"{'yes' if shown else 'no'}: GACRL is number {rank} of {len(printed)} in Table III"


def order(claim: Claim, reading: Reading, evidence: Evidence) -> Outcome:
    """GACRL is better than some and worse than others, each by more than the seeds explain."""
    measure = reading.measure(claim.settings["measure"])
    better = _differences(measure, claim.settings["better_than"], reading, evidence)
    worse = _differences(measure, claim.settings.get("worse_than", ()), reading, evidence)
    random = _differences(measure, ["random"], reading, evidence)["random"]
    because = f"{measure.label}, GACRL less each: {_listed(better | worse | {'random': random}, measure)}"
    if any(d.high < 0 for d in better.values()) or any(d.low > 0 for d in worse.values()):
        return Outcome(FAILS, because)
    if all(d.low > 0 for d in better.values()) and all(d.high < 0 for d in worse.values()):
        return Outcome(HOLDS, because)
    return Outcome(AS_RANDOM if random.low <= 0 <= random.high else OPEN, because)


def competitive(claim: Claim, reading: Reading, evidence: Evidence) -> Outcome:
    """GACRL is behind nobody by more than the margin, a share of the way from random to the oracle."""
    measure = reading.measure(claim.settings["measure"])
    margin = _margin(claim, measure, reading, evidence)
    others = _differences(measure, claim.settings["others"], reading, evidence)
    random = _differences(measure, ["random"], reading, evidence)["random"]
    because = (
        f"{measure.label}, GACRL less each: {_listed(others | {'random': random}, measure)}; margin {margin:.3g}"
    )
    if any(d.high < -margin for d in others.values()):
        return Outcome(FAILS, because)
    if random.low <= 0 <= random.high:
        return Outcome(AS_RANDOM, because)
    return Outcome(HOLDS if all(d.low > -margin for d in others.values()) else OPEN, because)


def similar(claim: Claim, reading: Reading, evidence: Evidence) -> Outcome:
    """GACRL and the others are equivalent: two one-sided tests within the margin."""
    measure = reading.measure(claim.settings["measure"])
    margin = _margin(claim, measure, reading, evidence)
    own = evidence.values(measure.weights, "GACRL", reading.play, reading.column)
    tests = {
        who: equivalent(own, evidence.values(measure.weights, who, reading.play, reading.column), margin)
        for who in claim.settings["others"]
    }
    apart = _differences(measure, claim.settings["others"], reading, evidence)
    because = f"{measure.label}, margin {margin:.3g}: " + "; ".join(
        f"{who} {test.point:+.3g}, p = {test.p_value:.2g}" for who, test in tests.items()
    )
    if all(test.equivalent for test in tests.values()):
        return Outcome(HOLDS, because)
    beyond = any(d.high < -margin or d.low > margin for d in apart.values())
    return Outcome(FAILS if beyond else OPEN, because)


def value(claim: Claim, reading: Reading, evidence: Evidence) -> Outcome:
    """Printed numbers against what another seed of ours would give, and against what random gives."""
    episode, stretch = claim.settings.get("episode"), None
    if episode is not None:
        found = np.flatnonzero(evidence.trained(reading.column, "GACRL").episodes == episode)
        if not len(found):
            return Outcome(UNTESTED, f"these runs did not log episode {episode}")
        stretch = int(found[0])
    verdicts: list[Verdict] = []
    said: list[str] = []
    for who, name, printed in _cells(claim, reading):
        measure = reading.measure(name)
        ours, random = _expected(measure, who, stretch, reading, evidence)
        as_random, as_ours = _inside(printed, random), _inside(printed, ours)
        verdicts.append(_printed(printed, ours, random))
        place = "in both" if as_random and as_ours else "in random's" if as_random else "in neither"
        place = "in ours" if as_ours and not as_random else place
        said.append(f"{who} {measure.label} {printed:g}: ours {_span(ours)}, random {_span(random)}, {place}")
    weakest: tuple[Verdict, ...] = (IRREPRODUCIBLE, OPEN, HOLDS, AS_RANDOM)
    return Outcome(next(it for it in weakest if it in verdicts), "; ".join(said))


def peak(claim: Claim, reading: Reading, evidence: Evidence) -> Outcome:
    """A printed best of the log against the best of as many log lines of random, and of ours."""
    measure, printed = reading.measure(claim.settings["measure"]), float(claim.settings["printed"])
    series = evidence.trained(reading.column, "GACRL")
    logged = measured(measure.weights, series.last if reading.row == "episode" else series.mean)
    best = (measure.sign * logged).max(1) * measure.sign
    ours = _next_run(best)
    random = best_of_random(measure, reading, evidence)
    lines = logged.shape[1]
    because = (
        f"best of {lines} lines, {measure.label}: printed {printed:g}, random {_span(random)}, ours {_span(ours)}"
    )
    episode = claim.settings["episode"]
    if str(episode) not in paper_tables.printed()["table_2"]["rows"]:
        because += f"; episode {episode} is not in Table II"
    return Outcome(_printed(printed, ours, random), because)


def trend(claim: Claim, reading: Reading, evidence: Evidence) -> Outcome:
    """The change from a point of training to its end, less the change of random, which the difficulty makes."""
    measure, direction = reading.measure(claim.settings["measure"]), claim.settings["direction"]
    series, random = evidence.trained(reading.column, "GACRL"), evidence.reference(reading.column, "random")
    values = measured(measure.weights, series.mean)
    first = int(claim.settings["from"] * values.shape[1])
    if first == values.shape[1] - 1:
        return Outcome(UNTESTED, "these runs have a single stretch of episodes")
    drift = measured(measure.weights, random.stretches[-1]) - measured(measure.weights, random.stretches[first])
    change = estimate(measure.sign * (values[:, -1] - values[:, first] - drift.mean()))
    margin = _margin(claim, measure, reading, evidence) if "margin" in claim.settings else 0.0
    because = (
        f"{measure.label}, episodes up to {series.episodes[first]} to those up to {series.episodes[-1]}: "
        f"{values[:, first].mean():.3g} to {values[:, -1].mean():.3g}, random's change {drift.mean():+.3g}; "
        f"better by {_estimate(change)} than that"
    )
    low, high = (-change.high, -change.low) if direction == "worse" else (change.low, change.high)
    if direction == "not worse":
        because += f", margin {margin:.3g}"
        return Outcome(HOLDS if low > -margin else FAILS if high < -margin else OPEN, because)
    return Outcome(HOLDS if low > 0 else FAILS if high < 0 else AS_RANDOM, because)


def possible(claim: Claim, reading: Reading, evidence: Evidence) -> Outcome:
    """Whether a row's raw reward can go with its coverage: whoever is not covered is at least the radius away."""
    table = paper_tables.printed()["table_2"]
    ratio, agents = float(claim.settings["local_ratio"]), 3
    curriculum = evidence.trained("paper", "GACRL").config
    within_theta = reading.measure(claim.settings["measure"]) is measures()["coverage_theta"]
    impossible: list[str] = []
    for episode, row in table["rows"].items():
        raw, coverage = row[table["columns"].index("reward_raw")], row[table["columns"].index("coverage")]
        progress = min(int(episode) / curriculum.curriculum.episodes, 1.0)
        start, end = curriculum.env.coverage_threshold, curriculum.env.coverage_threshold_end or 0.0
        radius = start + progress * (end - start) if within_theta else 0.1
        most = -(1 - ratio) * agents * (1 - coverage - ROUNDING) * radius
        if raw - ROUNDING > most:
            impossible.append(f"episode {episode}: at most {most:.2f}, printed {raw:g}")
    if impossible:
        return Outcome(IRREPRODUCIBLE, "raw rewards that no positions give: " + "; ".join(impossible))
    return Outcome(HOLDS, "all rows are possible")


def formula(claim: Claim, reading: Reading, evidence: Evidence) -> Outcome:
    """Equation (1), without r_raw and collisions, on a landmark and far away."""
    near, far = (
        float(
            paper_shaped_reward(
                jnp.zeros(()),
                jnp.full(1, claim.settings[place]),
                jnp.full(1, jnp.inf),
                claim.settings["theta"],
            )
        )
        for place in ("near", "far")
    )
    because = (
        f"equation (1) pays an agent {near:.2f} at distance {claim.settings['near']:g} and {far:.2f} at "
        f"distance {claim.settings['far']:g} (θ = {claim.settings['theta']:g})"
    )
    return Outcome(HOLDS if near > far else FAILS, because)


def stated_once(claim: Claim, reading: Reading, evidence: Evidence) -> Outcome:
    """A setting that the paper states in several places is the same in all."""
    stated: Mapping[str, Sequence[float]] = claim.settings["stated"]
    because = "; ".join(f"{place}: {start:g} to {end:g}" for place, (start, end) in stated.items())
    same = len({tuple(values) for values in stated.values()}) == 1
    return Outcome(HOLDS if same else FAILS, f"stated as {because}")


def duration(claim: Claim, reading: Reading, evidence: Evidence) -> Outcome:
    """How long one run takes, against the printed hours; another machine, so that a factor of two is alike."""
    series = evidence.trained("paper", "GACRL")
    episodes = int(series.episodes[-1])
    full = series.config.curriculum.episodes
    hours = series.seconds / 3600 / len(series.config.seeds) * full / episodes
    printed = claim.settings["hours"]
    because = f"here {60 * hours:.2g} minutes a seed for {full} episodes; printed {printed:g} hours"
    return Outcome(HOLDS if 0.5 < hours / printed < 2 else IRREPRODUCIBLE, because)


def elsewhere(claim: Claim, reading: Reading, evidence: Evidence) -> Outcome:
    """What this experiment does not decide."""
    return Outcome(UNTESTED, claim.settings["reason"])


KINDS: Mapping[str, Callable[[Claim, Reading, Evidence], Outcome]] = {
    "order": order,
    "competitive": competitive,
    "similar": similar,
    "value": value,
    "peak": peak,
    "trend": trend,
    "possible": possible,
    "formula": formula,
    "stated_once": stated_once,
    "duration": duration,
    "elsewhere": elsewhere,
}


def best_of_random(measure: Measure, reading: Reading, evidence: Evidence) -> Span:
    """95 % interval of the best that a random policy shows in as many log lines, at each line's difficulty."""
    rng = np.random.default_rng(0)
    stretches = evidence.reference(reading.column, "random").stretches
    size = 1 if reading.row == "episode" else FINAL_EPISODES
    drawn = [
        rng.choice(measure.sign * measured(measure.weights, metrics), (RESAMPLES, size)).mean(1)
        for metrics in stretches
    ]
    low, high = np.percentile(np.max(drawn, axis=0) * measure.sign, [2.5, 97.5])
    return float(low), float(high)


def random_interval(episodes: Float[np.ndarray, " E"], size: int) -> Span:
    """Where 95 % of the means of so many episodes lie."""
    drawn = np.random.default_rng(0).choice(episodes, (RESAMPLES, size)).mean(1)
    low, high = np.percentile(drawn, [2.5, 97.5])
    return float(low), float(high)


def _cells(claim: Claim, reading: Reading) -> list[tuple[str, str, float]]:
    """(who, measure, printed number): the claim's own, or a whole row of a table."""
    tables = paper_tables.printed()
    names = {measure.printed: name for name, measure in reversed(measures().items())}
    if "row_of" in claim.settings:
        who = claim.settings["row_of"]
        means = [mean for mean, _ in tables["table_3"]["rows"][who]]
        return [(who, names[c], mean) for c, mean in zip(tables["table_3"]["columns"], means, strict=True)]
    if "episode" in claim.settings:
        names |= {"coverage": "coverage_theta"}
        row = tables["table_2"]["rows"][str(claim.settings["episode"])]
        return [("GACRL", names[c], number) for c, number in zip(tables["table_2"]["columns"], row, strict=True)]
    return [(who, name, float(number)) for who, name, number in claim.settings["cells"]]


def _expected(
    measure: Measure, who: str, stretch: int | None, reading: Reading, evidence: Evidence
) -> tuple[Span, Span]:
    """Where another seed of ours, and random, would lie with 95 %: at the end, or in one stretch of training."""
    reference = evidence.reference(reading.column, "random")
    if stretch is None:
        ours = evidence.values(measure.weights, who, reading.play, reading.column)
        metrics = reference.stretches[-1] if reading.play == "training" else reference.final
        return _next_run(ours), random_interval(measured(measure.weights, metrics), FINAL_EPISODES)
    series = evidence.trained(reading.column, who)
    logged = series.last if reading.row == "episode" else series.mean
    size = 1 if reading.row == "episode" else FINAL_EPISODES
    random = random_interval(measured(measure.weights, reference.stretches[stretch]), size)
    return _next_run(measured(measure.weights, logged)[:, stretch]), random


def _printed(number: float, ours: Span, random: Span) -> Verdict:
    """A printed number's verdict; ours decides nothing where it has all of random's interval in it."""
    if _inside(number, random):
        return AS_RANDOM
    if not _inside(number, ours):
        return IRREPRODUCIBLE
    return OPEN if ours[0] <= random[0] and random[1] <= ours[1] else HOLDS


def _next_run(values: Float[np.ndarray, " S"]) -> Span:
    """95 % prediction interval of one more seed."""
    half = stats.t.ppf(0.975, len(values) - 1) * values.std(ddof=1) * np.sqrt(1 + 1 / len(values))
    return float(values.mean() - half), float(values.mean() + half)


def _differences(
    measure: Measure, others: Sequence[str], reading: Reading, evidence: Evidence
) -> dict[str, Difference]:
    """GACRL less each of the others, signed so that more is better."""

    def values(who: str) -> Float[np.ndarray, " S"]:
        return measure.sign * evidence.values(measure.weights, who, reading.play, reading.column)

    return {who: difference(values("GACRL"), values(who)) for who in others}


def _margin(claim: Claim, measure: Measure, reading: Reading, evidence: Evidence) -> float:
    random, oracle = (
        evidence.values(measure.weights, who, reading.play, reading.column).mean() for who in ("random", "oracle")
    )
    return float(claim.settings["margin"] * abs(oracle - random))


def _inside(printed: float, span: Span) -> bool:
    return span[0] - ROUNDING <= printed <= span[1] + ROUNDING


def _span(span: Span) -> str:
    return f"[{span[0]:.3g}, {span[1]:.3g}]"


def _estimate(change: tuple[float, float, float]) -> str:
    return f"{change[0]:+.3g} [{change[1]:.3g}, {change[2]:.3g}]"


def _listed(differences: Mapping[str, Difference], measure: Measure) -> str:
    """Each difference in the measure's own sign."""
    said: list[str] = []
    for who, d in differences.items():
        low, high = sorted((measure.sign * d.low, measure.sign * d.high))
        said.append(f"{who} {measure.sign * d.point:+.3g} [{low:.3g}, {high:.3g}], detectable {d.detectable:.2g}")
    return "; ".join(said)
