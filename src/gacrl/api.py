"""The functions of `import gacrl`, beside `preset` and `load_policy`."""

from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

from gacrl import tasks
from gacrl.config import files as configuration
from gacrl.config import presets
from gacrl.config.run import EnvConfig, RunConfig
from gacrl.tasks.spread.environment import Spread
from gacrl.training import session
from gacrl.training.devices import prepare_jax
from gacrl.training.session import Run, Watcher


def train(
    config: RunConfig | None = None,
    seed: int | None = None,
    out: str | Path | None = None,
    watcher: Watcher | None = None,
) -> Run:
    """Train into a new run folder and return the finished run.

    config: the default preset where none is given. seed: replaces the configuration's. out: the run folder,
    by default the next free one under `runs/`. Raises UserError (ConfigError for settings) with one sentence.
    """
    config = presets.preset() if config is None else config
    config = config if seed is None else replace(config, seed=seed)
    prepare_jax(config.num_seeds)
    return session.start(config, None if out is None else Path(out), watcher)


def make_env(name: Literal["spread"] = "spread", **settings: Any) -> Spread:
    """A task in pure functions: `reset(key)`, `step(state, actions, key)`.

    settings: the fields of `gacrl.config.run.EnvConfig`. Raises ConfigError for one there is not, or out of range.
    """
    base = replace(presets.preset(), env=EnvConfig())
    return tasks.make(configuration.from_dict({"env": {"name": name, **settings}}, base).env)
