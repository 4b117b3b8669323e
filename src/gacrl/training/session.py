"""A run from its settings to its summary: what the command line and `gacrl.train` both call."""

import platform
import subprocess
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh

from gacrl import config as configuration
from gacrl import envs, render
from gacrl.algorithm_config import PpoConfig
from gacrl.algorithms import algorithm as algorithms
from gacrl.config import RunConfig
from gacrl.envs import scripted
from gacrl.envs.spread import Spread
from gacrl.errors import UserError, reason
from gacrl.evaluation import episodes
from gacrl.evaluation.evaluate import evaluate, stream_key
from gacrl.evaluation.summary import normalised, over_seeds
from gacrl.training import checkpoint, curriculum
from gacrl.training.devices import (
    anyone,
    gathered,
    leads,
    mesh_for,
    one_seed,
    same_everywhere,
    shard_seeds,
    without_padding,
)
from gacrl.training.loop import Clock, Progress, train
from gacrl.training.recorder import RunFolder
from gacrl.training.trainer import Trainer, TrainState
from gacrl.types import Learner

SHOWN_EPISODES = 4
"""Episodes that a run keeps, and shows in its GIF."""


@dataclass(frozen=True)
class Run:
    """A run that has come to an end, planned or not."""

    folder: Path
    config: RunConfig
    env_steps: int
    summary: dict[str, Any] | None
    """The content of `summary.json`; None where the run was stopped before its end. Empty in processes that do not
    write."""


@dataclass(frozen=True)
class Plan:
    """What a run is going to be: known before anything is allocated or compiled."""

    parameters: int
    """Numbers that a seed's network learns."""
    bytes_per_seed: int
    """Memory of a seed's training state (networks, optimiser, replay, environments)."""
    devices: tuple[str, ...]


@dataclass(frozen=True)
class Watcher:
    """What a run tells whoever looks on, and asks: all of it optional."""

    planned: Callable[[RunFolder, RunConfig, Plan], None] = lambda folder, config, plan: None
    compiling: Callable[[], None] = lambda: None
    progress: Callable[[Progress], None] = lambda progress: None
    finishing: Callable[[], None] = lambda: None
    warn: Callable[[str], None] = lambda sentence: None
    stop: Callable[[], bool] = lambda: False


def build(config: RunConfig) -> Trainer:
    """The compiled functions that train this configuration."""
    env = envs.make(config.env)
    return Trainer(
        algorithm=algorithms.make(config.algorithm, env, config.training),
        env=env,
        curriculum=curriculum.make(config.curriculum, config.env),
        num_envs=config.training.num_envs,
        num_steps=config.training.num_steps,
        num_seeds=config.num_seeds,
        evaluation_env=evaluation_env(config),
        mesh=mesh(config),
    )


def mesh(config: RunConfig) -> Mesh:
    """The devices that train this configuration: PPO learns from environments that are spread over several."""
    return mesh_for(
        config.num_seeds, config.training.num_envs if isinstance(config.algorithm, PpoConfig) else None
    )


def evaluation_env(config: RunConfig) -> Spread:
    """The task as it is evaluated: with the evaluation's own horizon, where it has one."""
    env, horizon = envs.make(config.env), config.evaluation.horizon
    return env if horizon is None else replace(env, max_cycles=horizon)


def plan(trainer: Trainer, config: RunConfig) -> Plan:
    """Count what a run needs, without allocating it."""
    member = _member_shapes(trainer)
    size = sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(member))
    network = getattr(member.learner, "network", ())
    return Plan(
        parameters=sum(leaf.size for leaf in jax.tree.leaves(network)),
        bytes_per_seed=size,
        devices=tuple(f"{device.platform}:{device.id}" for device in trainer.mesh.devices.flat),
    )


def start(config: RunConfig, out: Path | None = None, watcher: Watcher | None = None) -> Run:
    """Train from the beginning, into a new run folder."""
    mesh(config)  # refuses, before there is a folder, what the devices cannot share
    folder = RunFolder.create(out, config) if leads() else RunFolder(out or Path("runs"))
    with folder.locked() if leads() else nullcontext():
        return _run(folder, config, None, watcher or Watcher(), configuration.fingerprint(config))


def resume(path: Path, extend: int | None = None, watcher: Watcher | None = None) -> Run:
    """Go on where a run stopped; with `extend`, up to that many environment steps beyond its end."""
    watcher = watcher or Watcher()
    folder = RunFolder.open(path)
    mesh(folder.config())
    with folder.locked() if leads() else nullcontext():
        config = folder.config()
        fingerprint = configuration.fingerprint(folder.settings())
        found: checkpoint.Checkpoint | None = None
        if any(folder.checkpoints.glob("step-*")):
            found, warnings = checkpoint.newest(folder.checkpoints)
            for warning in warnings:
                watcher.warn(warning)
            if found.fingerprint != fingerprint:
                raise UserError(
                    f"{found.folder} was trained with other settings than {folder.config_file} now says: "
                    "put the file back as it was, or train into a new folder"
                )
        if not same_everywhere(-1 if found is None else found.env_steps):
            raise UserError(f"the processes see different checkpoints in {folder.path}: put it where all share it")
        if extend is not None:
            steps = config.training.env_steps + extend
            config = replace(config, training=replace(config.training, env_steps=steps))
            if leads():
                folder.extend(steps)
        return _run(folder, config, found, watcher, fingerprint)


def _run(
    folder: RunFolder,
    config: RunConfig,
    found: checkpoint.Checkpoint | None,
    watcher: Watcher,
    fingerprint: str,
) -> Run:
    trainer = build(config)
    watcher.planned(folder, config, plan(trainer, config))
    try:
        if leads():
            folder.forget_metrics_after(0 if found is None else found.env_steps)
        if found is None:
            env_steps, clock, state = 0, Clock(), trainer.init(config.seeds)
        else:
            env_steps, clock = found.env_steps, Clock(**found.counters)
            saved = checkpoint.load(found, _stacked_shapes(trainer))
            state = shard_seeds(saved, config.num_seeds, trainer.mesh)
        for progress in train(trainer, config, state, env_steps, clock, watcher.compiling):
            env_steps, state, clock = progress.env_steps, progress.state, progress.clock
            everything = gathered(state)
            if leads():
                folder.append_metrics(list(progress.rows))
                whole = without_padding(everything, config.num_seeds)
                checkpoint.save(folder.checkpoints, whole, env_steps, fingerprint, vars(clock))
            watcher.progress(progress)
            if anyone(watcher.stop()) and not progress.done:
                return Run(folder.path, config, env_steps, None)
        watcher.finishing()
        summary = _finish(folder, config, trainer, state, env_steps, clock)
    except OSError as error:
        raise UserError(
            f"cannot write to {folder.path}: {reason(error)}; make room there or allow writing, "
            f"then `gacrl resume {folder.path}` goes on from the last checkpoint"
        ) from error
    return Run(folder.path, config, env_steps, summary)


def _finish(
    folder: RunFolder, config: RunConfig, trainer: Trainer, state: TrainState, env_steps: int, clock: Clock
) -> dict[str, Any]:
    """The closing evaluation, some episodes to look at, and the summary."""
    num_episodes = config.evaluation.final_episodes
    env = evaluation_env(config)
    final = {
        kind: jax.device_get(gathered(trainer.evaluate(state.learner, kind == "sampled", "report", num_episodes)))
        for kind in ("greedy", "sampled")
    }
    learner = one_seed(gathered(state.learner), 0)
    if not leads():
        return {}
    references = evaluate_scripted(env, num_episodes)
    members = len(config.seeds)
    summary = {
        "preset": config.preset,
        "seeds": list(config.seeds),
        "env_steps": env_steps,
        "final": {
            kind: normalised(over_seeds({name: v.mean(1)[:members] for name, v in values.items()}), references)
            for kind, values in final.items()
        },
        "references": references,
        "episodes": num_episodes,
        "horizon": env.max_cycles,
        "steps_per_second": clock.steps_per_second,
        "compile_seconds": clock.compiling,
        "wall_seconds": clock.wall,
        "versions": versions(),
    }
    folder.write_summary(summary)
    policy = trainer.algorithm.policy(learner, False)
    shown = episodes.record_many(
        env, policy, trainer.memory, env.default_params(), stream_key("report"), SHOWN_EPISODES
    )
    for number, episode in enumerate(shown):
        episode.save(folder.episodes / f"{number}.npz")
    render.gif(shown, folder.gif, title=f"{config.preset}, seed {config.seed}")
    return summary


def evaluate_scripted(env: Spread, num_episodes: int) -> dict[str, dict[str, float]]:
    """The metrics of random, noop and oracle on the very starts of the closing evaluation."""
    return {name: play_scripted(name, env, num_episodes) for name in scripted.SCRIPTED}


def play_scripted(name: str, env: Spread, num_episodes: int) -> dict[str, float]:
    """The metrics of one scripted policy there."""
    metrics = scripted_program(name, env, num_episodes)(env.default_params(), stream_key("report"))
    return {metric: float(np.mean(values)) for metric, values in metrics.items()}


@cache
def scripted_program(name: str, env: Spread, num_episodes: int) -> Callable[..., dict[str, jax.Array]]:
    """A scripted policy's evaluation, traced once a process."""
    actor = scripted.make(name, env)
    return jax.jit(
        lambda params, key: evaluate(env, actor.policy, actor.initial_memory, params, key, num_episodes)
    )


def versions() -> dict[str, str]:
    """What produced a run: packages, Python, and the commit where the source is a git checkout."""
    packages = ("gacrl", "jax", "jaxlib", "equinox", "optax", "numpy", "mpe2")
    found = {name: metadata.version(name) for name in packages}
    git = ["git", "-C", str(Path(__file__).parent), "rev-parse", "HEAD"]
    try:
        done = subprocess.run(git, capture_output=True, text=True, timeout=5, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return {**found, "python": platform.python_version()}
    commit = {"git_commit": done.stdout.strip()} if done.returncode == 0 else {}
    return {**found, "python": platform.python_version(), **commit}


def _member_shapes(trainer: Trainer) -> TrainState:
    return jax.eval_shape(lambda: trainer.init_member(jax.random.key(0), trainer.algorithm.hyper))


FOR_LEARNING = (".replay", ".optimizer", ".rewards")
"""What a learner holds that acting does not need."""


def load_learners(found: checkpoint.Checkpoint, trainer: Trainer) -> Learner:
    """The learners of a checkpoint, stacked and laid out for the trainer: to act with, not to learn on."""
    shapes = _stacked_shapes(trainer).learner
    learners = checkpoint.load(found, shapes, prefix=".learner", skip=FOR_LEARNING)
    return shard_seeds(learners, trainer.num_seeds, trainer.mesh)


def _stacked_shapes(trainer: Trainer) -> TrainState:
    """The shapes of the training state of all seeds, as a checkpoint holds it."""
    seeds = tuple(range(trainer.num_seeds))
    return jax.eval_shape(lambda: trainer.init_stacked(seeds))
