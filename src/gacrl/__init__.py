"""Learning to coordinate by communicating over a graph.

    import gacrl
    run = gacrl.train(gacrl.preset("paper"), seed=0)
    policy = gacrl.load_policy(run.folder)

The names below load on first use, so that `import gacrl` itself costs nothing.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from gacrl.algorithms.contract import Algorithm
    from gacrl.api import make_env, train
    from gacrl.config.presets import preset
    from gacrl.config.run import RunConfig
    from gacrl.envs.environment import Environment, TimeStep, observe
    from gacrl.errors import ConfigError, UserError
    from gacrl.play import LoadedPolicy, load_policy
    from gacrl.tasks.task import Metric, Task
    from gacrl.training.session import Run, Watcher

_HOMES = {
    "Algorithm": "gacrl.algorithms.contract",
    "ConfigError": "gacrl.errors",
    "Environment": "gacrl.envs.environment",
    "LoadedPolicy": "gacrl.play",
    "Metric": "gacrl.tasks.task",
    "Run": "gacrl.training.session",
    "RunConfig": "gacrl.config.run",
    "Task": "gacrl.tasks.task",
    "TimeStep": "gacrl.envs.environment",
    "UserError": "gacrl.errors",
    "Watcher": "gacrl.training.session",
    "load_policy": "gacrl.play",
    "make_env": "gacrl.api",
    "observe": "gacrl.envs.environment",
    "preset": "gacrl.config.presets",
    "train": "gacrl.api",
}

__all__ = [  # the keys of _HOMES, spelled out for type checkers
    "Algorithm",
    "ConfigError",
    "Environment",
    "LoadedPolicy",
    "Metric",
    "Run",
    "RunConfig",
    "Task",
    "TimeStep",
    "UserError",
    "Watcher",
    "load_policy",
    "make_env",
    "observe",
    "preset",
    "train",
]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'gacrl' has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOMES})
