"""Trained and scripted policies as things to hold: what `RUN` names on the command line and in Python."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from gacrl import tasks
from gacrl.config import files as configuration
from gacrl.config.algorithms import AlgorithmConfig, GacrlPaperConfig, QLearningConfig
from gacrl.config.checks import unknown
from gacrl.config.run import CurriculumConfig, EnvConfig, RunConfig
from gacrl.errors import UserError
from gacrl.tasks.spread import scripted
from gacrl.tasks.spread.environment import Spread
from gacrl.training import build, checkpoint, keeper, session
from gacrl.training.devices import one_seed, rows
from gacrl.training.recorder import RunFolder
from gacrl.training.trainer import Trainer
from gacrl.types import Channel, Memory, Policy


@dataclass(frozen=True)
class TrainedRun:
    """The newest parameters of a run, in the task that they are to be played in."""

    name: str
    config: RunConfig
    """As trained, but for the changes of the task that were asked for."""
    trainer: Trainer
    learners: Any
    """Stacked over the seeds."""
    env_steps: int

    @property
    def env(self) -> Spread:
        """The task to be played."""
        return tasks.make(self.config.env)

    def policy(self, member: int, explore: bool) -> Policy:
        """The policy of one seed."""
        return self.trainer.algorithm.policy(one_seed(self.learners, member), explore)


def open_run(
    run: str | Path,
    change: Callable[[EnvConfig], EnvConfig] = lambda env: env,
    warn: Callable[[str], None] = lambda sentence: None,
) -> TrainedRun:
    """The run in a folder, or `FOLDER@k`: member k of it alone (counted from 0); or `pretrained:NAME`.

    `@best` behind it takes the parameters that scored best while training, instead of the newest.

    change: what to alter about the task. Raises UserError for a folder that holds no run, or parameters that
    do not fit the task.
    """
    path, member, kind = _split(str(run))
    folder = RunFolder.open(path)
    config = folder.config()
    changed = replace(
        config,
        env=change(config.env),
        curriculum=CurriculumConfig(),
        evaluation=replace(config.evaluation, horizon=None),
        algorithm=_without_experience(config.algorithm),
    )
    if config.algorithm.name == GacrlPaperConfig.name and changed.env.num_agents != config.env.num_agents:
        raise UserError(
            f"{path} was trained with {config.env.num_agents} agents, and the paper's GACRL is built for their "
            "number (equation (10) puts all messages side by side): leave --num-agents out"
        )
    trainer = build.make_trainer(changed)
    found, warnings = checkpoint.newest(folder.checkpoints, kind)
    for warning in warnings:
        warn(warning)
    learners = session.load_learners(found, trainer)
    if member is not None:
        if member >= config.num_seeds:
            raise UserError(f"{path} has the members 0 to {config.num_seeds - 1}: there is no @{member}")
        changed = replace(changed, seed=config.seed + member, num_seeds=1)
        trainer = build.make_trainer(changed)
        learners = rows(learners, member, member + 1)
    return TrainedRun(str(run), changed, trainer, learners, found.env_steps)


class _Acting(NamedTuple):
    """The part of a training state that acts, where a checkpoint of the whole has it."""

    learner: Any


def _without_experience(algorithm: AlgorithmConfig) -> AlgorithmConfig:
    """The same, with no room for a replay: playing needs none, and it is most of a learner."""
    if isinstance(algorithm, GacrlPaperConfig | QLearningConfig):
        return replace(algorithm, replay_capacity=1)
    return algorithm


def pretrained() -> dict[str, Path]:
    """The policies that come with the package, by name."""
    shipped = resources.files("gacrl") / "pretrained"
    folders = [Path(str(entry)) for entry in shipped.iterdir()] if shipped.is_dir() else []
    return {path.name: path for path in sorted(folders) if path.is_dir() and not path.name.startswith("_")}


def save_policy(run: str | Path, out: Path) -> Path:
    """Write the policy of a run's member (its first, for a folder) as a run folder without what only learning needs.

    Raises UserError where `out` exists, or there is no such run.
    """
    if out.exists():
        raise UserError(f"{out} exists: choose another folder")
    path, member, kind = _split(str(run))
    opened = open_run(f"{path}@{member or 0}{'@best' if kind == checkpoint.BEST else ''}")
    config = replace(RunFolder.open(path).config(), seed=opened.config.seed, num_seeds=1)
    out.mkdir(parents=True)
    (out / "config.json").write_text(configuration.dumps(config), encoding="utf-8")
    state, fingerprint = _Acting(opened.learners), configuration.fingerprint(config)
    named = {name: array for name, array in checkpoint.arrays(state).items() if keeper.acts(name)}
    checkpoint.save(out / "checkpoints", checkpoint.serialise(named), opened.env_steps, fingerprint, {})
    return out


def _split(run: str) -> tuple[Path, int | None, str]:
    """The folder that `RUN` names, the member of it, and which kind of checkpoint."""
    kind = checkpoint.BEST if run.endswith("@best") and not Path(run).exists() else checkpoint.STEP
    run = run.removesuffix("@best") if kind == checkpoint.BEST else run
    origin, colon, name = run.partition(":")
    if colon and origin == "pretrained":
        shipped = pretrained()
        if name not in shipped:
            raise UserError(unknown("pretrained policy", name, list(shipped)))
        return shipped[name], None, kind
    folder, at, member = run.rpartition("@")
    if at and member.isdigit() and not Path(run).exists():
        return Path(folder), int(member), kind
    return Path(run), None, kind


class LoadedPolicy:
    """A policy for one environment at a time: observations in, actions out.

    >>> policy = gacrl.load_policy("runs/paper-1")
    >>> policy.reset(seed=0)
    >>> actions = policy(observations)  # [N, O] -> [N]
    """

    def __init__(self, env: Spread, policies: dict[bool, Policy], initial_memory: Memory):
        """policies: the greedy one under True, the sampling one under False."""
        self.env = env
        self._initial_memory = initial_memory
        self._act = {greedy: jax.jit(policy) for greedy, policy in policies.items()}
        self.message: np.ndarray | None = None
        """What each agent sent at the last step, [N, V]; None where the policy sends nothing."""
        self.reset()

    def reset(self, seed: int = 0) -> None:
        """Start an episode: fresh memory, and random draws that follow from the seed."""
        self._memory = self._initial_memory
        self._key = jax.random.key(seed)

    def __call__(self, observations: Float[Array | np.ndarray, "N O"], greedy: bool = True) -> np.ndarray:
        """The actions of the N agents. Raises ValueError for observations of another shape."""
        expected = (self.env.num_agents, self.env.observation_size)
        observations = jnp.asarray(observations, jnp.float32)
        if observations.shape != expected:
            raise ValueError(f"observations must be [agents, numbers] = {expected}, not {observations.shape}")
        self._key, key = jax.random.split(self._key)
        seen = self.env.from_features(observations)
        decision, self._memory = self._act[greedy](self._memory, seen, key, Channel())
        self.message = None if decision.message is None else np.asarray(decision.message)
        return np.asarray(decision.action)


def load_policy(run: str | Path) -> LoadedPolicy:
    """The policy of a run: its folder, `FOLDER@k`, or `random` and `noop`.

    Raises UserError where there is no such run. The oracle and the local policy need the exact state, which
    observations alone do not give: play them with `gacrl.tasks.spread.scripted`.
    """
    if str(run) in scripted.PLAYABLE:
        if str(run) not in ("random", "noop"):
            raise UserError(f"{run} needs the exact state, not observations: use gacrl.tasks.spread.scripted")
        env = tasks.make(EnvConfig())
        actor = scripted.make(str(run), env)
        return LoadedPolicy(env, dict.fromkeys((True, False), actor.policy), actor.initial_memory)
    opened = open_run(run)
    policies = {greedy: opened.policy(0, not greedy) for greedy in (True, False)}
    return LoadedPolicy(opened.env, policies, opened.trainer.memory)
