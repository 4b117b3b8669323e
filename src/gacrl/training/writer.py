"""Checkpoints are written by a thread of their own: training goes on while the disk is busy."""

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from types import TracebackType
from typing import Any


class Writer:
    """Writes one thing at a time, behind the back of whoever asked for it.

    Leaving its `with` block waits for what is being written. An error of a write is raised by the next call, or there.
    """

    def __init__(self) -> None:
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="checkpoint")
        self._writing: Future[Any] | None = None

    def __enter__(self) -> "Writer":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._thread.shutdown()
        if error is None:
            self.wait()

    def submit(self, write: Callable[[], object]) -> None:
        """Begin to write, once the write before is done."""
        self.wait()
        self._writing = self._thread.submit(write)

    def wait(self) -> None:
        """Return when everything is written. Raises what writing raised."""
        writing, self._writing = self._writing, None
        if writing is not None:
            writing.result()
