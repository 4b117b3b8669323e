"""What is kept of a run after every chunk, in the background: the whole state, and the best policy so far."""

from dataclasses import asdict
from functools import partial
from pathlib import Path

import numpy as np

from gacrl.errors import UserError
from gacrl.training import checkpoint
from gacrl.training.devices import without_padding
from gacrl.training.loop import Progress
from gacrl.training.recorder import RunFolder
from gacrl.training.writer import Writer

SCORE = "return_agent_mean"
"""The best policy is the one with the highest greedy mean of this, over all seeds."""
ROWS = "rows"
"""What a checkpoint calls the number of lines that metrics.jsonl had by then."""
FOR_LEARNING = (".replay", ".optimizer", ".rewards")
"""What a learner holds that acting does not need."""


class Keeper:
    """Keeps the whole state after every chunk, and the policy where it is the best so far, in the background."""

    def __init__(self, folder: RunFolder, num_seeds: int, fingerprint: str, writer: Writer, rows: int):
        self._num_seeds, self._writer, self._rows = num_seeds, writer, rows
        self._save = partial(checkpoint.save, folder.checkpoints, fingerprint=fingerprint)
        self._best = _best_score(folder.checkpoints)

    def __call__(self, progress: Progress) -> None:
        state = checkpoint.without_empty_rows(checkpoint.arrays(without_padding(progress.whole, self._num_seeds)))
        env_steps = progress.env_steps
        self._rows += len(progress.rows)
        counters = {**asdict(progress.clock), ROWS: self._rows}
        writes = [partial(self._save, checkpoint.serialise(state), env_steps, counters=counters)]
        score = float(np.mean([row["greedy"][SCORE] for row in progress.rows]))
        if score > self._best:
            self._best = score
            policy = checkpoint.serialise({name: it for name, it in state.items() if acts(name)})
            writes.append(partial(self._save, policy, env_steps, counters={SCORE: score}, kind=checkpoint.BEST))
        self._writer.submit(lambda: [write() for write in writes])


def _best_score(checkpoints: Path) -> float:
    """Of the best policy that is kept; −∞ where there is none."""
    try:
        return checkpoint.newest(checkpoints, checkpoint.BEST)[0].counters[SCORE]
    except (UserError, KeyError):
        return -np.inf


def acts(name: str) -> bool:
    """Whether a saved array is one that a policy needs."""
    return name.startswith(".learner") and not name.removeprefix(".learner").startswith(FOR_LEARNING)
