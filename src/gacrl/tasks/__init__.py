"""Tasks by name: ours, and those that a user brings.

A leaf: it imports no jax, and a task only when somebody needs it. A task from outside is at hand once this process
was given it (`bring`); a run folder alone never loads one.
"""

import shlex
from collections.abc import Mapping
from dataclasses import dataclass, fields
from importlib import import_module
from pathlib import Path
from types import MappingProxyType
from typing import Any

from gacrl.config.checks import unknown
from gacrl.errors import ConfigError
from gacrl.tasks.task import Task

DEFAULT = "spread"
OWN_FILE = "gacrl_own_"
"""The names of modules made of users' files begin so."""

_OURS: Mapping[str, tuple[str, str, str]] = MappingProxyType(
    {
        "spread": ("gacrl.tasks.spread", "SpreadSettings", "TASK"),
        "scouts": ("gacrl.tasks.spread", "ScoutsSettings", "SCOUTS"),
        "speaker_listener": ("gacrl.tasks.navigation", "SpeakerListenerSettings", "SPEAKER_LISTENER"),
        "reference": ("gacrl.tasks.navigation", "ReferenceSettings", "REFERENCE"),
        "colours": ("gacrl.tasks.navigation", "ColoursSettings", "COLOURS"),
        "traffic_junction": ("gacrl.tasks.traffic", "TrafficSettings", "TASK"),
    }
)
"""Per name: the folder, whose `settings` hold a class of this name, and whose `task` holds this record."""


@dataclass(frozen=True)
class Own:
    """A task from outside, as it was given."""

    task: Task
    settings: Any
    """Those that stand where none are said."""
    source: Path | None = None
    """The file that it came from."""
    given: Path | None = None
    """That file as it was named."""
    digest: str | None = None
    """SHA-256 of that file."""


_OWN: dict[str, Own] = {}


def names() -> list[str]:
    """Return the tasks that are at hand: ours first."""
    return [*_OURS, *_OWN]


def bring(own: Own) -> None:
    """Have a task from outside at hand. Raises ConfigError for a name of ours."""
    if own.task.name in _OURS:
        raise ConfigError(f"there is a task {own.task.name!r} already: give yours another name")
    _OWN[own.task.name] = own


def brought(name: str) -> Own | None:
    """Return a task from outside; None for one of ours, or one that is not at hand."""
    return _OWN.get(name)


def find(name: str) -> Task:
    """Return the task of that name. Raises ConfigError with the nearest name where it is not at hand."""
    if name in _OURS:
        folder, _, record = _OURS[name]
        return getattr(import_module(f"{folder}.task"), record)
    _require_at_hand(name)
    return _OWN[name].task


def default_settings(name: str) -> Any:
    """Return the settings of that task as they stand where nothing is said. Raises ConfigError."""
    if name in _OURS:
        folder, kind, _ = _OURS[name]
        return getattr(import_module(f"{folder}.settings"), kind)()
    _require_at_hand(name)
    return _OWN[name].settings


def ours(settings: Any) -> tuple[str, Any] | None:
    """Return the name and settings of one of our tasks, from its settings or its environment; None for anything
    else.
    """
    kinds = {name: type(default_settings(name)) for name in _OURS}
    matching = [name for name, kind in kinds.items() if isinstance(settings, kind)]
    if not matching:
        return None
    name = max(matching, key=lambda name: len(kinds[name].__mro__))  # one task may build on another's settings
    return name, kinds[name](**{field.name: getattr(settings, field.name) for field in fields(kinds[name])})


def flag(name: str, as_given: bool = False) -> str:
    """Return what a command needs besides to find this task again: nothing for the default one.

    as_given: with its file as it was named, for a page that others read.
    """
    own = _OWN.get(name)
    if own is not None and ":" in name:
        return f" --env {shlex.quote(name)}"
    if own is not None:
        source = own.given if as_given else own.source
        return " --env " + shlex.quote(f"{source or 'FILE.py'}:{name}")
    return "" if name == DEFAULT else f" --env {name}"


def _require_at_hand(name: str) -> None:
    if name not in _OWN:
        hint = "a task of your own is --env FILE.py:NAME, in Python env="
        raise ConfigError(unknown("task", name, names(), hint))
