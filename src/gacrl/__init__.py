"""Learning to coordinate by communicating over a graph.

    import gacrl
    run = gacrl.train("gacrl", env="reference", seed=0)
    silenced = gacrl.evaluate(run, arrives=gacrl.silence())
    policy = run.policy()

The names below load on first use, so that `import gacrl` itself costs nothing.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from gacrl.adapters.jaxmarl import to_jaxmarl
    from gacrl.adapters.pettingzoo import to_pettingzoo
    from gacrl.algorithms.contract import Algorithm
    from gacrl.api import Run, Trainer, evaluate, iterate, make_env, train, trainer
    from gacrl.config.files import preset
    from gacrl.config.run import RunConfig
    from gacrl.envs.environment import Environment, TimeStep, observe
    from gacrl.errors import ConfigError, UserError
    from gacrl.evaluation.summary import Estimate
    from gacrl.messages.interventions import delay, drop, noise, scramble, silence, swap
    from gacrl.play import LoadedPolicy, load_policy
    from gacrl.tasks.foreign.pettingzoo import from_pettingzoo
    from gacrl.tasks.task import Metric, Task
    from gacrl.training.watching import Watcher
    from gacrl.types import Arrives, Intervention

_HOMES = {
    "Algorithm": "gacrl.algorithms.contract",
    "Arrives": "gacrl.types",
    "ConfigError": "gacrl.errors",
    "Environment": "gacrl.envs.environment",
    "Estimate": "gacrl.evaluation.summary",
    "Intervention": "gacrl.types",
    "LoadedPolicy": "gacrl.play",
    "Metric": "gacrl.tasks.task",
    "Run": "gacrl.api",
    "RunConfig": "gacrl.config.run",
    "Task": "gacrl.tasks.task",
    "TimeStep": "gacrl.envs.environment",
    "Trainer": "gacrl.api",
    "UserError": "gacrl.errors",
    "Watcher": "gacrl.training.watching",
    "delay": "gacrl.messages.interventions",
    "drop": "gacrl.messages.interventions",
    "evaluate": "gacrl.api",
    "from_pettingzoo": "gacrl.tasks.foreign.pettingzoo",
    "iterate": "gacrl.api",
    "load_policy": "gacrl.play",
    "make_env": "gacrl.api",
    "noise": "gacrl.messages.interventions",
    "observe": "gacrl.envs.environment",
    "preset": "gacrl.config.files",
    "scramble": "gacrl.messages.interventions",
    "silence": "gacrl.messages.interventions",
    "swap": "gacrl.messages.interventions",
    "to_jaxmarl": "gacrl.adapters.jaxmarl",
    "to_pettingzoo": "gacrl.adapters.pettingzoo",
    "train": "gacrl.api",
    "trainer": "gacrl.api",
}

__all__ = [  # the keys of _HOMES, spelled out for type checkers
    "Algorithm",
    "Arrives",
    "ConfigError",
    "Environment",
    "Estimate",
    "Intervention",
    "LoadedPolicy",
    "Metric",
    "Run",
    "RunConfig",
    "Task",
    "TimeStep",
    "Trainer",
    "UserError",
    "Watcher",
    "delay",
    "drop",
    "evaluate",
    "from_pettingzoo",
    "iterate",
    "load_policy",
    "make_env",
    "noise",
    "observe",
    "preset",
    "scramble",
    "silence",
    "swap",
    "to_jaxmarl",
    "to_pettingzoo",
    "train",
    "trainer",
]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'gacrl' has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOMES})
