"""The claims of the paper, and the readings under which each of them is judged (in `verdicts`).

The claims, the readings under which each is repeated, and the paper's numbers are data: `claims.json` and
`paper.json`. No verdict is written there. A reading changes one thing at a time: what a column of the tables
means, which episodes count, or which reward the algorithms were trained on.
"""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from importlib import resources
from types import MappingProxyType
from typing import Any, Literal, TypeAlias

from gacrl.experiments.paper.evidence import FINAL_EPISODES, Play

Agreement: TypeAlias = Literal["agrees", "disagrees", "undecided", "not tested"]
"""Whether our runs agree with what is printed or claimed."""
AGREES: Agreement = "agrees"
DISAGREES: Agreement = "disagrees"
OPEN: Agreement = "undecided"
UNTESTED: Agreement = "not tested"

Chance: TypeAlias = Literal["told from random", "not told from random", "equivalent to random", ""]
"""Whether it could be random's, asked apart from the agreement; empty where random plays no part.

Equivalent is what two one-sided tests within a margin find, and nothing else.
"""
TOLD: Chance = "told from random"
NOT_TOLD: Chance = "not told from random"
EQUIVALENT: Chance = "equivalent to random"
NO_CHANCE: Chance = ""

SENSES: Mapping[str, str] = MappingProxyType(
    {
        "open": "the agents leave the 2 × 2 space: nothing in the environment holds them there",
        "start": "the one value is where the other begins",
    }
)
"""Readings of what the paper says of itself."""


@dataclass(frozen=True)
class Measure:
    """What a column of the paper's tables is read as: a weighted sum of our metrics."""

    label: str
    says: str
    weights: Mapping[str, float]
    better: Literal["higher", "lower"]
    printed: str
    """The column of the paper's tables."""
    least: float = -math.inf
    most: float = math.inf

    @property
    def sign(self) -> float:
        """What makes more of it better."""
        return 1.0 if self.better == "higher" else -1.0


@dataclass(frozen=True)
class Reading:
    """One way to read the paper; the defaults are those of docs/algorithm.md."""

    play: Play = "training"
    column: str = "paper"
    row: Literal["episode", "stretch"] = "episode"
    """A row of Table II is one episode, or the mean of the 50 before it."""
    swap: tuple[str, str] | None = None
    """A measure, and the one that takes its place."""
    sense: str = ""
    """One of `SENSES`."""

    def measure(self, name: str) -> Measure:
        """Return the measure of that name, or its substitute."""
        return measures()[self.swap[1] if self.swap and self.swap[0] == name else name]

    def describe(self) -> str:
        """Return what this reading changes."""
        said = {
            "sampled": "closing evaluation, sampled as in training",
            "greedy": "closing evaluation, greedy",
        }.get(self.play, "")
        if self.column == "mpe2":
            said = "all trained on MPE2's own reward, no curriculum"
        if self.column == "mixed":
            said = "the baselines trained on MPE2's own reward, GACRL on the paper's; closing evaluation, sampled"
        if self.row == "stretch":
            said = f"a row is the mean of {FINAL_EPISODES} episodes"
        if self.swap:
            old, new = (measures()[name] for name in self.swap)
            said = f"{old.label}: {new.says}"
        if self.sense:
            said = SENSES[self.sense]
        return said or "as docs/algorithm.md reads it"


@dataclass(frozen=True)
class Claim:
    """A sentence or row of the paper, and how it is tested."""

    id: str
    section: str
    quote: str
    kind: str
    settings: Mapping[str, Any]
    """What the kind needs, as in `claims.json`."""
    readings: tuple[Reading, ...]
    """The alternatives under which it is repeated."""


@dataclass(frozen=True)
class Outcome:
    """A verdict on both axes under one reading, and the numbers that decide."""

    agreement: Agreement
    chance: Chance
    because: str
    numbers: Mapping[str, Any] = field(default_factory=dict[str, Any])
    """What the sentence is made from, as JSON data: every seed's value."""
    detail: str = ""
    """What of it decides, where there are several numbers: it may change though the verdict does not."""
    caveat: str = ""
    """What must stand wherever the verdict does."""
    reading: Reading = Reading()

    @property
    def verdict(self) -> str:
        """Both axes in words, and what must stand beside them."""
        return "; ".join(part for part in (self.agreement, self.chance, self.caveat) if part)


@dataclass(frozen=True)
class Judged:
    """A claim under every reading."""

    claim: Claim
    base: Outcome
    alternatives: tuple[Outcome, ...]
    in_print: str
    """What the paper's own tables say of it; empty where they do not."""

    @property
    def hangs_on(self) -> tuple[Outcome, ...]:
        """The readings that change the verdict. One that was not tested changes nothing."""
        tested = (outcome for outcome in self.alternatives if outcome.agreement != UNTESTED)
        return tuple(outcome for outcome in tested if outcome.verdict != self.base.verdict)

    @property
    def details(self) -> tuple[Outcome, ...]:
        """The readings that change what decides, and not the verdict."""
        same = (outcome for outcome in self.alternatives if outcome.verdict == self.base.verdict)
        return tuple(outcome for outcome in same if outcome.detail != self.base.detail)


def tests(judged: Sequence[Judged]) -> tuple[tuple[Judged, ...], ...]:
    """Return the claims by the test that they rest on, in the order of the first: several may rest on one."""
    groups: dict[str, list[Judged]] = {}
    for one in judged:
        test = json.dumps([one.claim.kind, dict(one.claim.settings)], sort_keys=True)
        groups.setdefault(test, []).append(one)
    return tuple(tuple(group) for group in groups.values())


@cache
def _data() -> dict[str, Any]:
    return json.loads(
        resources.files("gacrl.experiments.paper").joinpath("claims.json").read_text(encoding="utf-8")
    )


@cache
def measures() -> dict[str, Measure]:
    """Return the readings of the tables' columns."""
    return {name: Measure(**entry) for name, entry in _data()["measures"].items()}


@cache
def claims() -> tuple[Claim, ...]:
    """Return every claim, in the paper's order."""
    return tuple(_claim(entry) for entry in _data()["claims"])


def untrained() -> list[dict[str, str]]:
    """Return the readings that would need other training: {place, setting}."""
    return _data()["untrained"]


def _claim(entry: dict[str, Any]) -> Claim:
    own = ("id", "section", "quote", "kind", "repeat")
    settings = {name: value for name, value in entry.items() if name not in own}
    readings = [_reading(change) for repeat in entry["repeat"] for change in _data()["alternatives"][repeat]]
    return Claim(entry["id"], entry["section"], entry["quote"], entry["kind"], settings, tuple(readings))


def _reading(change: Mapping[str, Any]) -> Reading:
    old, new = change.get("swap", ("", ""))
    reading = Reading(swap=(old, new) if old else None)
    return replace(reading, **{name: value for name, value in change.items() if name != "swap"})
