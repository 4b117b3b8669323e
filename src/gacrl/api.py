"""The functions of `import gacrl`: train, evaluate, and the loop in one's own hands."""

import contextlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple, SupportsIndex

import numpy as np
from jaxtyping import Array, Float

from gacrl import play, tasks
from gacrl.config import files as configuration
from gacrl.config.checks import require_kind, whole
from gacrl.config.presets import label
from gacrl.config.run import RunConfig
from gacrl.envs.environment import Environment, typed_keys
from gacrl.errors import ConfigError
from gacrl.evaluation import evaluate as playing
from gacrl.evaluation.summary import Estimate, estimated
from gacrl.experiments import scoring
from gacrl.messages import interventions
from gacrl.tasks import own
from gacrl.training import build, loop, session, trackers
from gacrl.training.devices import prepare_jax
from gacrl.training.loop import Progress
from gacrl.training.recorder import RunFolder
from gacrl.training.telling import teller
from gacrl.training.trackers.following import tracked
from gacrl.training.trainer import AbstractTrainer, ChunkReport, TrainState
from gacrl.training.trainer import Trainer as CompiledTrainer
from gacrl.training.watching import Watcher
from gacrl.types import Arrives, Intervention, PRNGKey


@dataclass(frozen=True, repr=False)
class Run:
    """A run that has come to an end, planned or not."""

    folder: Path
    config: RunConfig
    env_steps: int
    """Environment steps of each seed."""
    summary: dict[str, Any] | None
    """The content of `summary.json`; None where the run was stopped before its end."""

    @cached_property
    def metrics(self) -> dict[str, np.ndarray]:
        """The greedy evaluations along the way: `env_steps` [K], and every metric [seeds, K]."""
        rows = RunFolder(self.folder).metrics()
        steps = sorted({row["env_steps"] for row in rows})
        found = {(row["seed"], row["env_steps"]): row["greedy"] for row in rows}
        curves = {
            name: np.array([[found[seed, step][name] for step in steps] for seed in self.config.seeds], float)
            for name in (rows[0]["greedy"] if rows else ())
        }
        return {"env_steps": np.array(steps), **curves}

    def policy(self, seed: int = 0, **settings: Any) -> play.LoadedPolicy:
        """Load the policy of a seed, counted from 0, as `load_policy` does."""
        return play.load_policy(f"{self.folder}@{seed}", **settings)

    def __repr__(self) -> str:
        task, steps = tasks.find(self.config.task), f"{self.env_steps:,} environment steps"
        seeds = ", ".join(map(str, self.config.seeds[:5])) + (", …" if len(self.config.seeds) > 5 else "")
        reached = "stopped before its end: go on with `gacrl resume`"
        if self.summary:
            final = self.summary["final"]["greedy"]
            shown = {name: label for name, label in task.shown(list(final)).items() if name in final}
            reached = ", ".join(f"{label} {final[name]['mean']:.3g}" for name, label in shown.items())
        return f"Run {self.folder}\n  {label(self.config)} on {task.name}, seeds {seeds}, {steps}\n  {reached}"


def train(
    config: RunConfig | str | None = None,
    seed: SupportsIndex | None = None,
    out: str | Path | None = None,
    watcher: Watcher | None = None,
    env: Any = None,
    begin_from: "str | Path | Run | None" = None,
    quiet: bool = False,
    track: str | Sequence[str] = (),
) -> Run:
    """Train into a new run folder and return the finished run.

    config: settings, or the name of a preset; the default preset where none is given. seed: replaces the
    configuration's. out: the run folder, by default the next free one under `runs/`. watcher: hears of it, beside the
    lines that are printed unless `quiet`. env: a task's name, `FILE.py:NAME`, a `Task`, an `Environment` (its class or
    an instance); by default the configuration's. begin_from: a run whose policy this one starts with. track: trackers
    by name, "csv,tensorboard". Raises UserError (ConfigError for settings) with one sentence.
    """
    require_kind(
        "watcher", watcher, (Watcher, type(None)), "a gacrl.Watcher, such as gacrl.Watcher(progress=print)"
    )
    require_kind("out", out, (str, Path, type(None)), "the path of a new folder")
    config = settled(config, seed, env)
    watching = (Watcher() if quiet else teller(config)) + (watcher or Watcher())
    with own.blamed(_source(config)), tracked(trackers.chosen(track), watching.warn) as tracking:
        parent = None if begin_from is None else play.parent(play.name_of(begin_from))
        ended = session.start(config, None if out is None else Path(out), watching + tracking, parent)
    return Run(ended.folder, ended.config, ended.env_steps, ended.summary)


def settled(
    config: RunConfig | str | None = None, seed: SupportsIndex | None = None, env: Any = None
) -> RunConfig:
    """Return the settings that a preset's name, or settings, a seed and a task stand for. Raises ConfigError."""
    if config is None or isinstance(config, str):
        config = configuration.preset() if config is None else configuration.preset(config)
    require_kind("config", config, (RunConfig,), "a preset's name or its settings, gacrl.preset('gacrl')")
    config = config if seed is None else replace(config, seed=whole(seed, "run.seed"))
    prepare_jax(config.num_seeds)
    if env is None:
        return config
    name, settings = own.bring(env)
    return config if name == config.task and isinstance(env, str) else replace(config, task=name, env=settings)


def evaluate(
    run: "str | Path | Run",
    episodes: SupportsIndex = 320,
    arrives: Intervention | Arrives | str | None = None,
    sampled: bool = False,
    env: Any = None,
    **settings: Any,
) -> dict[str, Estimate]:
    """Play the fixed episodes that `gacrl evaluate` plays, and return every metric with its 95 % interval.

    run: a run, its folder, `FOLDER@k`, `pretrained:NAME`, or a scripted policy such as `random` in the task `env`.
    arrives: what happens to messages: `gacrl.silence([0])`, or in words "drop 0.2". sampled: with exploration, instead
    of greedily. settings: of the task, where they differ from those of training (num_agents=10). The interval is over
    the seeds; of a single one, over its episodes. Raises UserError.
    """
    name = None if env is None else own.bring(env)[0]
    played = scoring.play(
        play.name_of(run), episodes, changing(settings), interventions.of(arrives), sampled, name
    )
    return {metric: estimated(values) for metric, values in played.items()}


def iterate(
    config: RunConfig | str | None = None, seed: SupportsIndex | None = None, env: Any = None
) -> Iterator[Progress]:
    """Train without a run folder, and yield after every chunk and its evaluation: the loop in your hands.

    Arguments as those of `train`; `evaluation.interval` says how long a chunk is. Raises ConfigError.
    """
    config = settled(config, seed, env)
    trainer = build.make_trainer(config)
    return _closed_after(trainer, loop.train(trainer, config, trainer.init(config.seeds)))


def _closed_after(trainer: AbstractTrainer, steps: Iterator[Progress]) -> Iterator[Progress]:
    """The steps; processes that environments live in end with them."""
    with contextlib.closing(trainer):
        yield from steps


class Trainer(NamedTuple):
    """Training as pure functions of one seed, to jit and vmap yourself."""

    init: Callable[[PRNGKey], TrainState]
    """A fresh training state."""
    chunk: Callable[[TrainState, Any], tuple[TrainState, ChunkReport]]
    """(state, updates) -> the state after so many updates, and what they showed."""
    evaluate: Callable[[TrainState, PRNGKey], dict[str, Float[Array, " K"]]]
    """(state, key) -> the metrics of K greedy episodes."""


def trainer(
    config: RunConfig | str | None = None, env: Any = None, episodes: SupportsIndex | None = None
) -> Trainer:
    """Make the functions that train one seed. episodes: of an evaluation; by default as configured.

    >>> trainer = gacrl.trainer("ippo", env="reference")
    >>> states = jax.vmap(trainer.init)(jax.random.split(key, 8))
    >>> states, _ = jax.jit(jax.vmap(trainer.chunk, (0, None)))(states, 100)
    """
    config = replace(settled(config, None, env), num_seeds=1)
    built = build.make_trainer(config)
    if not isinstance(built, CompiledTrainer):
        raise ConfigError(
            f"{config.task} lives in Python, and cannot be compiled: take gacrl.iterate or gacrl.train"
        )
    count = config.evaluation.num_episodes if episodes is None else whole(episodes, "episodes", 1)

    def evaluate(state: TrainState, key: PRNGKey) -> dict[str, Float[Array, " K"]]:
        return playing.evaluate(
            built.evaluation_env,
            built.algorithm.policy(state.learner, False),
            built.memory,
            built.evaluation_params,
            key,
            count,
            built.intervention,
            built.metrics,
        )

    def init(key: PRNGKey) -> TrainState:
        return built.init_member(typed_keys(key), built.algorithm.hyper)

    return Trainer(init, built.chunk_of_one, evaluate)


def make_env(name: Any = tasks.DEFAULT, **settings: Any) -> Environment:
    """Make a task in pure functions: `reset(key, params)`, `step(state, actions, key, params)`.

    name: as `train` takes it. settings: those of the task. Raises ConfigError for one there is not, or out of range.
    """
    found, _ = own.bring(name)
    config = configuration.from_dict({"env": {"name": found, **settings}})
    return tasks.find(found).make(config.env)


def changing(settings: dict[str, Any]) -> Callable[[Any], Any]:
    """Return what changes these settings of a task. It raises ConfigError for one that the task does not have."""

    def change(task_settings: Any) -> Any:
        return configuration.changed(task_settings, settings)

    return change


def _source(config: RunConfig) -> Path | None:
    """The file that the task comes from, to name its lines where they raise."""
    brought = tasks.brought(config.task)
    return None if brought is None else brought.source
