"""What is new about a run while its page is open: the curves of its evaluations, and newer parameters."""

import time
from pathlib import Path
from typing import Any

from gacrl import play
from gacrl.play import TrainedRun
from gacrl.tasks.task import Task
from gacrl.training.recorder import RunFolder
from gacrl.viewer.cast import Cast, Player, acting
from gacrl.viewer.server import Board

EVERY = 1.0
"""Seconds between two looks at a run folder."""
_MOST_POINTS = 400
"""Of a curve."""


def follow(cast: Cast, board: Board) -> None:
    """Tell pages how the first run among the players learns, and let it play with its newest parameters.

    Returns when the run has its summary. Scripted policies learn nothing.
    """
    player = next((player for player in cast.players if player.opened is not None), None)
    if player is None or player.opened is None:
        return
    folder, seen = play.folder_of(player.name), None
    while True:
        ended = folder.summary_file.exists() or not folder.metrics_file.exists()  # nothing is written after this
        written = [_written(path) for path in (folder.metrics_file, folder.checkpoints)]
        if written != seen and _look(player, player.opened, folder, cast.task, board):
            seen = written
        if ended:
            return
        time.sleep(EVERY)


def _written(path: Path) -> float:
    try:
        return path.stat().st_mtime
    except OSError:
        return -1.0


def _look(player: Player, opened: TrainedRun, folder: RunFolder, task: Task, board: Board) -> bool:
    """Take what is new, if it is whole. A folder in which a training writes may be half way between two states."""
    try:
        newer = play.newer(opened)
        if newer is not None:
            player.opened, player.learner, player.env_steps = newer, acting(newer), newer.env_steps
        curves = learning(folder.metrics(), task)
        if curves is not None:
            board.put("learning", **curves, playing=player.env_steps)
    except Exception:  # what is read is being written: the next look finds it whole
        return False
    return True


def learning(rows: list[dict[str, Any]], task: Task) -> dict[str, Any] | None:
    """Return the headline after each evaluation: {label, steps, seeds}; None before two of them."""
    seeds: dict[Any, dict[int, float]] = {}
    for row in rows:
        value = row.get("greedy", {}).get(task.headline)
        if isinstance(value, int | float):
            seeds.setdefault(row.get("seed"), {})[row["env_steps"]] = float(value)
    if not seeds:
        return None
    steps = sorted(set.intersection(*(set(values) for values in seeds.values())))
    steps = steps[:: -(-len(steps) // _MOST_POINTS) or 1]
    label = task.metric(task.headline).label or task.headline
    return {"label": label, "steps": steps, "seeds": [[values[k] for k in steps] for values in seeds.values()]}
