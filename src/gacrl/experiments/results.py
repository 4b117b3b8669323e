"""What a finished run of a study came to, read in one place: S seeds, P evaluations along training."""

import json
from collections.abc import Generator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from gacrl.config.run import RunConfig
from gacrl.errors import UserError
from gacrl.training.recorder import RunFolder

Values: TypeAlias = NDArray[np.float64]
Finals: TypeAlias = Mapping[str, Values]
"""Per metric: each seed's value [S]."""


@dataclass(frozen=True)
class Results:
    """The files of a run that was trained to its end."""

    summary: Mapping[str, Any]
    rows: list[list[dict[str, Any]]]
    """Of `metrics.jsonl`: each seed's evaluations [S][P]."""

    @property
    def evaluated_at(self) -> tuple[int, ...]:
        """Environment steps at each evaluation [P]."""
        return tuple(sorted({row["env_steps"] for seed in self.rows for row in seed}))

    def along(self, part: str, name: str) -> Values:
        """Return a number along training [S, P]. part: of a row, such as greedy or update."""
        return np.array([[row[part][name] for row in seed] for seed in self.rows])

    def final(self, play: str = "greedy") -> dict[str, Values]:
        """Return the metrics of the closing evaluation [S], last parameters, without the scores made from them."""
        metrics = self.summary["final"][play]
        return {
            name: np.array(entry["values"]) for name, entry in metrics.items() if not name.startswith("score_")
        }


@contextmanager
def reading(folder: Path) -> Generator[None]:
    """Raise UserError where what is read from a run of a study turns out to be damaged."""
    try:
        yield
    except (KeyError, IndexError, TypeError, ValueError, RecursionError, OSError) as error:
        what = " ".join(f"{type(error).__name__}: {error}".split())
        raise UserError(f"{folder} is damaged ({what}): remove that folder to train the run again") from error


def read(folder: Path, planned: RunConfig) -> Results:
    """Read a run that was trained to its end; call it within `reading`.

    Raises ValueError where a seed that was planned, or a value of it, is missing.
    """
    run, seeds = RunFolder.open(folder), list(planned.seeds)
    summary = json.loads(run.summary_file.read_text(encoding="utf-8"))
    if summary["seeds"] != seeds:
        raise ValueError(f"it holds seeds {summary['seeds']}, not {seeds}")
    for metrics in summary["final"].values():
        for metric, entry in metrics.items():
            if metric.startswith("score_"):
                continue
            if len(entry["values"]) != len(seeds) or not np.isfinite(entry["values"]).all():
                raise ValueError(f"a seed of {seeds} lacks a value of {metric}")
    rows = run.metrics()
    return Results(summary, [[row for row in rows if row["seed"] == seed] for seed in seeds])


def why_diverged(folder: Path) -> str | None:
    """Return why the run in that folder diverged; None for one that did not."""
    return RunFolder(folder).why_diverged()
