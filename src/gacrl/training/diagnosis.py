"""A run that diverged, played again from its last good checkpoint, one update at a time; nothing is written."""

from dataclasses import dataclass
from pathlib import Path

import jax

from gacrl.training import build, session
from gacrl.training.divergence import not_finite
from gacrl.training.recorder import RunFolder
from gacrl.training.watching import Watcher


@dataclass(frozen=True)
class FirstBadUpdate:
    """The update after which something was not finite for the first time."""

    seed: int
    update: int
    """Counted from 1 since the run began."""
    env_steps: int
    """After it."""
    metrics: dict[str, tuple[float | None, float]]
    """What the update before it told, and it; None where it is the first that was played."""
    broken: dict[str, str]
    """Everything that is not finite, and its value."""


@dataclass(frozen=True)
class Diagnosis:
    """What playing a chunk again showed."""

    begun_at: int
    """Environment steps at the checkpoint."""
    ended_at: int
    bad: FirstBadUpdate | None
    """None where every update was finite."""


def diagnose(path: Path, watcher: Watcher | None = None) -> Diagnosis:
    """Play the chunk after a run's newest intact checkpoint, up to its first bad update.

    Update by update it gives the same bits as the chunk did. Raises UserError where there is no such run.
    """
    watcher = watcher or Watcher()
    folder = RunFolder.open(path)
    with folder.locked():
        config = folder.config()
        found = session.newest_checkpoint(folder, watcher.warn)
        trainer = build.make_trainer(config)
        watcher.planned(folder, config, build.plan(trainer, config))
        state = session.restore(trainer, config, found)
    begun = 0 if found is None else found.env_steps
    done = first = begun // config.steps_per_update
    before: list[dict[str, float]] | None = None
    watcher.compiling()
    while done < min(config.num_updates, first + config.updates_per_chunk):
        state, report = trainer.chunk(state, 1)
        done += 1
        means = jax.device_get(report.metrics)
        metrics = [{name: float(means[name][k]) for name in means} for k in range(config.num_seeds)]
        broken = list(not_finite(config.seeds, metrics, state.learner, trainer.algorithm.replay(state.learner)))
        if broken:
            seed = broken[0][0]
            member = config.seeds.index(seed)
            told = metrics[member].items()
            bad = FirstBadUpdate(
                seed=seed,
                update=done,
                env_steps=done * config.steps_per_update,
                metrics={name: (None if before is None else before[member][name], now) for name, now in told},
                broken={name: value for whose, name, value in broken if whose == seed},
            )
            return Diagnosis(begun, bad.env_steps, bad)
        before = metrics
    return Diagnosis(begun, done * config.steps_per_update, None)
