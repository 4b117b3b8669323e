"""As many trials for everybody: a learner takes the best of a few learning rates, found on seeds of their own."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gacrl import tasks
from gacrl.config import files as configuration
from gacrl.experiments.results import reading, why_diverged
from gacrl.experiments.study import Planned
from gacrl.training.recorder import RunFolder

FACTORS = (1.0, 1 / 3, 3.0, 1 / 9, 9.0)
"""Of the learning rate that the preset has, in the order in which they are tried."""
_SEEDS = (1_000, 2)
"""How far from the learner's own a trial's seeds begin, and how many: no result is of these."""


def tried(run: Planned, trials: int) -> list[Planned]:
    """Plan the trials of a learner, each for as many steps as the learner itself."""
    beyond, many = _SEEDS
    first = run.config.seed + max(beyond, run.config.num_seeds)
    return [
        Planned(
            f"{run.name}, trial {number} of {trials}",
            replace(_with_rate(run, factor).config, seed=first, num_seeds=many),
            run.folder.with_name(f"{run.folder.name}-trials") / str(number),
        )
        for number, factor in enumerate(FACTORS[:trials], 1)
    ]


def tuned(run: Planned, trials: Sequence[Planned]) -> Planned:
    """Return the learner with the learning rate of its best trial, by the last evaluation along the way."""
    best = int(np.argmax([_worth(trial) for trial in trials]))
    return _with_rate(run, FACTORS[best])


def _with_rate(run: Planned, factor: float) -> Planned:
    rate = min(run.config.algorithm.learning_rate * factor, 1.0)
    changes = {"algorithm": {"learning_rate": rate}}
    return run if factor == 1.0 else replace(run, config=configuration.from_dict(changes, run.config))


def _worth(trial: Planned) -> float:
    """Return the headline at the last evaluation, mean over seeds, the more the better; −∞ where it diverged."""
    if why_diverged(trial.folder) is not None:
        return -np.inf
    task = tasks.find(trial.config.task)
    with reading(trial.folder):
        rows = RunFolder.open(trial.folder).metrics()
        last = [row["greedy"][task.headline] for row in rows if row["env_steps"] == rows[-1]["env_steps"]]
        return float(np.mean(last)) * task.metric(task.headline).sign
