"""Keep a finished run's summary in docs/data, where a document's numbers are recomputed from: with its command.

    python benchmarks/keep.py runs/gacrl gacrl-10-seeds "gacrl train --num-seeds 10 --out runs/gacrl"

Refuses what cannot be followed to one clean commit: a run whose sources had changes, that was begun and ended by two
commits, that diverged or lacks a seed, or a value that is not a finite number.
"""

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

from gacrl.config import files
from gacrl.errors import UserError
from gacrl.versions import DIRTY

DATA = Path(__file__).parents[1] / "docs" / "data"


def main() -> int:
    """Write docs/data/NAME.json."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("name")
    parser.add_argument("command", help="that made the run")
    asked = parser.parse_args()
    try:
        kept = kept_summary(asked.run, asked.command)
    except UserError as error:
        print(f"keep: {error}", file=sys.stderr)
        return 2
    file = DATA / f"{asked.name}.json"
    file.write_text(json.dumps(kept, indent=2) + "\n", encoding="utf-8")
    print(file)
    return 0


def kept_summary(run: Path, command: str) -> dict[str, Any]:
    """The summary of a run and the command that made it. Raises UserError for one that may not be kept."""
    if (run / "diverged.json").is_file():
        raise UserError(f"{run} diverged: its seeds are no result")
    try:
        summary, origin = (
            json.loads((run / name).read_text(encoding="utf-8")) for name in ("summary.json", "origin.json")
        )
    except (OSError, ValueError) as error:
        raise UserError(f"{run} is no finished run ({type(error).__name__}): train it to its end first") from error
    config = files.load(run / "config.json")
    begun, ended = origin.get("versions", {}).get("git_commit"), summary["versions"].get("git_commit")
    if begun is None or ended is None:
        raise UserError(f"{run} knows no commit: train it from a checkout of the repository")
    if begun != ended:
        raise UserError(f"{run} was begun by commit {begun} and ended by {ended}: train it again by one")
    if ended.endswith(DIRTY):
        raise UserError(
            f"{run} was trained with changes beside commit {ended.removesuffix(DIRTY)}: commit, train again"
        )
    _require_every_seed(run, list(config.seeds), summary)
    return {"command": command, **summary}


def _require_every_seed(run: Path, planned: list[int], summary: dict[str, Any]) -> None:
    if summary["seeds"] != planned:
        raise UserError(f"{run} holds seeds {summary['seeds']}, where {planned} were planned: train it again")
    for play, metrics in summary["final"].items():
        for metric, entry in metrics.items():
            if len(entry["values"]) != len(planned) or not np.isfinite(entry["values"]).all():
                raise UserError(f"{run} lacks a finite value of {metric} ({play}) for a seed: train it again")


if __name__ == "__main__":
    sys.exit(main())
