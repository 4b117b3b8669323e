"""Many copies of an environment, stepped side by side; those whose episode has ended begin a new one.

Every leaf has E copies in front. Nobody draws new places in a step in which no episode ends: episodes that only the
time limit ends do so all at once.
"""

from collections.abc import Callable
from typing import TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Key, UInt32

from gacrl.envs.environment import Environment, EnvParams, EnvState, TimeStep, typed_keys
from gacrl.types import Observation, PRNGKey

Keys: TypeAlias = Key[Array, " E"] | UInt32[Array, "E _"]


def reset(env: Environment, params: EnvParams, keys: Keys) -> tuple[EnvState, Observation]:
    """Begin E fresh episodes."""
    return jax.vmap(env.reset, (0, None))(typed_keys(keys), params)


def step(
    env: Environment, params: EnvParams, state: EnvState, action: Array, key: PRNGKey
) -> tuple[EnvState, Observation, TimeStep]:
    """Take one step of each copy: where it goes on from, what is seen there, and what the step brought.

    Where an episode has ended the first two are those of a new one; the third holds the last observation of the old.
    """
    key, num_envs = typed_keys(key), action.shape[0]
    state, after = env.step_many(state, action, jax.random.split(key, num_envs), params)

    def reset_keys() -> Keys:
        return jax.random.split(jax.random.fold_in(key, num_envs), num_envs)  # none of the steps' keys

    done = after.terminated | after.truncated
    state, observation = begin_anew(env, params, state, done, after.observation, reset_keys)
    return state, observation, after


def begin_anew(
    env: Environment,
    params: EnvParams,
    state: EnvState,
    done: Bool[Array, " E"],
    observation: Observation,
    keys: Callable[[], Keys],
) -> tuple[EnvState, Observation]:
    """Reset each copy where its episode is over. The keys are asked for only if one is.

    What a conditional hands through is copied, so that where observations can be made from the state they are.
    """
    if env.observes_state:
        state = _where_done(done, lambda: reset(env, params, keys())[0], state)
        return state, env.observe_many(state, params)
    return _where_done(done, lambda: reset(env, params, keys()), (state, observation))


def _where_done(done: Bool[Array, " E"], fresh: Callable[[], EnvState], going_on: EnvState) -> EnvState:
    def choose() -> EnvState:
        return jax.tree.map(
            lambda new, old: jnp.where(done.reshape(-1, *[1] * (old.ndim - 1)), new, old), fresh(), going_on
        )

    return jax.lax.cond(done.any(), choose, lambda: going_on)
