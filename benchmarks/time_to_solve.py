"""Seconds from typing `gacrl train` to a solved task: import, compilation, evaluations and all; and of peers.

    python benchmarks/time_to_solve.py [--preset gacrl] [--seeds 5] [--first-seed 100] [--limit 600] [--cold] [--json]
    python benchmarks/time_to_solve.py --peers --jaxmarl CHECKOUT [--preset gacrl --preset mappo ...] [--seeds 3]

A level of final coverage 0.1 is reached at the first of two consecutive evaluations of 320 episodes, greedy, last
parameters, that are there. Seeds take turns; each is a process of its own, stopped once the highest level is
reached. With --cold every one starts with an empty compilation cache, and so it does beside peers.

--peers trains JaxMARL's IPPO, MAPPO and VDN-PQN (recurrent, and the feed-forward one that JaxMARL suggests for MPE)
and BenchMARL's MAPPO, with the hyperparameters they ship and without their own tests in training, on simple_spread of
JaxMARL and of PettingZoo: three agents, 25 steps, five actions. JaxMARL compiles whole trainings, whose steps are
chosen before; so each of --budgets is a process of its own, timed from its start to its last step, and evaluated once,
after that. A level is reached in the time of the shortest budget that ends there: the shorter ones are not added, and
schedules fit each budget, both in the peer's favour. BenchMARL trains until the limit and is evaluated there. The
limit of a peer is --limit or, without one, --times the time that the first preset's slowest seed takes to the highest
level. JaxMARL's algorithms are not in its package: --jaxmarl names a checkout of its repository.
"""

import argparse
import json
import math
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import peers

LEVELS = (0.5, 0.7, 0.9)
EVALUATIONS = 100
"""Along the preset's budget: how finely the time is told."""
PEERS = ("jaxmarl ippo", "jaxmarl mappo", "jaxmarl vdn-pqn", "jaxmarl vdn-pqn-ff", "benchmarl mappo")
Reached = dict[float, tuple[float, int]]
"""Per level: seconds, and environment steps."""


def solve(preset: str, seed: int, limit: float, cache: Path | None) -> tuple[Reached, float]:
    """Train until the highest level is reached, or the run or the time ends; and the time of the first evaluation."""
    from gacrl.config import presets

    settings = presets.preset(preset)
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


def solve_peer(peer: str, seed: int, limit: float, budgets: Sequence[int], checkout: str | None) -> Reached:
    """What the shortest budgets reach. A RuntimeError says why a peer fails."""
    found: Reached = {}
    for budget in budgets if peer.startswith("jaxmarl") else budgets[:1]:
        trained = train_peer(peer, seed, limit, budget, checkout)
        if trained is None:
            print(f"{peer} seed {seed}  {budget:,} steps take longer than {limit:.0f} s", flush=True)
            break
        steps, seconds, coverage = trained
        print(f"{peer} seed {seed}  {steps:,} steps in {seconds:.0f} s: coverage {coverage:.3f}", flush=True)
        found = {level: (seconds, steps) for level in LEVELS if coverage >= level} | found
        if LEVELS[-1] in found:
            break
    return found


def train_peer(
    peer: str, seed: int, limit: float, budget: int, checkout: str | None
) -> tuple[int, float, float] | None:
    """Steps, seconds from the process's start to the last of them, and coverage after that; None past the limit."""
    python, script = peers.python_of(peer.split()[0]), Path(__file__).with_name("solve_peers.py")
    environment = {name: value for name, value in os.environ.items() if name != "JAX_COMPILATION_CACHE_DIR"}
    said: dict[str, float] = {}
    with tempfile.TemporaryFile("w+") as errors:
        command = [str(python), str(script), peer, f"--steps={budget}", f"--seed={seed}"]
        command += [f"--until={time.time() + limit}", *([f"--jaxmarl={checkout}"] if checkout else [])]
        begun = time.perf_counter()
        with subprocess.Popen(
            command, env=environment, stdout=subprocess.PIPE, stderr=errors, text=True
        ) as process:
            for line in process.stdout or ():
                if line.startswith(('{"steps"', '{"coverage"')):
                    said |= {"seconds": time.perf_counter() - begun, **said, **json.loads(line)}
        if process.returncode == -signal.SIGALRM:
            return None
        if process.returncode != 0:
            errors.seek(0)
            raise RuntimeError((errors.read().strip() or "no reason given").splitlines()[-1])
    return int(said["steps"]), said["seconds"], said["coverage"]


def tell(name: str, found: Sequence[Reached], limit: float) -> dict[str, Any]:
    """A line for each level, and the table's part."""
    part: dict[str, Any] = {}
    for level in LEVELS:
        there = [times[level] for times in found if level in times]
        part[f"{name} {level}"] = {"seeds": len(found), "limit": limit, "reached": there}
        if not there:
            print(f"{name} {level}: no seed within {limit:.0f} s")
            continue
        seconds, steps = ([pair[k] for pair in there] for k in (0, 1))
        print(
            f"{name} {level}: {len(there)} of {len(found)} seeds; median {statistics.median(seconds):.0f} s "
            f"({min(seconds):.0f} to {max(seconds):.0f}), {statistics.median(steps):,.0f} steps "
            f"(at most {max(steps):,})"
        )
    return part


def verdict(peer: str, found: Sequence[Reached], ours: float, limit: float) -> str:
    """How many times as long as our slowest seed the peer's soonest takes to the highest level."""
    there = [times[LEVELS[-1]][0] for times in found if LEVELS[-1] in times]
    soonest = min(there, default=limit)
    times = f"{soonest:.0f} s" if math.isnan(ours) else f"{soonest:.0f} s, {soonest / ours:.1f} times ours"
    return f"{peer}: " + (
        f"{len(there)} of {len(found)} seeds, the soonest in {times}" if there else f"not within {times}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--preset", action="append", help="several times for several; by default gacrl")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--first-seed", type=int, default=100)
    parser.add_argument("--limit", type=float, help="seconds after which a seed is given up; 600 by default")
    parser.add_argument("--cold", action="store_true", help="an empty compilation cache for every seed")
    parser.add_argument(
        "--peers", nargs="*", choices=PEERS, metavar="PEER", help=f"all, or some of: {', '.join(PEERS)}"
    )
    parser.add_argument("--peer-seeds", type=int, help="by default as many as --seeds")
    parser.add_argument("--jaxmarl", help="a checkout of the JaxMARL repository, for its baselines")
    parser.add_argument("--budgets", type=int, nargs="+", default=[500_000, 2_000_000, 8_000_000])
    parser.add_argument("--times", type=float, default=10.0, help="a peer's limit, in our slowest times")
    parser.add_argument("--json", action="store_true")
    asked = parser.parse_args()
    presets, cold = asked.preset or ["gacrl"], asked.cold or asked.peers is not None
    own_limit = asked.limit or 600.0
    table: dict[str, Any] = {}
    slowest = float("nan")
    for preset in presets:
        found: list[Reached] = []
        if not cold:
            solve(preset, asked.first_seed, 60.0, None)  # fills the cache
        for seed in range(asked.first_seed, asked.first_seed + asked.seeds):
            with tempfile.TemporaryDirectory() as cache:
                times, first = solve(preset, seed, own_limit, Path(cache) if cold else None)
            found.append(times)
            said = "  ".join(f"{level}: {s:.0f} s, {steps:,} steps" for level, (s, steps) in times.items())
            print(f"{preset} seed {seed}  first evaluation {first:.1f} s  {said or 'nothing reached'}", flush=True)
        table |= tell(preset, found, own_limit)
        if preset == presets[0] and all(LEVELS[-1] in times for times in found):
            slowest = max(times[LEVELS[-1]][0] for times in found)
    limit = asked.limit or (own_limit if math.isnan(slowest) else asked.times * slowest)
    verdicts: list[str] = []
    for peer in (asked.peers or PEERS) if asked.peers is not None else ():
        if peer.startswith("jaxmarl") and asked.jaxmarl is None:
            print(f"{peer} is left out: no checkout of JaxMARL (--jaxmarl)", flush=True)
            continue
        if peers.python_of(peer.split()[0]) is None:
            continue
        seeds = range(asked.first_seed, asked.first_seed + (asked.peer_seeds or asked.seeds))
        try:
            found = [solve_peer(peer, seed, limit, sorted(asked.budgets), asked.jaxmarl) for seed in seeds]
        except RuntimeError as reason:
            print(f"{peer} failed and is left out: {reason}", flush=True)
            continue
        table |= tell(peer, found, limit)
        verdicts.append(verdict(peer, found, slowest, limit))
    if verdicts:
        ours = "not by all seeds" if math.isnan(slowest) else f"all seeds, the slowest in {slowest:.0f} s"
        print(f"{LEVELS[-1]} reached\n{presets[0]}: {ours}", *verdicts, sep="\n")
    if asked.json:
        print(json.dumps(table))


if __name__ == "__main__":
    main()
