"""The host's side of training: run a chunk, evaluate, tell; again until the steps are done.

Whoever watches (command line, recorder, trackers, viewer, sweep) reads the one stream of `Progress`.
"""

import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

from gacrl import tasks
from gacrl.config.run import RunConfig
from gacrl.evaluation.metrics import EpisodeSummary
from gacrl.reel import num_frames
from gacrl.training.ahead import Ahead, Programs, prepare
from gacrl.training.devices import gathered, wait_for_all
from gacrl.training.divergence import require_finite, require_sound_task
from gacrl.training.forecast import closing_seconds, seconds_left
from gacrl.training.recorder import SHOWN_EPISODES
from gacrl.training.trainer import AbstractTrainer, ChunkReport, TrainState


@dataclass(frozen=True)
class Clock:
    """Seconds spent so far, over all the processes that worked on a run."""

    wall: float = 0.0
    training: float = 0.0
    """In chunks, without compilation and evaluation."""
    compiling: float = 0.0
    """Waiting for programs: most are compiled while training goes on."""
    timed_env_steps: int = 0
    """Environment steps of all seeds that `training` covers."""

    @property
    def steps_per_second(self) -> float:
        return self.timed_env_steps / self.training if self.training > 0 else 0.0


@dataclass(frozen=True)
class Progress:
    """Where a run stands after a chunk and its evaluation."""

    env_steps: int
    """Of each seed."""
    total_env_steps: int
    clock: Clock
    rows: tuple[dict[str, Any], ...]
    """What `metrics.jsonl` gets: one object per seed."""
    state: TrainState
    """The training state, valid until the next chunk starts."""
    shown: Mapping[str, str]
    """Metrics of the task that stand in tables, headline first, and what they are called there."""
    whole: TrainState
    """The same; where it is spread over several processes, all of it in each of them."""
    seconds_left: float
    """Until the run has its summary and its GIF, by the pace so far."""

    @property
    def done(self) -> bool:
        return self.env_steps >= self.total_env_steps


def train(
    trainer: AbstractTrainer,
    config: RunConfig,
    state: TrainState,
    env_steps: int = 0,
    clock: Clock | None = None,
    programs: Programs | None = None,
) -> Iterator[Progress]:
    """Train from a state (fresh, or of a checkpoint at `env_steps`) to the configured end.

    programs: where they are being compiled already. Yields after every chunk. Raises Diverged after the first one with
    a loss or a parameter that is not finite.
    """
    if programs is None:
        with Ahead() as ahead:
            yield from train(trainer, config, state, env_steps, clock, prepare(ahead, trainer, config))
        return
    clock = Clock() if clock is None else clock
    per_update, shown = config.steps_per_update, tasks.find(config.task).shown(trainer.table.names)
    done, total = env_steps // per_update, config.num_updates
    started, before = time.perf_counter(), clock
    compiling, training, timed = clock.compiling, clock.training, clock.timed_env_steps
    chunk = None
    while done < total:
        updates = min(config.updates_per_chunk, total - done)
        if chunk is None:
            begun = time.perf_counter()
            chunk = trainer.compiled(state, updates) if programs.chunk is None else programs.chunk.result()
            compiling += time.perf_counter() - begun
            wait_for_all()
        begun = time.perf_counter()
        state, report = jax.block_until_ready(chunk(state, updates))
        training += time.perf_counter() - begun
        require_sound_task(config.seeds, config.task, jax.device_get(gathered(report.fault)))
        timed += updates * per_update * len(config.seeds)
        done += updates
        begun = time.perf_counter()
        for program in programs.monitor:
            program.result()
        compiling += time.perf_counter() - begun
        begun = time.perf_counter()
        evaluations = {
            "greedy": trainer.evaluate(state.learner, False, "monitor", config.evaluation.num_episodes),
            "sampled": trainer.evaluate(state.learner, True, "monitor", config.evaluation.num_episodes),
        }
        evaluations = jax.device_get(gathered(evaluations))
        playing = time.perf_counter() - begun
        wall = before.wall + time.perf_counter() - started
        clock = Clock(wall, training, compiling, timed)
        whole = gathered(state)
        report, finished = jax.device_get((gathered(report), whole.episodes))
        rows = _rows(config, report, trainer.table.names, evaluations, done * per_update, finished, clock)
        told = [row["update"] for row in rows]
        replay = trainer.algorithm.replay(whole.learner)
        require_finite(config.seeds, told, whole.learner, replay, (done - updates) * per_update, done * per_update)
        closing = _closing(trainer, config, playing)
        to_train, to_play = (total - done) * per_update * len(rows), -(-(total - done) // config.updates_per_chunk)
        left = seconds_left(to_train, clock.steps_per_second, to_play, playing, closing)
        yield Progress(done * per_update, total * per_update, clock, rows, state, shown, whole, left)


def _closing(trainer: AbstractTrainer, config: RunConfig, playing: float) -> float:
    """Seconds that will pass after the last chunk."""
    more = config.evaluation.final_episodes / config.evaluation.num_episodes
    return closing_seconds(playing, more, SHOWN_EPISODES * num_frames(trainer.evaluation_env.max_cycles))


def _rows(
    config: RunConfig,
    report: ChunkReport,
    names: tuple[str, ...],
    evaluations: dict[str, Any],
    env_steps: int,
    finished: np.ndarray,
    clock: Clock,
) -> tuple[dict[str, Any], ...]:
    """One object per seed: the chunk's training episodes, its losses, and the evaluation after it."""

    def row(member: int, seed: int) -> dict[str, Any]:
        seen = jax.tree.map(lambda leaf: leaf[member], report.episodes)
        return {
            "seed": seed,
            "env_steps": env_steps,
            "episodes_done": int(finished[member]),
            "train": _training_episodes(seen, names),
            "update": {name: float(values[member]) for name, values in report.metrics.items()},
            "task": _difficulty(report.env_params, member),
            **{
                kind: {name: float(values[member].mean()) for name, values in metrics.items()}
                for kind, metrics in evaluations.items()
            },
            "steps_per_second": clock.steps_per_second,
            "compile_seconds": clock.compiling,
            "wall_seconds": clock.wall,
        }

    return tuple(row(member, seed) for member, seed in enumerate(config.seeds))


def _training_episodes(seen: EpisodeSummary, names: tuple[str, ...]) -> dict[str, Any]:
    """The episodes that ended in a chunk of one seed; None in place of every number where none did."""
    ended = int(seen.ended)
    mean = seen.total / max(ended, 1)
    spread = np.sqrt(np.maximum(seen.squares / max(ended, 1) - mean**2, 0.0))

    def named(vector: Any) -> dict[str, float | None]:
        return dict(zip(names, map(float, vector), strict=True)) if ended else dict.fromkeys(names)

    return {"episodes": ended, "mean": named(mean), "sd": named(spread), "last_episode": named(seen.last)}


def _difficulty(env_params: Any, member: int) -> dict[str, float]:
    """The task's numbers that have a name, as they were in the chunk's last update: a curriculum moves some."""
    named = env_params._asdict() if hasattr(env_params, "_asdict") else {}
    return {
        name: float(values[member])
        for name, values in named.items()
        if isinstance(values, np.ndarray) and values.ndim == 1 and values.dtype != bool
    }
