"""How a task grows harder while its agents learn: pure, compiled into the chunk, costing nothing."""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from gacrl.config.checks import require
from gacrl.config.run import CurriculumConfig
from gacrl.envs.environment import EnvParams
from gacrl.tasks.task import Task
from gacrl.types import Rollout

CurriculumState: TypeAlias = Any
Advance: TypeAlias = Callable[[CurriculumState, Int[Array, ""], Rollout], tuple[CurriculumState, EnvParams]]
"""(state, env_steps, rollout) -> (state, the parameters of the task from here on)."""


class Curriculum(NamedTuple):
    """How a task changes while it is learned."""

    init: Callable[[EnvParams], tuple[CurriculumState, EnvParams]]
    """The task as configured -> (state, the parameters of the task to begin with)."""
    advance: Advance


class Stage(NamedTuple):
    """How far the task has come."""

    episode: Int[Array, ""]
    """Finished episodes that count (those of all environments)."""
    progress: Float[Array, ""] | None
    """Running mean of the task's progress at an episode's end; None without a gate."""
    base: EnvParams
    """The task as configured, before any change."""


_MEMORY = 0.05
"""Weight of an episode in the running mean: some twenty of them decide."""


def constant() -> Curriculum:
    """Leave the task as it is."""
    return Curriculum(lambda params: (params, params), lambda params, env_steps, rollout: (params, params))


def linear(config: CurriculumConfig, task: Task, settings: Any) -> Curriculum:
    """Raise the task's difficulty from 0 to 1 over the episodes that count, once an episode."""

    def params_at(stage: Stage) -> EnvParams:
        return task.difficulty(settings, stage.base, jnp.minimum(stage.episode / config.episodes, 1.0))

    def advance(stage: Stage, env_steps: Int[Array, ""], rollout: Rollout):
        steps = rollout.transitions
        done = steps.terminated | steps.truncated
        ended, progress = done.sum(dtype=jnp.int32), stage.progress
        if config.gate is not None and progress is not None and task.progress is not None:
            reached = jnp.where(done, steps.info[task.progress], 0.0).sum() / jnp.maximum(ended, 1)
            progress += (1.0 - (1.0 - _MEMORY) ** ended) * (reached - progress)
            ended = jnp.where(progress >= config.gate, ended, 0)
        stage = stage._replace(episode=stage.episode + ended, progress=progress)
        return stage, params_at(stage)

    def init(params: EnvParams) -> tuple[Stage, EnvParams]:
        stage = Stage(jnp.zeros((), jnp.int32), None if config.gate is None else jnp.zeros(()), params)
        return stage, params_at(stage)

    return Curriculum(init, advance)


def make(config: CurriculumConfig, task: Task, settings: Any, params: EnvParams) -> Curriculum:
    """Make the curriculum that settings of the run and of the task ask for.

    Raises ConfigError for a gate where nothing moves, or where the task does not say what progress is.
    """
    if not _moves(task, settings, params):
        require(config.gate is None, f"curriculum.gate has nothing to hold back: {task.name} stays as it is")
        return constant()
    require(
        config.gate is None or task.progress is not None,
        f"curriculum.gate needs a task that says what progress is, and {task.name} does not: leave it out",
    )
    return linear(config, task, settings)


def _moves(task: Task, settings: Any, params: EnvParams) -> bool:
    """Whether the difficulty changes anything: whether it gives back other numbers than it was given."""
    same: list[bool] = []

    def look(params: EnvParams, share: Float[Array, ""]) -> Bool[Array, ""]:
        before, after = jax.tree.leaves(params), jax.tree.leaves(task.difficulty(settings, params, share))
        same.append(len(before) == len(after) and all(a is b for a, b in zip(before, after, strict=True)))
        return share > 0

    jax.eval_shape(look, params, jax.ShapeDtypeStruct((), jnp.float32))
    return not same[0]
