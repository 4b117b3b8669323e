"""Agents acting in environments: the one step that training and evaluation share."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Key

from gacrl.envs import copies
from gacrl.envs.environment import Environment, EnvParams, EnvState, TimeStep
from gacrl.networks.memory import restarted
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


def act(
    env: Environment,
    policy: Policy,
    params: EnvParams,
    carry: Carry,
    keys: Key[Array, "E 3"],
    channel: Channel | None = None,
) -> tuple[EnvState, Memory, Transition]:
    """Every environment takes one step, and none is reset: its state, the policy's memory, and what happened."""
    channel = Channel() if channel is None else channel
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
        info=measured(after),
        left=after.left,
    )
    return env_state, memory, transition


def measured(after: TimeStep) -> dict[str, Array]:
    """The measurements of a step, of one environment or of many; the mean reward of those who were there is added
    where the task does not say it."""
    if "reward_raw" in after.info:
        return after.info
    there = after.observation.agent_mask
    mean = jnp.where(there, after.reward, 0.0).sum(-1) / jnp.maximum(there.sum(-1), 1)
    return {**after.info, "reward_raw": mean}


def renew(
    env: Environment,
    initial_memory: Memory,
    params: EnvParams,
    env_state: EnvState,
    memory: Memory,
    transition: Transition,
    keys: Key[Array, "E 3"],
) -> Carry:
    """Reset those whose episode has ended, with fresh memory; whose life has ended inside one forgets."""
    over = transition.terminated | transition.truncated
    env_state, observation = copies.begin_anew(
        env, params, env_state, over, transition.next_observation, lambda: keys[:, 2]
    )
    done = transition.terminated | transition.truncated
    memory = jax.vmap(restarted, (None, 0, 0))(initial_memory, memory, done)
    if transition.left is not None:
        memory = jax.vmap(restarted, (None, 0, 0))(initial_memory, memory, transition.left)
    return Carry(env_state, observation, memory, done)


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
    keys = jax.random.split(key, (carry.first.shape[0], 3))
    env_state, memory, transition = act(env, policy, params, carry, keys, channel)
    return renew(env, initial_memory, params, env_state, memory, transition, keys), transition


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
