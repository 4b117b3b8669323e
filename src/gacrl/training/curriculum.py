"""How a task grows harder while its agents learn: pure, compiled into the chunk, costing nothing."""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from gacrl.config.run import CurriculumConfig
from gacrl.envs.environment import EnvParams
from gacrl.types import Rollout

CurriculumState: TypeAlias = Any
Advance: TypeAlias = Callable[[CurriculumState, Int[Array, ""], Rollout], tuple[CurriculumState, EnvParams]]
"""(state, env_steps, rollout) -> (state, the parameters of the task from here on)."""


class Curriculum(NamedTuple):
    init: Callable[[EnvParams], tuple[CurriculumState, EnvParams]]
    """The task as configured -> (state, the parameters of the task to begin with)."""
    advance: Advance


class Stage(NamedTuple):
    """How far the task has come."""

    episode: Int[Array, ""]
    """Finished episodes that count (those of all environments)."""
    coverage: Float[Array, ""] | None
    """Running mean of the share of landmarks covered within θ at an episode's end; None without a gate."""
    base: EnvParams
    """The task as configured, before any change."""


_MEMORY = 0.05
"""Weight of an episode in the running mean: some twenty of them decide."""


def constant() -> Curriculum:
    """The task stays as it is."""
    return Curriculum(lambda params: (params, params), lambda params, env_steps, rollout: (params, params))


def linear(config: CurriculumConfig) -> Curriculum:
    """The task moves in a straight line over the episodes that count, once an episode.

    The paper's: local ratio and θ over all episodes. Agents that join do so at once, where they happen to be: the
    environments share their parameters.
    """

    def params_at(stage: Stage) -> EnvParams:
        base, progress = stage.base, jnp.minimum(stage.episode / config.episodes, 1.0)

        def between(start: Array | float | None, end: Array | float | None, constant: Array) -> Array:
            """Where one end is not configured the task's own stands; where neither is, it is constant."""
            if start is None and end is None:
                return constant
            start, end = (constant if bound is None else bound for bound in (start, end))
            return start + progress * (end - start)

        params = base._replace(
            local_ratio=between(None, config.local_ratio_end, base.local_ratio),
            coverage_threshold=between(None, config.coverage_threshold_end, base.coverage_threshold),
            arena_scale=between(config.arena_scale_start, None, base.arena_scale),
        )
        if config.num_agents_start is None:
            return params
        num_agents, num_landmarks = base.agent_mask.size, base.landmark_mask.size
        agents = jnp.floor(config.num_agents_start + progress * (num_agents - config.num_agents_start))
        landmarks = jnp.ceil(agents * num_landmarks / num_agents)
        return params._replace(
            agent_mask=base.agent_mask & (jnp.arange(num_agents) < agents),
            landmark_mask=base.landmark_mask & (jnp.arange(num_landmarks) < landmarks),
        )

    def advance(stage: Stage, env_steps: Int[Array, ""], rollout: Rollout):
        steps = rollout.transitions
        done = steps.terminated | steps.truncated
        ended, coverage = done.sum(), stage.coverage
        if config.gate is not None and coverage is not None:
            covered = jnp.where(done, steps.info["coverage_theta"], 0.0).sum() / jnp.maximum(ended, 1)
            coverage += (1.0 - (1.0 - _MEMORY) ** ended) * (covered - coverage)
            ended = jnp.where(coverage >= config.gate, ended, 0)
        stage = stage._replace(episode=stage.episode + ended, coverage=coverage)
        return stage, params_at(stage)

    def init(params: EnvParams) -> tuple[Stage, EnvParams]:
        stage = Stage(jnp.zeros((), jnp.int32), None if config.gate is None else jnp.zeros(()), params)
        return stage, params_at(stage)

    return Curriculum(init, advance)


def make(config: CurriculumConfig) -> Curriculum:
    """The curriculum that the configuration asks for."""
    return linear(config) if config.changes else constant()
