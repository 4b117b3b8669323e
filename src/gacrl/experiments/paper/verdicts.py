"""Judging the claims: a few kinds of comparison, each a function of claim, reading and evidence.

Each answers two questions apart: do our runs agree, and can random be told from it?
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import jax.numpy as jnp
import numpy as np

from gacrl.experiments.paper import tables as paper_tables
from gacrl.experiments.paper.claims import (
    AGREES,
    DISAGREES,
    NO_CHANCE,
    UNTESTED,
    Claim,
    Judged,
    Outcome,
    Reading,
    claims,
    measures,
)
from gacrl.experiments.paper.comparing import competitive, order, similar, trend
from gacrl.experiments.paper.evidence import Evidence, MissingRun
from gacrl.experiments.paper.printed import peak, value
from gacrl.experiments.paper.spans import ROUNDING
from gacrl.tasks.spread.shaping import paper_shaped_reward


def judge_all(evidence: Evidence) -> tuple[Judged, ...]:
    """Judge every claim under every reading."""
    return tuple(judge(claim, evidence) for claim in claims())


def judge(claim: Claim, evidence: Evidence) -> Judged:
    """Judge one claim under every reading."""

    def under(reading: Reading) -> Outcome:
        try:
            outcome = KINDS[claim.kind](claim, reading, evidence)
        except MissingRun as missing:
            outcome = Outcome(UNTESTED, NO_CHANCE, str(missing))
        return replace(outcome, reading=reading)

    return Judged(claim, under(Reading()), tuple(under(reading) for reading in claim.readings), in_print(claim))


def in_print(claim: Claim) -> str:
    """Return whether an order among the four algorithms is there in the paper's own Table III."""
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


def possible(claim: Claim, reading: Reading, evidence: Evidence) -> Outcome:
    """Return whether a row's raw reward can go with its coverage: whoever is not covered is at least the radius
    away.
    """
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
        said = "; ".join(impossible)
        return Outcome(DISAGREES, NO_CHANCE, f"raw rewards that no positions give: {said}", detail=said)
    return Outcome(AGREES, NO_CHANCE, "all rows are possible")


def formula(claim: Claim, reading: Reading, evidence: Evidence) -> Outcome:
    """Compute equation (1), without r_raw and collisions: it pays nobody more than who stands on a landmark.

    Inside the paper's space of 2 × 2 no landmark is further away than from corner to corner.
    """
    far, theta = float(claim.settings[reading.sense or "inside"]), float(claim.settings["theta"])
    distances = np.linspace(0.0, far, 501)
    alone = jnp.full((1, len(distances)), jnp.inf)
    paid = np.asarray(paper_shaped_reward(jnp.zeros(len(distances)), jnp.asarray(distances)[None], alone, theta))
    best = distances[paid.argmax()]
    because = (
        f"equation (1) pays an agent {paid[0]:.2f} on a landmark and {paid[-1]:.2f} at distance {far:.2f}; up to there "
        f"it pays most at {best:.2f} and least at {distances[paid.argmin()]:.2f} (θ = {theta:g})"
    )
    return Outcome(AGREES if best == 0.0 else DISAGREES, NO_CHANCE, because)


def stated_once(claim: Claim, reading: Reading, evidence: Evidence) -> Outcome:
    """Judge whether a setting that the paper states in several places is the same in all."""
    stated: Mapping[str, Sequence[float]] = claim.settings["stated"]
    because = "; ".join(f"{place}: {start:g} to {end:g}" for place, (start, end) in stated.items())
    compared = 1 if reading.sense == "start" else 2
    same = len({tuple(values[:compared]) for values in stated.values()}) == 1
    return Outcome(AGREES if same else DISAGREES, NO_CHANCE, f"stated as {because}")


def duration(claim: Claim, reading: Reading, evidence: Evidence) -> Outcome:
    """Return how long one run takes here: other hardware tests no printed hours."""
    series = evidence.trained("paper", "GACRL")
    full = series.config.curriculum.episodes
    hours = series.seconds / 3600 / len(series.config.seeds) * full / int(series.episodes[-1])
    because = (
        f"there is no {claim.settings['on']} here; on this machine {60 * hours:.2g} minutes a seed for {full} "
        f"episodes, printed {claim.settings['hours']:g} hours"
    )
    return Outcome(UNTESTED, NO_CHANCE, because)


def elsewhere(claim: Claim, reading: Reading, evidence: Evidence) -> Outcome:
    """Return what this experiment does not decide."""
    return Outcome(UNTESTED, NO_CHANCE, claim.settings["reason"])


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
