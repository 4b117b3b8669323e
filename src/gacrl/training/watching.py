"""What a run tells whoever looks on: the recorder's readers, the terminal, trackers, a notebook."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from gacrl.config.run import RunConfig
from gacrl.training.build import Plan
from gacrl.training.loop import Progress
from gacrl.training.recorder import RunFolder


@dataclass(frozen=True)
class Watcher:
    """Functions that a run calls, all of them optional; `Watcher(progress=print)` prints every evaluation.

    Watchers add up: `one + other` calls both, in this order. What a function raises ends the run; its last checkpoint
    is intact.
    """

    planned: Callable[[RunFolder, RunConfig, Plan], None] = lambda folder, config, plan: None
    """Before anything is allocated."""
    compiling: Callable[[], None] = lambda: None
    """Before the training program is compiled."""
    progress: Callable[[Progress], None] = lambda progress: None
    """After every chunk of training and its evaluation."""
    finishing: Callable[[], None] = lambda: None
    """Before the closing evaluation."""
    finished: Callable[[dict[str, Any]], None] = lambda summary: None
    """After it, with the content of `summary.json`."""
    warn: Callable[[str], None] = lambda sentence: None
    """With a sentence about something that is not as it should be, while the run goes on."""
    stop: Callable[[], bool] = lambda: False
    """Whether the run shall stop at its next checkpoint; asked after every chunk."""

    def __add__(self, other: "Watcher") -> "Watcher":
        def both(name: str) -> Callable[..., None]:
            first, second = getattr(self, name), getattr(other, name)

            def call(*told: Any) -> None:
                first(*told)
                second(*told)

            return call

        told = ("planned", "compiling", "progress", "finishing", "finished", "warn")
        return Watcher(**{name: both(name) for name in told}, stop=lambda: self.stop() or other.stop())
