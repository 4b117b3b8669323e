"""Write the anchors of tasks: the scores of policies that learn nothing, between which `score_talk` runs.

    python benchmarks/anchors.py                       # every task that has a silent policy
    python benchmarks/anchors.py reference --episodes 4096

All play the fixed starts of the closing evaluation. The file of a task also has room for `trained` policies, silent
and told ones, with their command, preset, steps and seeds: this script keeps what stands there. The score of silence
(and of being told) is the better one of the scripted and the trained one.
"""

import argparse
import json
from typing import Any

import numpy as np

from gacrl import tasks
from gacrl.evaluation import references
from gacrl.tasks.task import SILENT, TOLD, Task

HEARD = ("graph", "named")
"""Settings that change what is heard and how it is called, and not what silent and told policies can have."""


def measured(task: Task, settings: Any, who: str, episodes: int) -> dict[str, float]:
    """The metrics that tables have, and the standard error of the headline."""
    played = {
        k: np.asarray(v) for k, v in references.scripted_episodes(who, task.name, settings, episodes).items()
    }
    error = played[task.headline].std(ddof=1) / np.sqrt(episodes)
    means = {name: float(played[name].mean()) for name in task.shown(list(played))}
    return {name: round(value, 3) for name, value in {**means, "standard_error": float(error)}.items()}


def anchors(task: Task, episodes: int) -> dict[str, Any]:
    """What the file of this task holds."""
    settings, trained = tasks.default_settings(task.name), task.known().get("trained", {})
    comparable = task.facts(settings, [])["comparable"]
    found = {who: measured(task, settings, who, episodes) for who in ("random", SILENT, TOLD)}
    trained = {who: trained.get(who) for who in (SILENT, TOLD)}
    sign = task.metric(task.headline).sign
    scores = {
        who: sign * max(sign * known[task.headline] for known in (scripted, trained.get(who)) if known is not None)
        for who, scripted in found.items()
    }
    return {
        "command": f"python benchmarks/anchors.py {task.name} --episodes {episodes}",
        "settings": {
            **{name: value for name, value in comparable.items() if name not in HEARD},
            "max_cycles": settings.max_cycles,
        },
        "episodes": episodes,
        "scripted": found,
        "trained": trained,
        "scores": scores,
    }


def main() -> None:
    silent = [name for name in tasks.names() if SILENT in tasks.find(name).references]
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("task", nargs="*", default=silent, metavar="TASK", help="all by default")
    parser.add_argument("--episodes", type=int, default=16_384)
    asked = parser.parse_args()
    for name in asked.task:
        task = tasks.find(name)
        assert task.anchors is not None
        task.anchors.parent.mkdir(exist_ok=True)
        found = anchors(task, asked.episodes)
        task.anchors.write_text(json.dumps(found, indent=2) + "\n", encoding="utf-8")
        print(f"{task.anchors}: {found['scores']}", flush=True)


if __name__ == "__main__":
    main()
