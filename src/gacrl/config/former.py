"""Settings as earlier versions wrote them, in today's names: runs and files made before still load."""

from collections.abc import Mapping
from typing import Any

from gacrl import tasks
from gacrl.errors import ConfigError

_RENAMED = {"epsilon_steps": "exploration_steps", "yoked_coverage": "yoked_progress"}
"""Of the algorithm, since version 0.1.0."""
_PRESETS = {"gacrl-talk": "gacrl"}
"""`gacrl` with a told critic, which it has by itself now where a task needs talk."""
_RADIUS = "0.2"
"""Of the coverage that 0.1.0's exploration followed unless it was told otherwise; it is spread's progress now."""


def converted(data: Mapping[str, Any]) -> dict[str, Any]:
    """Return plain settings in today's names. Raises ConfigError for what no version since 0.1.0 does as it did."""
    found = {name: dict(part) if isinstance(part, Mapping) else part for name, part in data.items()}
    preset, algorithm = found.get("preset"), found.get("algorithm")
    if isinstance(preset, str) and preset in _PRESETS:
        found["preset"] = _PRESETS[preset]
    if isinstance(algorithm, dict):
        _convert_algorithm(algorithm)
    _move_settings_of_tasks(found)
    return found


def _convert_algorithm(algorithm: dict[str, Any]) -> None:
    for before, now in _RENAMED.items():
        if before in algorithm:
            algorithm[now] = algorithm.pop(before)
    if algorithm.get("name") == "qmix" and "mixer" in algorithm:  # VDN and IQL were kinds of it
        algorithm["name"] = algorithm.pop("mixer")
        if algorithm["name"] != "qmix":
            algorithm.pop("mixer_width", None)
    if algorithm.pop("coverage_radius", _RADIUS) != _RADIUS:
        raise ConfigError(
            "algorithm.coverage_radius was a setting of gacrl 0.1.0, of a run that later versions cannot go on with: "
            f"exploration follows the coverage within {_RADIUS} now"
        )


def _move_settings_of_tasks(found: dict[str, Any]) -> None:
    env, curriculum = found.get("env", {}), found.get("curriculum")
    name = env.get("name", tasks.DEFAULT) if isinstance(env, dict) else None
    if not isinstance(curriculum, dict) or not isinstance(name, str) or name not in tasks.names():
        return
    moves: Mapping[str, str] = getattr(type(tasks.default_settings(name)), "FORMERLY", {})
    before = [setting.partition(".")[2] for setting in moves if setting.partition(".")[2] in curriculum]
    if before and curriculum.get("gate") is not None:
        raise ConfigError(
            "curriculum.gate of gacrl 0.1.0 followed the coverage within θ, which later versions do not: a run with it "
            "cannot go on; in a file of your own, move curriculum's ends and starts to env"
        )
    for setting in before:
        found["env"] = {**env, **found.get("env", {}), setting: curriculum.pop(setting)}
