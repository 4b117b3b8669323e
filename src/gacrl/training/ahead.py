"""Programs made before they are called: beside each other, and beside training."""

import os
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from threading import Event, Lock
from types import TracebackType
from typing import Any, TypeAlias

import jax
from jax.sharding import NamedSharding, PartitionSpec, Sharding, SingleDeviceSharding
from jaxtyping import PyTree

from gacrl.config.run import RunConfig
from gacrl.training.build import member_shapes, stacked_shapes
from gacrl.training.recorder import SHOWN_EPISODES
from gacrl.training.trainer import AbstractTrainer, Trainer, TrainState

Lower: TypeAlias = Callable[[], Any]
"""Makes what XLA compiles of a program; whoever calls that program later finds it compiled."""


class Ahead:
    """Threads that compile, so that the training program does not wait for the others.

    Leaving it waits for what is being compiled; what has not begun is dropped.
    """

    def __init__(self, threads: int | None = None) -> None:
        """threads: as many as there are cores, but two at least."""
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        self._threads = ThreadPoolExecutor(max(2, cores) if threads is None else threads, "compiling")
        self._lowering, self._left = Lock(), Event()

    def __enter__(self) -> "Ahead":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.leave()
        self._threads.shutdown()

    def leave(self) -> None:
        """Begin nothing any more."""
        self._left.set()
        self._threads.shutdown(wait=False, cancel_futures=True)

    def run(self, function: Callable[..., Any], *arguments: Any) -> Future[Any]:
        """Call a function there."""
        return self._threads.submit(function, *arguments)

    def compile(self, lower: Lower) -> Future[Any]:
        """Compile a program there; the result is the compiled one."""
        return self.run(self.compiled, lower)

    def compiled(self, lower: Lower) -> Any:
        """Compile a program in this thread; after the end nothing."""
        if self.left:
            return None
        with self._lowering:  # Python lowers two at once no faster
            lowered = lower()
        return lowered.compile()

    @property
    def left(self) -> bool:
        """Whether nobody waits any more."""
        return self._left.is_set()


@dataclass(frozen=True)
class Programs:
    """The programs of a training, being compiled."""

    chunk: Future[Any] | None = None
    """A chunk of any length; None: nobody compiles it."""
    monitor: tuple[Future[Any], ...] = ()
    """The evaluations along the way."""


def prepare(ahead: Ahead, trainer: AbstractTrainer, config: RunConfig, fresh: bool = False) -> Programs:
    """Begin to compile what training needs; nothing where the environments live in Python.

    fresh: wait for what makes training states, which it begins with.
    """
    if not isinstance(trainer, Trainer):
        return Programs()
    learner, count = _laid_out(trainer).learner, config.evaluation.num_episodes
    chunk = ahead.compile(lambda: trainer.chunk.lower(_laid_out(trainer), 1))
    start = ahead.compile(lambda: trainer.lower_init(config.seeds[0])) if fresh else None
    monitor = tuple(
        ahead.compile(partial(Trainer.evaluate.lower, trainer, learner, explore, "monitor", count))
        for explore in (False, True)
    )
    if start is not None:
        start.result()
    return Programs(chunk, monitor)


def closing(trainer: Trainer, config: RunConfig) -> tuple[Lower, ...]:
    """Return the programs that close a run: its two evaluations, and the episodes of a seed to look at, a function of
    it.
    """
    learner, count = _laid_out(trainer).learner, config.evaluation.final_episodes
    first = _placed(member_shapes(trainer).learner, SingleDeviceSharding(jax.local_devices()[0]))
    return (
        partial(Trainer.evaluate.lower, trainer, learner, False, "report", count),
        partial(Trainer.evaluate.lower, trainer, learner, True, "report", count),
        partial(Trainer.record.lower, trainer, first, "report", SHOWN_EPISODES),
    )


def _laid_out(trainer: Trainer) -> TrainState:
    """The shapes of all seeds' training states as they lie on the devices, padding included."""
    parts = trainer.mesh.shape["seeds"]
    stacked = stacked_shapes(trainer, -(-trainer.num_seeds // parts) * parts)
    return _placed(stacked, NamedSharding(trainer.mesh, PartitionSpec("seeds")))


def _placed(shapes: PyTree, place: Sharding) -> PyTree:
    return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=place), shapes)
