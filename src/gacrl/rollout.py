"""Agents acting in environments: the one step that training and evaluation share."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from gacrl.envs import copies
from gacrl.envs.environment import Environment, EnvParams, EnvState
from gacrl.types import Channel, Memory, Observation, Policy, PRNGKey, Rollout, Transition


class Carry(NamedTuple):
    """Where E environments stand between two steps: every leaf has E in front."""

    env_state: EnvState
    observation: Observation
    memory: Memory
    first: Bool[Array, " E"]
    """An episode opens with the next step."""


def start(env: Environment, params: EnvParams, memory: Memory, key: PRNGKey, num_envs: int) -> Carry:
    """E fresh episodes. memory: the policy's initial memory for one environment."""
    env_state, observation = copies.reset(env, params, jax.random.split(key, num_envs))
    memories = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (num_envs, *leaf.shape)), memory)
    return Carry(env_state, observation, memories, jnp.ones(num_envs, bool))


def step(
    env: Environment,
    policy: Policy,
    initial_memory: Memory,
    params: EnvParams,
    carry: Carry,
    key: PRNGKey,
    channel: Channel | None = None,
) -> tuple[Carry, Transition]:
    """Every environment takes one step; those whose episode ended are reset, with fresh memory."""
    channel = Channel() if channel is None else channel

    keys = jax.random.split(key, (carry.first.shape[0], 3))
    decision, memory = jax.vmap(policy, (0, 0, 0, None))(carry.memory, carry.observation, keys[:, 0], channel)
    step_mapped = jax.vmap(env.step, (0, 0, 0, None))  # and not `step_many`: docs/design.md
    env_state, after = step_mapped(carry.env_state, decision.action, keys[:, 1], params)
    transition = Transition(
        observation=carry.observation,
        decision=decision,
        reward=after.reward,
        terminated=after.terminated,
        truncated=after.truncated,
        first=carry.first,
        next_observation=after.observation,
        info=after.info,
    )
    env_state, observation = copies.begin_anew(env, params, env_state, after, lambda: keys[:, 2])
    done = after.terminated | after.truncated
    keep = jax.vmap(
        lambda done, old: jax.tree.map(lambda new, old: jnp.where(done, new, old), initial_memory, old)
    )
    return Carry(env_state, observation, keep(done, memory), done), transition


def collect(
    env: Environment,
    policy: Policy,
    initial_memory: Memory,
    params: EnvParams,
    carry: Carry,
    key: PRNGKey,
    num_steps: int,
) -> tuple[Carry, Rollout]:
    """T steps of E environments: transitions [T, E, …]."""
    if num_steps == 1:  # no loop around a single step
        after, transition = step(env, policy, initial_memory, params, carry, key)
        transitions = jax.tree.map(lambda leaf: leaf[None], transition)
    else:
        after, transitions = jax.lax.scan(
            lambda carry, key: step(env, policy, initial_memory, params, carry, key),
            carry,
            jax.random.split(key, num_steps),
        )
    return after, Rollout(transitions, carry.memory, after.memory)
