"""Table III, theirs and ours: what training ended with, and the average agent distance beside it."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np
from jaxtyping import Float

from gacrl.evaluation.statistics import estimate, with_interval
from gacrl.experiments.paper import tables as paper_tables
from gacrl.experiments.paper.claims import Measure, measures
from gacrl.experiments.paper.evidence import COLUMNS, FINAL_EPISODES, Evidence, MissingRun, Play, measured
from gacrl.experiments.paper.tables import SCRIPTED
from gacrl.report.page import Page

SHOWN = ("shaped", "raw", "distance", "coverage_0.1", "coverage_theta", "near", "agents")
"""The measures of the tables."""
_DEFINED = ("shaped", "shaped_fixed", "raw", "distance", "coverage_0.1", "coverage_theta")
"""Those of the paper's own table, with both readings of its first column and of its last."""
_PLAYS: Mapping[Play, str] = MappingProxyType(
    {
        "training": "end of training",
        "sampled": "closing evaluation, sampled",
        "greedy": "closing evaluation, greedy",
    }
)


@dataclass(frozen=True, eq=False)
class Row:
    """What an algorithm's last episodes of training gave, or a scripted policy's at their difficulty."""

    who: str
    column: str
    """What it was trained on; empty for a scripted policy."""
    episodes: int
    """Of each seed."""
    mean: Mapping[str, Float[np.ndarray, " S"]]
    """By measure; a scripted policy counts as one seed."""
    sd: Mapping[str, Float[np.ndarray, " S"]]
    """Over a seed's episodes."""

    def pooled(self, name: str) -> str:
        """Write the mean over the seeds, and the standard deviation of their episodes."""
        return _plus_minus(float(self.mean[name].mean()), float(np.sqrt((self.sd[name] ** 2).mean())))

    def to_dict(self) -> dict[str, Any]:
        """Return it as plain data."""
        numbers = {
            what: {name: [float(f"{value:.6g}") for value in values] for name, values in by_name.items()}
            for what, by_name in (("mean", self.mean), ("sd", self.sd))
        }
        return {"who": self.who, "trained_on": self.column, "episodes": self.episodes, **numbers}


def rows(evidence: Evidence) -> Iterator[Row]:
    """Yield the rows of the trained algorithms, column by column, then those of the scripted policies."""
    weights = {name: measures()[name].weights for name in _DEFINED}
    for (column, who), series in evidence.series.items():
        if column in ("paper", "mpe2"):
            mean, sd, count = series.closing
            spread = {name: abs(weight) * sd[metric] for name, (metric, weight) in _single(weights)}
            yield Row(who, column, count, {name: measured(w, mean) for name, w in weights.items()}, spread)
    for who in SCRIPTED:
        played = evidence.references["paper", who].stretches[-1]
        seen = {name: measured(w, played) for name, w in weights.items()}
        mean = {name: values.mean(keepdims=True) for name, values in seen.items()}
        sd = {name: values.std(keepdims=True) for name, values in seen.items()}
        yield Row(who, "", len(seen["shaped"]), mean, sd)


def _single(weights: Mapping[str, Mapping[str, float]]) -> Iterator[tuple[str, tuple[str, float]]]:
    """Yield the measures with their only metric and its weight: no sd is known of a sum of metrics."""
    for name, of in weights.items():
        (only,) = of.items()
        yield name, only


def table_3(page: Page, evidence: Evidence) -> None:
    """Write Table III as the paper defines it, then with intervals over seeds and the other ways to play."""
    table = paper_tables.printed()["table_3"]
    page.heading(table["caption"])
    _table_3_as_defined(page, evidence)
    for column in ("paper", "mpe2"):
        for play, title in _PLAYS.items():
            cells = [
                [who, *(_interval(evidence, measures()[name], who, play, column) for name in SHOWN)]
                for who in (*table["rows"], *SCRIPTED)
            ]
            page.table(
                ("who", *(measures()[name].label for name in SHOWN)),
                cells,
                f"Trained on {COLUMNS[column]}, {title}: IQM over the seeds [95 % interval]; scripted "
                f"policies: over blocks of {FINAL_EPISODES} episodes",
            )
    page.text(
        "The closing evaluation plays 320 fixed episodes at θ = 0.5 and local ratio 0.5; the end of training has "
        "the difficulty of the last episodes, and exploration."
    )
    _where_agents_leave(page, evidence)


def _where_agents_leave(page: Page, evidence: Evidence) -> None:
    shaped, distance = (
        [
            evidence.values(measures()[name].weights, who, "greedy", "paper").mean()
            for who in ("GACRL", "random", "oracle")
        ]
        for name in ("shaped", "distance")
    )
    if shaped[0] > shaped[2] and distance[0] > distance[1]:
        page.text(
            f"Played greedily, GACRL earns a shaped reward of {shaped[0]:.3g}, beyond the oracle's {shaped[2]:.3g}, "
            f"at a distance of {distance[0]:.3g} from the nearest landmark (random: {distance[1]:.3g}): equation (1) "
            "pays for leaving, and the agents leave. Where this reading makes a claim hold, it holds by that."
        )


def _table_3_as_defined(page: Page, evidence: Evidence) -> None:
    """Write mean ± standard deviation over the last episodes, as the paper has it."""
    found = {(row.who, row.column): row for row in rows(evidence)}
    cells: list[list[str]] = []
    for who, numbers in paper_tables.printed()["table_3"]["rows"].items():
        printed = dict(zip(paper_tables.printed()["table_3"]["columns"], numbers, strict=True))
        cells.append([who, "paper", *(_plus_minus(*printed[measures()[name].printed]) for name in _DEFINED)])
        for column in ("paper", "mpe2"):
            row, whose = found.get((who, column)), f"ours, trained on {COLUMNS[column]}"
            if row is None:
                cells.append([who, whose, *["diverged"] * len(_DEFINED)])
            else:
                whose += f", {row.episodes} episodes a seed"
                cells.append([who, whose, *(row.pooled(name) for name in _DEFINED)])
    for who in SCRIPTED:
        row = found[who, ""]
        cells.append([who, f"{row.episodes} episodes", *(row.pooled(name) for name in _DEFINED)])
    page.table(
        ("who", "whose", *(measures()[name].label for name in _DEFINED)),
        cells,
        "As the paper defines it: mean ± standard deviation over the last episodes of training; ours pooled over "
        "the seeds. Where 15 environments end together, the stretches that hold the last 50 hold some more.",
    )


def agent_distance(page: Page, evidence: Evidence) -> None:
    """Write the average agent distance, which the paper names and does not report."""
    page.heading("The average agent distance, which the paper names and does not report")
    measure = measures()["agents"]
    cells = [
        [
            name,
            *(_interval(evidence, measure, name, play, column) for column in ("paper", "mpe2") for play in _PLAYS),
        ]
        for name in (*paper_tables.printed()["table_3"]["rows"], *SCRIPTED)
    ]
    titles = [f"{COLUMNS[column]}: {title}" for column in ("paper", "mpe2") for title in _PLAYS.values()]
    page.table(("who", *titles), cells)


def interquartile(values: Float[np.ndarray, " S"]) -> str:
    """Write the IQM of the seeds and its interval."""
    return with_interval(estimate(values), ".3g")


def _interval(evidence: Evidence, measure: Measure, who: str, play: Play, column: str) -> str:
    try:
        return interquartile(evidence.values(measure.weights, who, play, column))
    except MissingRun:
        return "diverged"


def _plus_minus(mean: float, sd: float) -> str:
    return f"{mean:.2f} ± {sd:.2f}"
