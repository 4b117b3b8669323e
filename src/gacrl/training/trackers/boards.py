"""Weights & Biases, and Trackio, which has the same functions: init, log, finish."""

import os
from collections.abc import Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

from gacrl.config import files as configuration
from gacrl.config.run import RunConfig
from gacrl.training.recorder import RunFolder
from gacrl.training.trackers.sink import Row, Sink, closing, scalars

PROJECT = "gacrl"


def begin(folder: RunFolder, config: RunConfig, name: str) -> Sink:
    """Begin a run called as its folder in the project gacrl. W&B stays offline unless WANDB_MODE says otherwise."""
    board: Any = import_module(name)
    own = _offline(board, folder) if name == "wandb" else _local()
    run = board.init(project=PROJECT, name=folder.path.name, config=configuration.to_dict(config), **own)

    def rows(evaluation: Sequence[Row]) -> None:
        run.log(scalars(evaluation), step=int(evaluation[0]["env_steps"]))

    def summary(content: Mapping[str, Any], step: int) -> None:
        run.log(closing(content), step=step)

    def picture(path: Path, step: int) -> None:
        run.log({"episodes": board.Video(str(path), format="gif")}, step=step)

    return Sink(rows, summary, picture, run.finish)


def _offline(wandb: Any, folder: RunFolder) -> dict[str, Any]:
    """What W&B is asked for besides: a folder of ours, no lines of its own, and none of ours."""
    quiet = wandb.Settings(silent=True, console="off")
    return {"dir": str(folder.path), "mode": os.environ.get("WANDB_MODE", "offline"), "settings": quiet}


def _local() -> dict[str, Any]:
    """What Trackio is asked for: no threads that measure the machine."""
    return {"embed": False, "auto_log_cpu": False, "auto_log_gpu": False}
