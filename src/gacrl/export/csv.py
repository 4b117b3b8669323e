"""The numbers of a run as a table: every evaluation of every seed is a row."""

import csv
import io
from collections.abc import Sequence
from pathlib import Path

from gacrl.errors import UserError
from gacrl.export.source import Source
from gacrl.replacing import replaced
from gacrl.training.trackers.rows import flat


def write(source: Source, out: Path) -> Sequence[Path]:
    """Write `metrics.jsonl` as CSV. Names are joined by dots: `greedy.return_agent_mean`.

    Raises UserError for a run that was not evaluated yet, as a shipped one.
    """
    folder = source.folder
    rows = [flat(row) for row in folder.metrics()] if folder.metrics_file.is_file() else []
    if not rows:
        raise UserError(f"{source.name} has no metrics.jsonl with an evaluation in it: train first")
    columns = dict.fromkeys(name for row in rows for name in row)
    text = io.StringIO(newline="")
    table = csv.DictWriter(text, columns, lineterminator="\n")
    table.writeheader()
    table.writerows(rows)
    with replaced(out) as file:
        file.write(text.getvalue().encode())
    return [out]
