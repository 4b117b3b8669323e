"""Feeding trackers: each in a thread of its own, which training never waits for."""

import contextlib
import queue
import threading
import time
from collections.abc import Callable, Generator, Sequence
from importlib import import_module
from typing import Any

from gacrl.config.run import RunConfig
from gacrl.training.build import Plan
from gacrl.training.loop import Progress
from gacrl.training.recorder import RunFolder
from gacrl.training.trackers import TRACKERS
from gacrl.training.trackers.sink import Sink
from gacrl.training.watching import Watcher

WAITING = 256
"""Evaluations that may wait for a tracker; a slower one loses the rest."""
PATIENCE = 20.0
"""Seconds that the end of a run waits for its trackers together."""


@contextlib.contextmanager
def tracked(names: Sequence[str], warn: Callable[[str], None], patience: float = PATIENCE) -> Generator[Watcher]:
    """Give the watcher that feeds these trackers, and see them to their end.

    warn: hears, once for each tracker, that it failed, is too slow or hangs. None of this stops the training.
    """
    feeders = [Feeder(name, warn) for name in names]
    step, seen = 0, list[RunFolder]()

    def planned(folder: RunFolder, config: RunConfig, plan: Plan) -> None:
        seen.append(folder)
        for feeder in feeders:
            feeder.begin(folder, config)

    def progress(told: Progress) -> None:
        nonlocal step
        step = told.env_steps
        for feeder in feeders:
            feeder.feed(lambda sink, rows=told.rows: sink.rows(rows))

    def finished(summary: dict[str, Any]) -> None:
        gif, last = seen[-1].gif, step
        for feeder in feeders if summary else []:
            feeder.feed(lambda sink: sink.summary(summary, last))
            if gif.is_file():
                feeder.feed(lambda sink: sink.picture(gif, last))

    try:
        yield Watcher(planned=planned, progress=progress, finished=finished)
    finally:
        deadline = time.monotonic() + patience
        for feeder in feeders:
            feeder.end(deadline)
        for feeder in feeders:
            feeder.wait(deadline)


class Feeder:
    """Hands a tracker, in its own thread, what it is to write down."""

    def __init__(self, name: str, warn: Callable[[str], None]):
        self.name = name
        self._tasks: queue.Queue[Callable[[Sink], None] | None] = queue.Queue(WAITING)
        self._warn, self._warned = warn, threading.Lock()
        self._thread: threading.Thread | None = None

    def begin(self, folder: RunFolder, config: RunConfig) -> None:
        """Start the thread, which imports the tracker's package: that takes seconds for some."""
        work = threading.Thread(target=self._work, args=(folder, config), name=f"track-{self.name}", daemon=True)
        self._thread = work
        work.start()

    def feed(self, task: Callable[[Sink], None]) -> None:
        """Let the tracker do something when it comes to it; nothing where it is too far behind."""
        if self._thread is not None and self._thread.is_alive():
            try:
                self._tasks.put_nowait(task)
            except queue.Full:
                self._complain("is too slow: what it has no room for is left out")

    def end(self, deadline: float) -> None:
        """Let it close once it is done with all that waits; until this time there may be room to say so."""
        if self._thread is not None and self._thread.is_alive():
            with contextlib.suppress(queue.Full):
                self._tasks.put(None, timeout=max(deadline - time.monotonic(), 0.0))

    def wait(self, deadline: float) -> None:
        """Return when it is closed, or at this time of `time.monotonic`."""
        if self._thread is not None:
            self._thread.join(max(deadline - time.monotonic(), 0.0))
            if self._thread.is_alive():
                self._complain("hangs, and is not waited for")

    def _work(self, folder: RunFolder, config: RunConfig) -> None:
        try:
            sink: Sink = import_module(TRACKERS[self.name].module).begin(folder, config, self.name)
            while (task := self._tasks.get()) is not None:
                task(sink)
            sink.close()
        except Exception as error:  # whatever a tracker raises, the training goes on
            why = " ".join(str(error).split())[:200] or type(error).__name__
            self._complain(f"failed and is left out from here on ({why})")

    def _complain(self, what: str) -> None:
        """Say something about this tracker, the first time alone."""
        if self._warned.acquire(blocking=False):
            self._warn(f"the tracker {self.name} {what}; the training goes on without it")
