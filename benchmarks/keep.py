"""Keep results in docs/data, where a document's numbers are recomputed from: with the command that made them.

    python benchmarks/keep.py runs/gacrl gacrl-10-seeds "gacrl train --num-seeds 10 --out runs/gacrl" \\
        --along coverage_final_0.1
    python benchmarks/keep.py runs/talk-reference talk-reference-study "gacrl talk --env reference --seeds 10"
    gacrl evaluate oracle --json | python benchmarks/keep.py - oracle "gacrl evaluate oracle"

Takes a finished run, a finished study, or what `gacrl evaluate --json` prints. `--along` adds a metric at every
evaluation of a run.

Refuses what cannot be followed to one clean commit: sources that had changes, a run that was begun and ended by two
commits, that diverged or lacks a seed, or a value that is not a finite number.
"""

import argparse
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from gacrl.config import files
from gacrl.errors import UserError
from gacrl.experiments.provenance import COMMIT, commits, doubts
from gacrl.training.recorder import RunFolder
from gacrl.versions import DIRTY

DATA = Path(__file__).parents[1] / "docs" / "data"


def main() -> int:
    """Write docs/data/NAME.json."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", help="a folder, or - for what `gacrl evaluate --json` prints")
    parser.add_argument("name")
    parser.add_argument("command", help="that made it")
    parser.add_argument("--along", metavar="METRIC", action="append", default=[], help="of a run, greedy")
    asked = parser.parse_args()
    try:
        kept = _kept(asked.source, asked.command, asked.along)
    except UserError as error:
        print(f"keep: {error}", file=sys.stderr)
        return 2
    file = DATA / f"{asked.name}.json"
    file.write_text(json.dumps({**kept, **_places(kept)}, indent=2) + "\n", encoding="utf-8")
    print(file)
    return 0


def _kept(source: str, command: str, along: list[str]) -> dict[str, Any]:
    if source == "-":
        return kept_evaluation(sys.stdin.read(), command)
    run = Path(source)
    if not (run / "config.json").is_file():
        return kept_study(run, command)
    kept = kept_summary(run, command)
    return {**kept, "along": _along(run, along)} if along else kept


def _places(kept: dict[str, Any]) -> dict[str, str]:
    """Where a run or study was, as commands name it: folders of this machine are nobody else's."""
    found = {key: Path(str(kept[key])) for key in ("run", "out", "report") if key in kept}
    return {
        key: str(Path("runs", *path.parts[-2 if key == "report" else -1 :]))
        for key, path in found.items()
        if path.is_absolute()
    }


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
    ended = summary["versions"].get(COMMIT)
    begun = origin.get("versions", {}).get(COMMIT)
    if begun is None or ended is None:
        raise UserError(f"{run} knows no commit: train it from a checkout of the repository")
    if begun != ended:
        raise UserError(f"{run} was begun by commit {begun} and ended by {ended}: train it again by one")
    _require_committed(str(run), ended)
    _require_every_seed(str(run), list(config.seeds), summary)
    return {"command": command, **summary}


def kept_study(study: Path, command: str) -> dict[str, Any]:
    """The summary of a study and the command that made it. Raises UserError for one that may not be kept."""
    try:
        summary = json.loads((study / "summary.json").read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise UserError(f"{study} is no finished study ({type(error).__name__}): end it first") from error
    made = summary.get("versions", [])
    for sentence in doubts(made):
        raise UserError(f"{study} cannot be kept. {sentence}")
    if not made or commits(made) == ["unknown"]:
        raise UserError(f"{study} knows no commit: make it from a checkout of the repository")
    if not np.isfinite(list(_numbers(summary))).all():
        raise UserError(f"{study} holds a value that is not a finite number: make it again")
    return {"command": command, **summary}


def kept_evaluation(printed: str, command: str) -> dict[str, Any]:
    """The last line of an evaluation and the command that made it. Raises UserError for one that may not be kept."""
    try:
        scores: dict[str, Any] = json.loads(printed.strip().splitlines()[-1])
        commit = scores["versions"].get(COMMIT)
        seeds = len(scores["final"]["greedy"]["return_agent_mean"]["values"])
    except (IndexError, ValueError, KeyError, TypeError) as error:
        raise UserError("that is no evaluation: pipe in what `gacrl evaluate --json` prints") from error
    if commit is None:
        raise UserError("the evaluation knows no commit: play from a checkout of the repository")
    _require_committed("the evaluation", commit)
    _require_every_seed("the evaluation", list(range(seeds)), {"seeds": list(range(seeds)), **scores})
    return {"command": command, **scores}


def _along(run: Path, metrics: list[str]) -> dict[str, Any]:
    """Each metric of every seed [S, P] at the P evaluations of training, greedy."""
    rows, seeds = RunFolder.open(run).metrics(), files.load(run / "config.json").seeds
    by_seed = [[row for row in rows if row["seed"] == seed] for seed in seeds]
    if any(metric not in row["greedy"] for row in rows for metric in metrics):
        raise UserError(f"{run} did not measure {' and '.join(metrics)} along training")
    return {
        "env_steps": [row["env_steps"] for row in by_seed[0]],
        **{metric: [[row["greedy"][metric] for row in seed] for seed in by_seed] for metric in metrics},
    }


def _require_committed(what: str, commit: str) -> None:
    if commit.endswith(DIRTY):
        raise UserError(
            f"{what} was made with changes beside commit {commit.removesuffix(DIRTY)}: commit, and make it again"
        )


def _require_every_seed(what: str, planned: list[int], summary: dict[str, Any]) -> None:
    if summary["seeds"] != planned:
        raise UserError(f"{what} holds seeds {summary['seeds']}, where {planned} were planned: train it again")
    for play, metrics in summary["final"].items():
        for metric, entry in metrics.items():
            if len(entry["values"]) != len(planned) or not np.isfinite(entry["values"]).all():
                raise UserError(f"{what} lacks a finite value of {metric} ({play}) for a seed: train it again")


def _numbers(data: Any) -> Iterator[float]:
    """Yield every number in JSON data."""
    if isinstance(data, dict | list):
        for inner in data.values() if isinstance(data, dict) else data:
            yield from _numbers(inner)
    elif isinstance(data, float | int):
        yield data


if __name__ == "__main__":
    sys.exit(main())
