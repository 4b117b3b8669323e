"""How the settings of a run load and save: to and from plain data, with an error that names what is wrong."""

import copy
import dataclasses
import hashlib
import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, get_type_hints

from gacrl import tasks
from gacrl.config import presets
from gacrl.config.algorithms import ALGORITHMS
from gacrl.config.checks import require, typed, unknown
from gacrl.config.former import converted
from gacrl.config.run import RunConfig
from gacrl.errors import ConfigError, reason


def preset(name: str = presets.DEFAULT_PRESET, **changes: Any) -> RunConfig:
    """Return the settings of a preset, with these changes.

    >>> gacrl.preset("gacrl", **{"algorithm.learning_rate": 1e-3, "env.num_agents": 5})

    Raises ConfigError for a preset or a setting that there is not, with the nearest name, and for a value that does
    not fit.
    """
    base = presets.preset(_text(name, "the preset"))
    data: dict[str, Any] = {}
    for dotted, value in sorted(changes.items(), key=lambda change: change[0].count(".")):
        *sections, setting = dotted.split(".")
        inner: Any = data
        for section in sections:
            inner = inner.setdefault(section, {})
            require(isinstance(inner, dict), f"{dotted} cannot be set beside {section}={inner!r}: leave one out")
        inner[setting] = copy.deepcopy(value)  # further changes may lie inside it
    return from_dict(data, base)


def to_dict(config: RunConfig) -> dict[str, Any]:
    """Return the settings as plain data, complete; the names of algorithm and task stand among their settings."""
    data = dataclasses.asdict(config)
    task = data.pop("task")
    return {
        **data,
        "algorithm": {"name": config.algorithm.name, **data["algorithm"]},
        "env": {"name": task, **data["env"]},
    }


def from_dict(data: Mapping[str, Any], base: RunConfig | None = None) -> RunConfig:
    """Make settings from plain data over a base (the preset that the data names, else the default one).

    Raises ConfigError for an unknown key (with the nearest known one), a value of the wrong type, or a task that is
    not at hand.
    """
    data = converted(data)
    named = presets.preset(_text(data.get("preset", presets.DEFAULT_PRESET), "preset"))
    base = named if base is None else base
    if isinstance(data.get("algorithm"), Mapping) and "name" in data["algorithm"]:
        settings = dict(data["algorithm"])
        name = _text(settings.pop("name"), "algorithm.name")
        if name not in ALGORITHMS:
            raise ConfigError(unknown("algorithm", name, ALGORITHMS))
        if name != base.algorithm.name:
            base = replace(base, algorithm=ALGORITHMS[name].settings())
        data["algorithm"] = settings
    if isinstance(data.get("env"), Mapping) and "name" in data["env"]:
        settings = dict(data["env"])
        base = on_task(base, _text(settings.pop("name"), "env.name"))
        data["env"] = settings
    return _merge(base, data, "")


def on_task(config: RunConfig, name: str) -> RunConfig:
    """Return the configuration for another task, with that task's settings.

    With memory where the task needs it, and with a critic that is told where the task needs talk. As it is where the
    task is the same. Raises ConfigError for a task that is not at hand.
    """
    if name == config.task:
        return config
    task, on = tasks.find(name), replace(config, task=name, env=tasks.default_settings(name))
    network = getattr(config.algorithm, "network", None)
    if network is not None and task.needs_memory:
        on = replace(on, algorithm=replace(on.algorithm, network=replace(network, recurrent=True)))
    return with_critic(on, "told") if task.needs_talk else on


def with_critic(config: RunConfig, critic: Literal["told", "central"]) -> RunConfig:
    """Return the settings with a critic that is told what others see, or a central one, where it is one of the two."""
    if getattr(config.algorithm, "critic", None) not in ("told", "central"):
        return config
    return replace(config, algorithm=replace(config.algorithm, critic=critic))


def changed(settings: Any, changes: Mapping[str, Any]) -> Any:
    """Return a task's settings with these changes. Raises ConfigError for a setting it does not have."""
    return _merge(settings, changes, "env.")


def load(path: Path, base: RunConfig | None = None) -> RunConfig:
    """Read settings from a JSON file (as `config.json` of a run folder, or a part of it) over a base.

    Without a base: over the preset that the file names. Raises ConfigError.
    """
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        mend = "`gacrl config` prints one to start from"
        raise ConfigError(f"cannot read the configuration {path}: {reason(error)}; {mend}") from error
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"{path} is not JSON: {error}") from error
    if not isinstance(data, dict):
        raise ConfigError(f"{path} must hold a JSON object of settings")
    try:
        return from_dict(data, base)  # pyright: ignore[reportUnknownArgumentType]
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error


def dumps(config: RunConfig) -> str:
    """Return the settings as the text of a loadable file."""
    return json.dumps(to_dict(config), indent=2) + "\n"


def fingerprint(settings: RunConfig | Mapping[str, Any]) -> str:
    """Return a hash of every setting but the run's length, which may be extended, and the processes that its
    environments are spread over: what a checkpoint belongs to.

    Of plain data: of the settings that stand in it, whatever further ones there are by now, so that a run made before
    a setting was added can still go on.
    """
    plain = to_dict(settings) if isinstance(settings, RunConfig) else settings
    free = ("env_steps", "env_processes")
    data = {**plain, "training": {k: v for k, v in plain.get("training", {}).items() if k not in free}}
    return hashlib.sha256(json.dumps(data, sort_keys=True).encode()).hexdigest()[:16]


def _text(value: Any, where: str) -> str:
    if not isinstance(value, str):
        raise ConfigError(f"{where} must be a name, not {value!r}")
    return value


def _merge(settings: Any, data: Mapping[str, Any], where: str) -> Any:
    """`settings`, a dataclass, with the values that `data` names."""
    hints = get_type_hints(type(settings))
    fields = {f.name for f in dataclasses.fields(settings)} - {"task"}
    changes: dict[str, Any] = {}
    for key, value in data.items():
        if key not in fields:
            raise ConfigError(unknown("setting", where + key, {where + name for name in fields}))
        current = getattr(settings, key)
        if dataclasses.is_dataclass(current):
            if not isinstance(value, Mapping):
                raise ConfigError(f"{where}{key} must be an object of settings, not {value!r}")
            changes[key] = _merge(current, value, f"{where}{key}.")  # pyright: ignore[reportUnknownArgumentType]
        else:
            changes[key] = typed(value, hints[key], where + key)
    return replace(settings, **changes)
