"""The verdicts of a reproduction, as sections of its report and as the data of `results.json`."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from gacrl.experiments.paper.claims import (
    AGREES,
    DISAGREES,
    EQUIVALENT,
    NO_CHANCE,
    NOT_TOLD,
    OPEN,
    TOLD,
    UNTESTED,
    Judged,
    Outcome,
    tests,
    untrained,
)
from gacrl.experiments.paper.references import EPISODES
from gacrl.report.page import Page

Test = Sequence[Judged]
"""The claims that rest on one test; they share their outcomes."""

AS_RANDOM = (NOT_TOLD, EQUIVALENT)
_CHANCES = {TOLD: TOLD, NOT_TOLD: NOT_TOLD, EQUIVALENT: EQUIVALENT, NO_CHANCE: "random plays no part"}


def summary(page: Page, judged: Sequence[Judged]) -> None:
    """Write how many tests came out how, and which."""
    found = tests(judged)
    counts = Counter(test[0].base.agreement for test in found)
    as_random = sum(test[0].base.agreement == AGREES and test[0].base.chance in AS_RANDOM for test in found)
    changed = [test for test in found if test[0].hangs_on]
    other = sum(any(o.agreement != test[0].base.agreement for o in test[0].hangs_on) for test in changed)
    page.text(
        f"The paper's {len(judged)} claims rest on {len(found)} tests. Our runs agree with {counts[AGREES]} of them "
        f"and disagree with {counts[DISAGREES]}; {counts[OPEN]} undecided with these seeds, {counts[UNTESTED]} not "
        f"tested here. Of the {counts[AGREES]} that agree, {as_random} cannot be told from what random does. Some "
        f"other reading of the paper changes {len(changed)} verdicts, and what our runs say in {other} of them."
    )
    page.table(
        ("our runs", *_CHANCES.values()),
        [
            [agreement, *(str(_count(found, agreement, chance)) for chance in _CHANCES)]
            for agreement in (AGREES, DISAGREES, OPEN, UNTESTED)
        ],
        "Tests by what our runs say, and by whether random can be told from the printed numbers or, where GACRL is "
        "ranked or followed, from our GACRL",
    )
    for title, agreements in (
        ("What was reproduced", (AGREES,)),
        ("What was not", (DISAGREES,)),
        ("What is open, or was not tested", (OPEN, UNTESTED)),
    ):
        shown = [test for test in found if test[0].base.agreement in agreements]
        if shown:
            page.heading(title, 3)
            page.table(
                ("where", "the paper", "our runs", "random", "in the paper's own table"),
                [
                    [_places(test), _quotes(test), test[0].base.agreement, test[0].base.chance, test[0].in_print]
                    for test in shown
                ],
            )


def _count(found: Sequence[Test], agreement: str, chance: str) -> int:
    return sum((test[0].base.agreement, test[0].base.chance) == (agreement, chance) for test in found)


def method(page: Page) -> None:
    """Write what the words of the verdicts mean."""
    page.heading("How to read the verdicts")
    page.text(
        '"Agrees": another run like ours may print that number, or our seeds show what is claimed. A printed number is '
        "held against a bootstrap of our seeds and, within a seed, of its episodes. The intervals of a table hold for "
        "all its cells at once (smallest p-value over the cells, Westfall and Young 1993): a table that is truly ours, "
        f"or truly random, has a cell outside in 5 % of cases. Random is played for {EPISODES:,} episodes at every "
        "difficulty."
    )
    page.text(
        '"Told from random": a printed number lies where random prints none, or the 95 % interval of GACRL less random '
        'excludes 0. "Not told" shows no equality. "Equivalent" does: two one-sided tests at 5 % within the margin '
        "that stands beside them, a tenth of the way from random to the oracle. Intervals over seeds are bootstrapped "
        "around the interquartile mean (IQM)."
    )


def every_test(page: Page, judged: Sequence[Judged]) -> None:
    """Write all tests with the numbers that decide, and what other readings change."""
    page.heading("Every test, with its numbers")
    rows = [
        [
            _places(test),
            _quotes(test),
            test[0].base.verdict,
            test[0].base.because,
            _under(test[0].hangs_on, "verdict"),
            _under(test[0].details, "detail"),
        ]
        for test in tests(judged)
    ]
    page.table(("where", "the paper", "verdict", "because", "other readings: verdicts", "only details"), rows)
    page.text(
        "Differences have their 95 % interval over seeds. Detectable: the smallest difference that so many seeds would "
        "show in 80 % of all repetitions; a smaller one may be there without being seen. Every seed's value is in "
        "results.json."
    )


def every_reading(page: Page, judged: Sequence[Judged]) -> None:
    """Write all tests under all readings."""
    page.heading("Every verdict under every reading")
    rows = [
        [test[0].claim.id, outcome.reading.describe(), outcome.verdict, outcome.because]
        for test in tests(judged)
        for outcome in (test[0].base, *test[0].alternatives)
        if test[0].alternatives
    ]
    page.table(("test", "reading", "verdict", "because"), rows)
    page.text("Readings that need other training, and are not trained here; `gacrl train` takes these settings:")
    page.table(("place", "setting"), [[entry["place"], entry["setting"]] for entry in untrained()])


def results(judged: Sequence[Judged]) -> list[dict[str, Any]]:
    """Return every claim as JSON data; those with the same `test` rest on one."""
    named = {id(one): test[0].claim.id for test in tests(judged) for one in test}
    return [
        {
            "id": one.claim.id,
            "section": one.claim.section,
            "quote": one.claim.quote,
            "test": named[id(one)],
            "in_print": one.in_print,
            **_outcome(one.base),
            "readings": [
                {"reading": asdict(o.reading), "says": o.reading.describe(), **_outcome(o)}
                for o in one.alternatives
            ],
        }
        for one in judged
    ]


def _outcome(outcome: Outcome) -> dict[str, Any]:
    return {
        "agreement": outcome.agreement,
        "random": outcome.chance,
        "because": outcome.because,
        "numbers": _plain(outcome.numbers),
    }


def _plain(value: Any) -> Any:
    """Arrays and spans as lists of numbers, to six digits."""
    if isinstance(value, Mapping):
        return {name: _plain(inner) for name, inner in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [_plain(inner) for inner in value]
    return float(f"{value:.6g}") if isinstance(value, float | np.floating) else value


def _places(test: Test) -> str:
    return ", ".join(dict.fromkeys(one.claim.section for one in test))


def _quotes(test: Test) -> str:
    return "; ".join(f"“{one.claim.quote}”" for one in test)


def _under(outcomes: Sequence[Outcome], what: str) -> str:
    """What each reading makes of it; none of them remarkable is said, too."""
    return "; ".join(
        f"{o.reading.describe()} → {getattr(o, what) or 'all cells agree, none told'}" for o in outcomes
    )
