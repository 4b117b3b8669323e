"""What is exported: a run, opened when a format needs more than its files."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from gacrl import play
from gacrl.play import TrainedRun
from gacrl.training.recorder import RunFolder


@dataclass(frozen=True)
class Source:
    """A run by its name: a folder, FOLDER@k, FOLDER@best or pretrained:NAME."""

    name: str
    change: Callable[[Any], Any] = lambda settings: settings
    """What to alter about the task's settings."""
    warn: Callable[[str], None] = lambda sentence: None

    @cached_property
    def folder(self) -> RunFolder:
        """The run folder. Raises UserError where there is none."""
        return play.folder_of(self.name)

    @cached_property
    def opened(self) -> TrainedRun:
        """The parameters, in the task with its changes; those of a single seed, the first where none is named."""
        return play.open_one(self.name, self.change, self.warn)
