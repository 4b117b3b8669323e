"""Seconds from typing `gacrl train` to a solved task: import, compilation, evaluations and all.

    python benchmarks/time_to_solve.py [--preset gacrl] [--seeds 5] [--first-seed 100] [--limit 600] [--cold] [--json]

A level of final coverage 0.1 is reached at the first of two consecutive evaluations of 320 episodes, greedy, last
parameters, that are there. Seeds take turns; each is a process of its own, stopped once the highest level is
reached. With --cold every one starts with an empty compilation cache.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

LEVELS = (0.5, 0.7, 0.9)
EVALUATIONS = 100
"""Along the preset's budget: how finely the time is told."""
Reached = dict[float, tuple[float, int]]
"""Per level: seconds, and environment steps."""


def solve(preset: str, seed: int, limit: float, cache: Path | None) -> tuple[Reached, float]:
    """Train until the highest level is reached, or the run or the time ends; and the time of the first evaluation."""
    from gacrl import config

    settings = config.preset(preset)
    interval = max(settings.training.env_steps // EVALUATIONS, settings.steps_per_update)
    environment = {**os.environ, **({} if cache is None else {"XDG_CACHE_HOME": str(cache)})}
    with tempfile.TemporaryDirectory() as room:
        folder = Path(room) / "run"
        command = [sys.executable, "-m", "gacrl", "train", "--preset", preset, "--seed", str(seed)]
        command += [
            "--evaluation.num-episodes",
            "320",
            "--evaluation.interval",
            str(interval),
            "--out",
            str(folder),
        ]
        begun = time.perf_counter()
        with subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL) as process:
            seen: list[tuple[float, int, float]] = []
            going = True
            while going:
                time.sleep(0.05)
                ended = process.poll() is not None  # looked at first: what it wrote last is read below
                now = time.perf_counter() - begun
                for row in rows(folder / "metrics.jsonl")[len(seen) :]:
                    seen.append((now, row["env_steps"], row["greedy"]["coverage_final_0.1"]))
                going = not ended and now < limit and LEVELS[-1] not in reached(seen)
            process.kill()
    return reached(seen), seen[0][0] if seen else float("nan")


def rows(path: Path) -> list[dict[str, Any]]:
    """The complete lines of a file that is still being written."""
    if not path.exists():
        return []
    return [json.loads(line) for line in path.read_text(encoding="utf-8").split("\n")[:-1]]


def reached(seen: Sequence[tuple[float, int, float]]) -> Reached:
    """When each level was reached: at the first of two evaluations in a row that are there."""
    found: Reached = {}
    for level in LEVELS:
        for (seconds, steps, first), (_, _, second) in pairwise(seen):
            if min(first, second) >= level:
                found[level] = (seconds, steps)
                break
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--preset", action="append", help="several times for several; by default gacrl")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--first-seed", type=int, default=100)
    parser.add_argument("--limit", type=float, default=600.0, help="seconds after which a seed is given up")
    parser.add_argument("--cold", action="store_true", help="an empty compilation cache for every seed")
    parser.add_argument("--json", action="store_true")
    asked = parser.parse_args()
    table: dict[str, Any] = {}
    for preset in asked.preset or ["gacrl"]:
        found: list[Reached] = []
        if not asked.cold:
            solve(preset, asked.first_seed, 60.0, None)  # fills the cache
        for seed in range(asked.first_seed, asked.first_seed + asked.seeds):
            with tempfile.TemporaryDirectory() as cache:
                times, first = solve(preset, seed, asked.limit, Path(cache) if asked.cold else None)
            found.append(times)
            said = "  ".join(f"{level}: {s:.0f} s, {steps:,} steps" for level, (s, steps) in times.items())
            print(f"{preset} seed {seed}  first evaluation {first:.1f} s  {said or 'nothing reached'}", flush=True)
        for level in LEVELS:
            there = [times[level] for times in found if level in times]
            name = f"{preset} {level}"
            table[name] = {"seeds": asked.seeds, "reached": there}
            if there:
                seconds, steps = ([pair[k] for pair in there] for k in (0, 1))
                print(
                    f"{name}: {len(there)} of {asked.seeds} seeds; median {statistics.median(seconds):.0f} s "
                    f"({min(seconds):.0f} to {max(seconds):.0f}), {statistics.median(steps):,.0f} steps "
                    f"(at most {max(steps):,})"
                )
            else:
                print(f"{name}: no seed within {asked.limit:.0f} s")
    if asked.json:
        print(json.dumps(table))


if __name__ == "__main__":
    main()
