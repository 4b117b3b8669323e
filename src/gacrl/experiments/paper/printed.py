"""Printed numbers against where another run of ours would print, and against where random would."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from gacrl.experiments.paper import tables as paper_tables
from gacrl.experiments.paper.claims import (
    AGREES,
    DISAGREES,
    NO_CHANCE,
    NOT_TOLD,
    OPEN,
    TOLD,
    UNTESTED,
    Agreement,
    Claim,
    Measure,
    Outcome,
    Reading,
    measures,
)
from gacrl.experiments.paper.evidence import Evidence, measured
from gacrl.experiments.paper.spans import (
    ROUNDING,
    Row,
    Span,
    best_of_ours,
    best_of_random,
    inside,
    table_spans,
)

WIDE = 3.0
"""Our interval decides nothing where it is so many times as wide as random's: any number would be in it."""

Values = Float[np.ndarray, " S"]

Printed = Mapping[str, tuple[Row, tuple[float, ...]]]
"""Rows of a table and their numbers, under what a claim calls them."""


def value(claim: Claim, reading: Reading, evidence: Evidence) -> Outcome:
    """Hold printed numbers against what another run of ours would print, and against what random would.

    The intervals hold for all the table's cells at once; those of a claim that names its own cells, for these.
    """
    table = _table(claim, reading, evidence)
    own = str(claim.settings.get("row_of", claim.settings.get("episode", "")))
    if own and own not in table:
        return Outcome(UNTESTED, NO_CHANCE, f"these runs did not log episode {own}")
    asked = [own] if own else list(table)
    for name in asked:
        evidence.trained(reading.column, table[name][0].who)
    there = [name for name, (row, _) in table.items() if evidence.has(reading.column, row.who)]
    spans = dict(zip(there, table_spans(tuple(table[name][0] for name in there), reading, evidence), strict=True))
    cells = [
        _Cell(
            row.who,
            reading.measure(measure),
            number,
            ours,
            random,
            _seeds(row, measure, reading, evidence),
            column=measures()[measure].label,
        )
        for name, (row, numbers) in table.items()
        if name in asked
        for measure, number, ours, random in zip(row.measures, numbers, *spans[name], strict=True)
    ]
    at_once = sum(len(table[name][1]) for name in there)
    return Outcome(
        next(it for it in (DISAGREES, OPEN, AGREES) if any(cell.agreement == it for cell in cells)),
        TOLD if any(cell.told for cell in cells) else NOT_TOLD,
        "; ".join(map(str, cells)) + f" (95 % for {at_once} cell{'s at once' if at_once > 1 else ''})",
        {"cells": [cell.to_dict() for cell in cells]},
        ", ".join(cell.detail for cell in cells if cell.detail),
    )


def _table(claim: Claim, reading: Reading, evidence: Evidence) -> Printed:
    """The table that a claim's row is in, as far as our runs logged it; or the claim's own cells."""
    tables = paper_tables.printed()
    names = {measure.printed: name for name, measure in reversed(measures().items())}
    if "row_of" in claim.settings:
        columns = tuple(names[column] for column in tables["table_3"]["columns"])
        rows = tables["table_3"]["rows"]
        return {who: (Row(who, None, columns), tuple(mean for mean, _ in rows[who])) for who in rows}
    if "episode" in claim.settings:
        names |= {"coverage": "coverage_theta"}
        columns = tuple(names[column] for column in tables["table_2"]["columns"])
        logged = {str(n): k for k, n in enumerate(evidence.trained(reading.column, "GACRL").episodes)}
        rows = tables["table_2"]["rows"]
        return {n: (Row("GACRL", logged[n], columns), tuple(rows[n])) for n in rows if n in logged}
    cells: Sequence[tuple[str, str, float]] = claim.settings["cells"]
    return {who: (Row(who, None, (name,)), (float(number),)) for who, name, number in cells}


def _seeds(row: Row, name: str, reading: Reading, evidence: Evidence) -> Values:
    """What each of our seeds has in a cell."""
    weights = reading.measure(name).weights
    if row.stretch is None:
        return evidence.values(weights, row.who, reading.play, reading.column)
    series = evidence.trained(reading.column, row.who)
    return measured(weights, series.last if reading.row == "episode" else series.mean)[:, row.stretch]


class _Cell:
    """One printed number, and where it would lie."""

    def __init__(
        self,
        who: str,
        measure: Measure,
        printed: float,
        ours: Span,
        random: Span,
        seeds: Values,
        column: str = "",
    ):
        self.who, self.label, self.printed, self.ours, self.random = who, measure.label, printed, ours, random
        self.seeds = seeds
        self.column = column  # as it is called under any reading
        self.told = not inside(printed, random)
        wide = ours[1] - ours[0] > WIDE * (random[1] - random[0] + 2 * ROUNDING)
        self.agreement: Agreement = DISAGREES if not inside(printed, ours) else OPEN if wide else AGREES

    @property
    def detail(self) -> str:
        """What is remarkable about it."""
        remarks = [self.agreement] * (self.agreement != AGREES) + [TOLD] * self.told
        return f"{self.who} {self.column} {' and '.join(remarks)}" if remarks else ""

    def __str__(self) -> str:
        ours, random = (f"[{low:.3g}, {high:.3g}]" for low, high in (self.ours, self.random))
        places = ("in neither", "in random's", "in ours", "in both")
        place = places[2 * inside(self.printed, self.ours) + (not self.told)]
        return f"{self.who} {self.label} {self.printed:g}: ours {ours}, random {random}, {place}"

    def to_dict(self) -> dict[str, Any]:
        return {
            "who": self.who,
            "measure": self.label,
            "printed": self.printed,
            "seeds": self.seeds,
            "ours": self.ours,
            "random": self.random,
        }


def peak(claim: Claim, reading: Reading, evidence: Evidence) -> Outcome:
    """Return a printed best of the log against the best of as many log lines of ours, and of random."""
    measure, printed = reading.measure(claim.settings["measure"]), float(claim.settings["printed"])
    series = evidence.trained(reading.column, "GACRL")
    logged = measured(measure.weights, series.last if reading.row == "episode" else series.mean)
    cell = _Cell(
        f"best of {logged.shape[1]} lines,",
        measure,
        printed,
        best_of_ours(measure, reading, evidence),
        best_of_random(measure, reading, evidence),
        (measure.sign * logged).max(1) * measure.sign,
    )
    because, episode = str(cell), claim.settings["episode"]
    if str(episode) not in paper_tables.printed()["table_2"]["rows"]:
        because += f"; episode {episode} is not in Table II"
    return Outcome(cell.agreement, TOLD if cell.told else NOT_TOLD, because, {"cells": [cell.to_dict()]})
