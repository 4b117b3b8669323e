"""The same learner on the real `simple_spread_v3` of MPE2 and on our own `spread`: two curves.

    python benchmarks/host_curves.py [--env-steps 100000] [--seeds 3] [--out docs/data/host-spread-3-seeds.json]

The preset is `ippo`; seeds count from 0. Each row of the file is the greedy return of every seed on 32 fixed episodes,
which are others in the two programs. It prints the mean over the seeds, and the difference of the last rows with its
95 % interval (`gacrl.evaluation.statistics`).
"""

import argparse
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from gacrl import api
from gacrl.evaluation.statistics import difference, mean
from gacrl.training.devices import prepare_jax
from gacrl.versions import versions

TASKS = {"spread": "spread", "mpe2": "pettingzoo:mpe2.simple_spread_v3"}
METRIC = "return_agent_mean"


def curve(task: str, env_steps: int, seeds: int) -> dict[str, Any]:
    """Return {env_steps: [K], return_agent_mean: [K, seeds]}."""
    config = api.settled("ippo", env=task)
    config = replace(
        config,
        num_seeds=seeds,
        training=replace(config.training, env_steps=env_steps),
        evaluation=replace(config.evaluation, interval=env_steps // 5, num_episodes=32),
    )
    found: dict[str, Any] = {"env_steps": [], METRIC: []}
    for progress in api.iterate(config):
        found["env_steps"].append(progress.env_steps)
        found[METRIC].append([row["greedy"][METRIC] for row in progress.rows])
        print(task, progress.env_steps, [round(value, 3) for value in found[METRIC][-1]], flush=True)
    return found


if __name__ == "__main__":
    asked = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    asked.add_argument("--env-steps", type=int, default=100_000)
    asked.add_argument("--seeds", type=int, default=3)
    asked.add_argument("--out", type=Path)
    given = asked.parse_args()
    prepare_jax(given.seeds)
    curves = {name: curve(task, given.env_steps, given.seeds) for name, task in TASKS.items()}
    ours, theirs = (np.array(curves[name][METRIC][-1]) for name in TASKS)
    apart = difference(theirs, ours, mean)
    print(f"mpe2 {theirs.mean():.2f}, spread {ours.mean():.2f}; apart {apart}")
    if given.out is not None:
        made = {"preset": "ippo", "seeds": list(range(given.seeds)), "versions": versions(), **curves}
        given.out.write_text(json.dumps(made, indent=1) + "\n")
