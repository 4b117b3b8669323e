"""The functions of `import gacrl`, beside `preset` and `load_policy`."""

from dataclasses import replace
from pathlib import Path
from typing import Any

from gacrl import play, tasks
from gacrl.config import files as configuration
from gacrl.config import presets
from gacrl.config.run import RunConfig
from gacrl.envs.environment import Environment
from gacrl.tasks import own
from gacrl.training import session
from gacrl.training.devices import prepare_jax
from gacrl.training.session import Run, Watcher


def train(
    config: RunConfig | str | None = None,
    seed: int | None = None,
    out: str | Path | None = None,
    watcher: Watcher | None = None,
    env: Any = None,
    begin_from: str | Path | None = None,
) -> Run:
    """Train into a new run folder and return the finished run.

    config: settings, or the name of a preset; the default preset where none is given. seed: replaces the
    configuration's. out: the run folder, by default the next free one under `runs/`. env: a task's name,
    `FILE.py:NAME`, a `Task`, an `Environment` (its class or an instance); by default the configuration's. begin_from: a
    run whose policy this one starts with. Raises UserError (ConfigError for settings) with one sentence.
    """
    config = presets.preset() if config is None else config
    config = presets.preset(config) if isinstance(config, str) else config
    config = config if seed is None else replace(config, seed=seed)
    prepare_jax(config.num_seeds)
    if env is not None:
        name, settings = own.bring(env)
        config = (
            config if name == config.task and isinstance(env, str) else replace(config, task=name, env=settings)
        )
    brought = tasks.brought(config.task)
    with own.blamed(None if brought is None else brought.source):
        parent = None if begin_from is None else play.parent(begin_from)
        return session.start(config, None if out is None else Path(out), watcher, parent)


def make_env(name: str = tasks.DEFAULT, **settings: Any) -> Environment:
    """A task in pure functions: `reset(key, params)`, `step(state, actions, key, params)`.

    name: as `train` takes it. settings: those of the task. Raises ConfigError for one there is not, or out of range.
    """
    found, _ = own.bring(name)
    config = configuration.from_dict({"env": {"name": found, **settings}})
    return tasks.find(found).make(config.env)
