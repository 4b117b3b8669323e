"""How a task grows harder while its agents learn: pure, compiled into the chunk, costing nothing."""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import jax.numpy as jnp
from jaxtyping import Array, Int

from gacrl.config import CurriculumConfig, EnvConfig
from gacrl.envs.environment import EnvParams
from gacrl.types import Rollout

CurriculumState: TypeAlias = Any
Advance: TypeAlias = Callable[[CurriculumState, Int[Array, ""], Rollout], tuple[CurriculumState, EnvParams]]
"""(state, env_steps, rollout) -> (state, the parameters of the task from here on)."""


class Curriculum(NamedTuple):
    init: Callable[[EnvParams], CurriculumState]
    advance: Advance


class LinearState(NamedTuple):
    episode: Int[Array, ""]
    """Finished episodes (those of all environments count)."""
    base: EnvParams
    """The task as configured, before any change."""


def constant() -> Curriculum:
    """The task stays as it is."""
    return Curriculum(lambda params: params, lambda params, env_steps, rollout: (params, params))


def linear(config: CurriculumConfig, env: EnvConfig) -> Curriculum:
    """The paper's curriculum: local ratio and θ move linearly over the episodes, once an episode."""
    local_ratio_end = env.local_ratio if config.local_ratio_end is None else config.local_ratio_end
    threshold_end = (
        env.coverage_threshold if config.coverage_threshold_end is None else config.coverage_threshold_end
    )

    def params_at(state: LinearState) -> EnvParams:
        progress = jnp.minimum(state.episode / config.episodes, 1.0)

        def between(start: Array, end: float) -> Array:
            return start + progress * (end - start)

        return state.base._replace(
            local_ratio=between(state.base.local_ratio, local_ratio_end),
            coverage_threshold=between(state.base.coverage_threshold, threshold_end),
        )

    def advance(state: LinearState, env_steps: Int[Array, ""], rollout: Rollout):
        done = rollout.transitions.terminated | rollout.transitions.truncated
        state = state._replace(episode=state.episode + done.sum())
        return state, params_at(state)

    return Curriculum(lambda params: LinearState(jnp.zeros((), jnp.int32), params), advance)


def make(config: CurriculumConfig, env: EnvConfig) -> Curriculum:
    """The curriculum that the configuration asks for."""
    if config.local_ratio_end is None and config.coverage_threshold_end is None:
        return constant()
    return linear(config, env)
