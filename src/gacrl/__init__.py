"""Learning to coordinate by communicating over a graph.

    import gacrl
    run = gacrl.train(gacrl.preset("paper"), seed=0)
    policy = gacrl.load_policy(run.folder)

The names below load on first use, so that `import gacrl` itself costs nothing.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from gacrl.api import make_env, train
    from gacrl.config.presets import preset
    from gacrl.config.run import RunConfig
    from gacrl.errors import ConfigError, UserError
    from gacrl.play import LoadedPolicy, load_policy
    from gacrl.training.session import Run

_HOMES = {
    "ConfigError": "gacrl.errors",
    "LoadedPolicy": "gacrl.play",
    "Run": "gacrl.training.session",
    "RunConfig": "gacrl.config.run",
    "UserError": "gacrl.errors",
    "load_policy": "gacrl.play",
    "make_env": "gacrl.api",
    "preset": "gacrl.config.presets",
    "train": "gacrl.api",
}

__all__ = [  # the keys of _HOMES, spelled out for type checkers
    "ConfigError",
    "LoadedPolicy",
    "Run",
    "RunConfig",
    "UserError",
    "load_policy",
    "make_env",
    "preset",
    "train",
]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'gacrl' has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOMES})
