"""What is kept of a run after every chunk, in the background: the whole state, and the best policy so far."""

from collections.abc import Callable, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from gacrl.algorithms.contract import Algorithm
from gacrl.errors import UserError
from gacrl.tasks.task import Task
from gacrl.training import checkpoint
from gacrl.training.devices import without_padding
from gacrl.training.loop import Progress
from gacrl.training.recorder import RunFolder
from gacrl.training.trainer import TrainState
from gacrl.training.writer import Writer

ROWS = "rows"
"""What a checkpoint calls the number of lines that metrics.jsonl had by then."""


class Acting(NamedTuple):
    """The part of a training state that acts, under the paths that it has in a checkpoint of the whole."""

    learner: Any


class Keeper:
    """Keeps the whole state after every chunk, and the policy where it is the best so far, in the background.

    The best policy is the one whose greedy mean of the task's headline, over all seeds, is best.
    """

    def __init__(
        self,
        folder: RunFolder,
        num_seeds: int,
        algorithm: Algorithm,
        task: Task,
        fingerprint: str,
        writer: Writer,
        rows: int,
    ):
        self._num_seeds, self._algorithm, self._writer, self._rows = num_seeds, algorithm, writer, rows
        self._save = partial(checkpoint.save, folder.checkpoints, fingerprint=fingerprint)
        self._writing = partial(folder.writing, task.name)
        self._headline = task.headline
        self._sign = task.metric(task.headline).sign
        self._best = self._kept_score(folder.checkpoints)

    def __call__(self, progress: Progress) -> None:
        """Keep where a run stands."""
        state = without_padding(progress.whole, self._num_seeds)
        env_steps = progress.env_steps
        self._rows += len(progress.rows)
        counters = {**asdict(progress.clock), ROWS: self._rows}
        writes = [partial(self._save, self._serialised(state), env_steps, counters=counters)]
        score = float(np.mean([row["greedy"][self._headline] for row in progress.rows]))
        if self._sign * score > self._best:
            self._best = self._sign * score
            policy = checkpoint.serialise(checkpoint.arrays(Acting(self._algorithm.acting(state.learner))))
            kept = {self._headline: score}
            writes.append(partial(self._save, policy, env_steps, counters=kept, kind=checkpoint.BEST))
        self._submit(writes)

    def begin(self, state: TrainState) -> None:
        """Keep a state before any training, for a run that does not begin with fresh parameters."""
        state = without_padding(state, self._num_seeds)
        self._submit([partial(self._save, self._serialised(state), 0, counters={ROWS: 0})])

    def _submit(self, writes: Sequence[Callable[[], object]]) -> None:
        def write() -> None:
            with self._writing():
                for one in writes:
                    one()

        self._writer.submit(write)

    def _serialised(self, state: TrainState) -> bytes:
        return checkpoint.serialise(checkpoint.arrays(state, self._algorithm.replay(state.learner)))

    def _kept_score(self, checkpoints: Path) -> float:
        """Of the best policy that is kept, the higher the better; −∞ where there is none."""
        try:
            return self._sign * checkpoint.newest(checkpoints, checkpoint.BEST)[0].counters[self._headline]
        except (UserError, KeyError):
            return -np.inf
