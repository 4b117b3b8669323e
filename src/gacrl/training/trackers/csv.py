"""`progress.csv` in the run folder: a row for each seed and evaluation, as it is made."""

import csv
from collections.abc import Sequence
from pathlib import Path

from gacrl.config.run import RunConfig
from gacrl.training.recorder import RunFolder
from gacrl.training.trackers.rows import flat
from gacrl.training.trackers.sink import Row, Sink

FILE = "progress.csv"


def begin(folder: RunFolder, config: RunConfig, name: str) -> Sink:
    """Write every evaluation behind those before it; a resumed run writes those past its checkpoint again."""
    path = folder.path / FILE
    columns: list[str] = []

    def rows(evaluation: Sequence[Row]) -> None:
        told = [flat(row) for row in evaluation]
        if not columns:
            columns.extend(told[0])
            _keep_before(path, columns, told[0]["env_steps"])
        with path.open("a", encoding="utf-8", newline="") as file:
            csv.DictWriter(file, columns, extrasaction="ignore", lineterminator="\n").writerows(told)

    return Sink(rows, lambda summary, step: None, lambda path, step: None, lambda: None)


def _keep_before(path: Path, columns: list[str], env_steps: int) -> None:
    """Write the head of the table, and the rows of an older one that come before these steps."""
    kept: list[dict[str, str]] = []
    if path.is_file():
        with path.open(encoding="utf-8", newline="") as file:
            kept = [row for row in csv.DictReader(file) if int(row["env_steps"]) < env_steps]
    with path.open("w", encoding="utf-8", newline="") as file:
        table = csv.DictWriter(file, columns, extrasaction="ignore", lineterminator="\n")
        table.writeheader()
        table.writerows(kept)
