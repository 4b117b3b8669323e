"""Trained and scripted policies as things to hold: what `RUN` names on the command line and in Python."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from importlib import resources
from pathlib import Path
from typing import Any, SupportsIndex, overload

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from gacrl import tasks
from gacrl.config import files as configuration
from gacrl.config.checks import require, require_kind, unknown, whole
from gacrl.config.run import RunConfig
from gacrl.envs.environment import Environment, as_floats
from gacrl.errors import UserError
from gacrl.evaluation.references import FLOORS, noop, playable, random
from gacrl.tasks import own
from gacrl.tasks.task import Task
from gacrl.training import build, checkpoint, session
from gacrl.training.devices import one_seed, rows
from gacrl.training.keeper import Acting
from gacrl.training.recorder import RunFolder
from gacrl.training.session import Parent
from gacrl.training.trainer import AbstractTrainer
from gacrl.types import Intervention, Memory, Policy


@dataclass(frozen=True)
class TrainedRun:
    """The newest parameters of a run, in the task that they are to be played in."""

    name: str
    config: RunConfig
    """As trained, except for the changes of the task that were asked for."""
    trainer: AbstractTrainer
    learners: Any
    """What acts, stacked over the seeds."""
    env_steps: int

    @property
    def task(self) -> Task:
        """The task that is played."""
        return tasks.find(self.config.task)

    @property
    def env(self) -> Environment:
        """The environment that is played in."""
        return self.trainer.evaluation_env

    def policy(self, member: int, explore: bool) -> Policy:
        """Return the policy of one seed."""
        return self.trainer.algorithm.policy(one_seed(self.learners, member), explore)


def open_run(
    run: str | Path,
    change: Callable[[Any], Any] = lambda settings: settings,
    warn: Callable[[str], None] = lambda sentence: None,
    intervention: Intervention | None = None,
) -> TrainedRun:
    """Open the run in a folder, or `FOLDER@k`: member k of it alone (counted from 0); or `pretrained:NAME`.

    `@best` behind it takes the parameters that scored best while training, instead of the newest.

    change: what to alter about the task's settings. intervention: what happens to messages; by default what did while
    training. Raises UserError for a folder that holds no run, a task that is not at hand, or parameters that do not
    fit the task.
    """
    path, member, kind = _split(str(run))
    folder = RunFolder.open(path)
    config = folder.config()
    folder.warn_of_changed_task(warn)
    evaluation = replace(config.evaluation, horizon=None)
    changed = replace(config, env=change(config.env), evaluation=evaluation)
    _require_playable(path, config, changed)
    trainer = build.make_trainer(changed, learns=False, intervention=intervention)
    found, warnings = checkpoint.newest(folder.checkpoints, kind)
    for warning in warnings:
        warn(warning)
    try:
        learners = session.load_learners(found, trainer)
    except UserError as error:
        _require_same_task(path, config, changed)
        raise error
    if member is not None:
        _require_member(path, member, config.num_seeds)
        changed = replace(changed, seed=config.seed + member, num_seeds=1)
        trainer = build.make_trainer(changed, learns=False, intervention=intervention)
        learners = rows(learners, member, member + 1)
    return TrainedRun(str(run), changed, trainer, learners, found.env_steps)


def open_one(
    run: str | Path,
    change: Callable[[Any], Any] = lambda settings: settings,
    warn: Callable[[str], None] = lambda sentence: None,
) -> TrainedRun:
    """Open a single member of a run: the first where none is named. Raises UserError as `open_run` does."""
    path, member, kind = _split(str(run))
    return open_run(f"{path}@{member or 0}{'@best' if kind == checkpoint.BEST else ''}", change, warn)


def newer(opened: TrainedRun) -> TrainedRun | None:
    """Open a run again where it has newer parameters by now, in the task that it is played in; None where it has not.

    Raises UserError where it has gone.
    """
    path, _, kind = _split(opened.name)
    folder = RunFolder.open(path)
    found, _ = checkpoint.newest(folder.checkpoints, kind)
    if found.env_steps <= opened.env_steps:
        return None
    if folder.config().num_seeds > 1:
        return open_one(opened.name, lambda _: opened.config.env)
    return replace(opened, learners=session.load_learners(found, opened.trainer), env_steps=found.env_steps)


def folder_of(run: str | Path) -> RunFolder:
    """Return the run folder that `RUN` names. Raises UserError where there is none."""
    return RunFolder.open(_split(str(run))[0])


def _require_playable(path: Path, trained: RunConfig, asked: RunConfig) -> None:
    before, now = (tasks.find(config.task).make(config.env).num_agents for config in (trained, asked))
    if getattr(trained.algorithm, "fixed_team", False) and before != now:
        raise UserError(
            f"{path} was trained with {before} agents, and the paper's GACRL is built for their number (equation (10) "
            "puts all messages side by side): leave num_agents out, or train the preset gacrl-teams, which plays "
            "in any number"
        )


def _require_same_task(path: Path, trained: RunConfig, asked: RunConfig) -> None:
    """Blame the changed settings, where there are some, for parameters that do not fit."""
    now = configuration.to_dict(asked)["env"]
    changes = [
        f"{name}={now[name]}"
        for name, before in configuration.to_dict(trained)["env"].items()
        if before != now[name]
    ]
    require(
        not changes,
        f"{path} does not play with {', '.join(changes)}: its network was built for what an agent saw in training; "
        "leave the change out, or train with algorithm.network.torso graph, which plays in any number (as the preset "
        "gacrl-teams does)",
    )


def _require_member(path: Path, member: int, num_seeds: int) -> None:
    if member >= num_seeds:
        raise UserError(f"{path} has the members 0 to {num_seeds - 1}: there is no @{member}")


def parent(run: str | Path, warn: Callable[[str], None] = lambda sentence: None) -> Parent:
    """Return a run to start another training from, by the names that `open_run` takes.

    Raises UserError where there is none.
    """
    path, member, kind = _split(str(run))
    config = RunFolder.open(path).config()
    found, warnings = checkpoint.newest(RunFolder.open(path).checkpoints, kind)
    for warning in warnings:
        warn(warning)
    if member is not None:
        _require_member(path, member, config.num_seeds)
    return Parent(str(run), found, config.num_seeds, member)


def pretrained() -> dict[str, Path]:
    """Return the policies that come with the package, by name."""
    shipped = resources.files("gacrl") / "pretrained"
    folders = [Path(str(entry)) for entry in shipped.iterdir()] if shipped.is_dir() else []
    return {path.name: path for path in sorted(folders) if path.is_dir() and not path.name.startswith("_")}


def save_policy(run: str | Path, out: Path, warn: Callable[[str], None] = lambda sentence: None) -> Path:
    """Write the policy of a run's member (its first, for a folder) as a run folder without what only learning needs.

    Raises UserError where `out` exists, or there is no such run.
    """
    if out.exists():
        raise UserError(f"{out} exists: choose another folder")
    opened = open_one(run, warn=warn)
    config = replace(folder_of(run).config(), seed=opened.config.seed, num_seeds=1)
    out.mkdir(parents=True)
    (out / "config.json").write_text(configuration.dumps(config), encoding="utf-8")
    tensors = checkpoint.serialise(checkpoint.arrays(Acting(opened.learners)))
    fingerprint = configuration.fingerprint(config)
    checkpoint.save(out / "checkpoints", tensors, opened.env_steps, fingerprint, {})
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
    >>> actions = policy(observations)  # [N, O] -> [N], or {agent: observation} -> {agent: action}
    """

    def __init__(self, env: Environment, policies: dict[bool, Policy], initial_memory: Memory):
        """policies: the greedy one under True, the sampling one under False."""
        self.env = env
        self._initial_memory = initial_memory
        self._act = {greedy: jax.jit(policy) for greedy, policy in policies.items()}
        seen = jax.eval_shape(lambda: env.reset(jax.random.key(0), env.default_params())[1])
        self._state = None if seen.state is None else jnp.zeros(seen.state.shape)
        """For critics, whose values nobody asks for: observations do not tell the state."""
        self.messages: np.ndarray | None = None
        """What each agent sent in each round of the last step, [R, N, V]; None where the policy says nothing."""
        self.reset()

    def reset(self, seed: SupportsIndex = 0) -> None:
        """Start an episode: fresh memory, and random draws that follow from the seed.

        Raises ConfigError for a seed that is no whole number.
        """
        self._memory = self._initial_memory
        self._key = jax.random.key(whole(seed, "seed"))

    @overload
    def __call__(self, observations: Mapping[Any, Any], greedy: bool = True) -> dict[Any, Any]: ...
    @overload
    def __call__(self, observations: Float[Array | np.ndarray, "N O"], greedy: bool = True) -> np.ndarray: ...
    def __call__(self, observations: Any, greedy: bool = True) -> Any:
        """Return the actions of the N agents: an array, or as PettingZoo has them a dictionary.

        Agents of a dictionary are taken in its order, and must all be in it. Raises ConfigError for observations of
        another shape, or that are not finite.
        """
        named = isinstance(observations, Mapping)
        features = self.env.stack(list(observations.values())) if named else as_floats(observations)
        expected = (self.env.num_agents, self.env.observation_size)
        require(
            features.shape == expected,
            f"observations must be [agents, numbers] = {list(expected)}, not {list(features.shape)}",
        )
        odd = np.flatnonzero(~np.isfinite(features).all(1))
        require(not odd.size, f"what agent {odd[0] if odd.size else 0} sees holds a number that is not finite")
        self._key, key = jax.random.split(self._key)
        seen = self.env.from_features(jnp.asarray(features))._replace(state=self._state)
        decision, self._memory = self._act[greedy](self._memory, seen, key)
        self.messages = None if decision.messages is None else np.asarray(decision.messages)
        actions = np.asarray(decision.action)
        return dict(zip(observations, self.env.unstack(actions), strict=True)) if named else actions


def name_of(run: Any) -> str:
    """Return what names a run: the folder of a `gacrl.Run`, or the text or path itself. Raises ConfigError."""
    run = getattr(run, "folder", run)
    require_kind("run", run, (str, Path), "a gacrl.Run, or the folder of one")
    return str(run)


def load_policy(run: Any, env: Any = None, **settings: Any) -> LoadedPolicy:
    """Load the policy of a run: a `Run`, its folder, `FOLDER@k`, `pretrained:NAME`, or `random` and `noop`.

    env: the task of a scripted policy; by default `spread`. settings: of the task, where they differ from those of
    training (num_agents=10). Raises UserError where there is no such run, and ConfigError for a setting that its task
    does not have. Other scripted policies need the exact state, which observations alone do not give.
    """
    name = name_of(run)
    if name in FLOORS:
        task, base = own.bring(tasks.DEFAULT if env is None else env)
        env = tasks.find(task).make(configuration.changed(base, settings))
        actor = {"random": random, "noop": noop}[name](env)
        return LoadedPolicy(env, dict.fromkeys((True, False), actor.policy), actor.initial_memory)
    if name in playable(tasks.find(tasks.DEFAULT)):
        raise UserError(f"{name} needs the exact state, not observations: play it with `gacrl evaluate {name}`")
    opened = open_run(name, lambda trained: configuration.changed(trained, settings))
    policies = {greedy: opened.policy(0, not greedy) for greedy in (True, False)}
    return LoadedPolicy(opened.env, policies, opened.trainer.memory)
