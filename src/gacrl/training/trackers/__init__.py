"""Readers of a training that write it down elsewhere, by name: `--track csv,tensorboard`.

A tracker is a module of its own with `begin(folder, config) -> Sink`, imported by the thread that feeds it.
"""

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

from gacrl.config.checks import unknown
from gacrl.errors import ConfigError
from gacrl.extras import require_extra


class Tracker(NamedTuple):
    """Where a training can be written down."""

    module: str
    package: str | None
    """What must be installed for it, of the extra `track`."""
    what: str


TRACKERS: Mapping[str, Tracker] = MappingProxyType(
    {
        "csv": Tracker("gacrl.training.trackers.csv", None, "progress.csv in the run folder"),
        "tensorboard": Tracker(
            "gacrl.training.trackers.tensorboard", "tensorboard", "event files in the run folder"
        ),
        "trackio": Tracker("gacrl.training.trackers.boards", "trackio", "a local store, shown by `trackio show`"),
        "wandb": Tracker("gacrl.training.trackers.boards", "wandb", "offline, for `wandb sync`"),
    }
)


def chosen(names: str | Sequence[str]) -> tuple[str, ...]:
    """Return the trackers of a list, or of names with commas between them, each once.

    Raises ConfigError for a name that is none, and UserError for one whose package is missing.
    """
    words = names.split(",") if isinstance(names, str) else list(names)
    found = tuple(dict.fromkeys(word.strip() for word in words if word.strip()))
    for name in found:
        if name not in TRACKERS:
            raise ConfigError(unknown("tracker", name, list(TRACKERS)))
        package = TRACKERS[name].package
        if package is not None:
            require_extra("track", package)
    return found
