"""Silent and told learners that were trained before, read from a file that `gacrl talk` wrote."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gacrl import tasks
from gacrl.config import files as configuration
from gacrl.config.run import RunConfig
from gacrl.errors import UserError, reason
from gacrl.experiments.talking.kinds import KIND_OF
from gacrl.tasks.task import HEADLINE

_WHO = ("silent", "told")


class Known(NamedTuple):
    """Learners of the same task with the same settings and steps, by name: silent and told."""

    file: Path
    says: str
    """Where they are from, by which preset, and of how many seeds."""
    finals: Mapping[str, Mapping[str, NDArray[np.float64]]]
    """Per learner and metric of the tables: each seed's value [S]."""
    parameters: Mapping[str, int]


def read(file: Path, config: RunConfig) -> Known:
    """Find them in a `summary.json` of `gacrl talk`, or in a copy of one.

    config: of the talking learner. Raises UserError where they are not in it.
    """
    try:
        held = json.loads(file.read_text(encoding="utf-8"))
        studies = list(held["cases"].values()) if "cases" in held else [held]
        same = [one for one in studies if _plays(one) == _plays({"config": configuration.to_dict(config)})]
        if same:
            return _known(file, same[0], config)
        there = ", ".join(f"{one['task']} ({_plays(one)[1]:,} steps)" for one in studies)
    except OSError as error:
        raise UserError(
            f"cannot read {file}: {reason(error)}; --known takes a summary.json of gacrl talk"
        ) from error
    except (ValueError, KeyError, TypeError, AttributeError, IndexError, RecursionError) as error:
        raise UserError(f"{file} is no summary.json of gacrl talk: leave --known out") from error
    raise UserError(
        f"{file} has no silent and told learners of {config.task} with these settings and "
        f"{config.training.env_steps:,} steps, only of {there}: train as many, or leave --known out"
    )


def _plays(study: Mapping[str, Any]) -> tuple[Any, int]:
    """Return the task's settings, as JSON has them, and the steps."""
    config = json.loads(json.dumps(study["config"]))
    return config["env"], int(config["training"]["env_steps"])


def _known(file: Path, study: Mapping[str, Any], config: RunConfig) -> Known:
    task = tasks.find(config.task)
    if "kinds" in study:
        cells = {who: study["kinds"][KIND_OF[who]] for who in _WHO}
        finals = {who: cell["final"] for who, cell in cells.items()}
        parameters = {who: int(cell["parameters"]) for who, cell in cells.items()}
    else:
        metrics = {label: metric for metric, label in task.shown([HEADLINE, *task.metrics]).items()}
        further = {metrics.get(str(label), str(label)): by_who for label, by_who in study["further"].items()}
        measured = {HEADLINE: study["returns"], **further}
        finals = {who: {metric: by_who[who] for metric, by_who in measured.items()} for who in _WHO}
        parameters = {who: int(study["parameters"][who]) for who in _WHO}
    seeds, episodes = len(finals["silent"][HEADLINE]), study["config"]["evaluation"]["final_episodes"]
    return Known(
        file=file,
        says=f"{file}: {study['config']['preset']}, {seeds} seeds from {study['config']['seed']}, {episodes} episodes",
        finals={who: {m: np.asarray(v, float) for m, v in final.items()} for who, final in finals.items()},
        parameters=parameters,
    )
