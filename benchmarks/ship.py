"""Make a policy that comes along out of one seed of a run: its last checkpoint, without what only learning needs.

    python benchmarks/ship.py runs/gacrl gacrl --seed 0
    gacrl evaluate pretrained:gacrl
    python benchmarks/ship.py docs/data/gacrl-10-seeds.json gacrl     # its card alone, anew from a summary

Writes src/gacrl/pretrained/NAME anew, with a card: whose seed it is, of which table, and what it scores.
"""

import argparse
import hashlib
import json
import shutil
import sys
from pathlib import Path
from typing import Any

from gacrl import play
from gacrl.config import files

SHIPPED = Path(__file__).parents[1] / "src" / "gacrl" / "pretrained"


def main() -> None:
    """Write src/gacrl/pretrained/NAME anew."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("name")
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    if asked.run.suffix != ".json":
        _ship(asked.run, asked.name, asked.seed)
    summary = asked.run if asked.run.suffix == ".json" else asked.run / "summary.json"
    _write_card(SHIPPED / asked.name, json.loads(summary.read_text(encoding="utf-8")), asked.seed)


def _ship(run: Path, name: str, seed: int) -> None:
    member = files.load(run / "config.json").seeds.index(seed)
    # The old policy goes once the new one is whole. A warning, as of a damaged checkpoint, ends it.
    shipped, new = SHIPPED / name, SHIPPED / f"_{name}"
    shutil.rmtree(new, ignore_errors=True)
    play.save_policy(f"{run}@{member}", new, warn=sys.exit)
    shutil.rmtree(shipped, ignore_errors=True)
    print(new.rename(shipped))


def _write_card(folder: Path, summary: dict[str, Any], seed: int) -> None:
    """What the policy is, whence it comes and what it scores, for whoever finds the file alone."""
    (tensors,) = folder.glob("checkpoints/*/state.safetensors")
    at = summary["seeds"].index(seed)
    final = {metric: entry["values"][at] for metric, entry in summary["final"]["greedy"].items()}
    card = {
        "preset": summary["preset"],
        "task": summary["task"]["name"],
        "seed": seed,
        "of_seeds": summary["seeds"],
        "env_steps": summary["env_steps"],
        "episodes": summary["episodes"],
        "greedy": {metric: value for metric, value in final.items() if not metric.startswith("score_")},
        "versions": summary["versions"],
        "sha256": hashlib.sha256(tensors.read_bytes()).hexdigest(),
    }
    (folder / "card.json").write_text(json.dumps(card, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
