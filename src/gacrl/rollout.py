"""Agents acting in environments: the one step that training and evaluation share."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Key

from gacrl.config.checks import require
from gacrl.envs import copies
from gacrl.envs.environment import Environment, EnvParams, EnvState, TimeStep, typed_keys
from gacrl.errors import ConfigError
from gacrl.networks.memory import restarted
from gacrl.types import (
    Arrives,
    Decision,
    Intervention,
    Memory,
    Observation,
    Policy,
    PRNGKey,
    Rollout,
    Transition,
    Words,
)


class Carry(NamedTuple):
    """Where E environments stand between two steps: every leaf has E in front."""

    env_state: EnvState
    observation: Observation
    memory: Memory
    first: Bool[Array, " E"]
    """An episode opens with the next step."""
    intervention: Any = ()
    """What an intervention carries."""


def start(
    env: Environment,
    params: EnvParams,
    memory: Memory,
    key: PRNGKey,
    num_envs: int,
    intervention: Intervention | None = None,
    policy: Policy | None = None,
) -> Carry:
    """Begin E fresh episodes. memory: the policy's initial memory for one environment.

    An intervention needs the policy whose words it catches. Raises ConfigError where that says nothing.
    """
    key = typed_keys(key)
    env_state, observation = copies.reset(env, params, jax.random.split(key, num_envs))
    memories = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (num_envs, *leaf.shape)), memory)
    carry = Carry(env_state, observation, memories, jnp.ones(num_envs, bool))
    if intervention is None:
        return carry
    if policy is None:
        raise ValueError("an intervention catches the words of a policy: which one?")
    words = jax.eval_shape(partial(say, policy, carry, jax.random.split(key, num_envs)), Arrives())
    return carry._replace(intervention=intervention.init(words))


def say(policy: Policy, carry: Carry, keys: Key[Array, " E"], arrives: Arrives) -> Words:
    """Ask the agents of all environments what they say in this step if this arrives.

    Raises ConfigError where the policy says nothing.
    """
    listening = carry.observation._replace(arrives=arrives)
    return spoken(jax.vmap(policy)(carry.memory, listening, keys)[0])


def spoken(decision: Decision) -> Words:
    """Return what was said. Raises ConfigError where the policy says nothing."""
    if decision.messages is None:
        raise ConfigError(
            "the agents say nothing: there are no messages to intervene in; leave the intervention out"
        )
    return decision.messages


def decide(
    policy: Policy, carry: Carry, keys: Key[Array, "E 3"], intervention: Intervention | None = None
) -> tuple[Carry, Decision]:
    """Let the agents of every environment decide: where they stand then, what they heard included, and what they do.

    No environment moves.
    """
    observation, carried = carry.observation, carry.intervention
    if intervention is not None:
        ask, key = partial(say, policy, carry, keys[:, 0]), jax.random.fold_in(keys[0, 2], 1)
        observation = observation._replace(arrives=intervention.arrives(carried, ask, carry.first, key))
    decision, memory = jax.vmap(policy)(carry.memory, observation, keys[:, 0])
    if intervention is not None:
        carried = intervention.follow(carried, spoken(decision), carry.first)
    return carry._replace(observation=observation, memory=memory, intervention=carried), decision


def act(
    env: Environment,
    policy: Policy,
    params: EnvParams,
    carry: Carry,
    keys: Key[Array, "E 3"],
    intervention: Intervention | None = None,
) -> tuple[Carry, Transition]:
    """Let every environment take one step, and reset none: where they stand then, and what happened.

    Raises ConfigError for an environment that lives in Python.
    """
    require(not env.hosted, f"{type(env).__name__} lives in Python: no compiled program can step it")
    decided, decision = decide(policy, carry, keys, intervention)
    step_mapped = jax.vmap(env.step, (0, 0, 0, None))  # and not `step_many`: docs/design.md
    env_state, after = step_mapped(carry.env_state, decision.action, keys[:, 1], params)
    over = after.terminated | after.truncated
    return Carry(env_state, after.observation, decided.memory, over, decided.intervention), happened(
        decided, decision, after
    )


def happened(decided: Carry, decision: Decision, after: TimeStep) -> Transition:
    """Put together what a step of every environment was."""
    observation = decided.observation
    return Transition(
        observation=observation,
        decision=decision,
        reward=after.reward,
        terminated=after.terminated,
        truncated=after.truncated,
        first=decided.first,
        next_observation=after.observation._replace(arrives=observation.arrives),
        info=measured(after),
        left=after.left,
    )


def measured(after: TimeStep) -> dict[str, Array]:
    """Return the measurements of a step, of one environment or of many; the mean reward of those who were there is
    added where the task does not say it.
    """
    if "reward_raw" in after.info:
        return after.info
    there = after.observation.agent_mask
    mean = jnp.where(there, after.reward, 0.0).sum(-1) / jnp.maximum(there.sum(-1), 1)
    return {**after.info, "reward_raw": mean}


def renew(
    env: Environment,
    initial_memory: Memory,
    params: EnvParams,
    carry: Carry,
    left: Bool[Array, "E N"] | None,
    keys: Key[Array, "E 3"],
) -> Carry:
    """Reset those whose episode has ended, with fresh memory; whose life has ended inside one forgets."""
    env_state, observation = copies.begin_anew(
        env, params, carry.env_state, carry.first, carry.observation, lambda: keys[:, 2]
    )
    return forgetting(initial_memory, carry._replace(env_state=env_state, observation=observation), left)


def forgetting(initial_memory: Memory, carry: Carry, left: Bool[Array, "E N"] | None) -> Carry:
    """Give fresh memory to environments that open an episode, and to agents whose life has ended inside one."""
    memory = jax.vmap(restarted, (None, 0, 0))(initial_memory, carry.memory, carry.first)
    if left is not None:
        memory = jax.vmap(restarted, (None, 0, 0))(initial_memory, memory, left)
    return carry._replace(memory=memory)


def step(
    env: Environment,
    policy: Policy,
    initial_memory: Memory,
    params: EnvParams,
    carry: Carry,
    key: PRNGKey,
    intervention: Intervention | None = None,
) -> tuple[Carry, Transition]:
    """Let every environment take one step; those whose episode ended are reset, with fresh memory."""
    keys = jax.random.split(typed_keys(key), (carry.first.shape[0], 3))
    after, transition = act(env, policy, params, carry, keys, intervention)
    return renew(env, initial_memory, params, after, transition.left, keys), transition


def collect(
    env: Environment,
    policy: Policy,
    initial_memory: Memory,
    params: EnvParams,
    carry: Carry,
    key: PRNGKey,
    num_steps: int,
    intervention: Intervention | None = None,
) -> tuple[Carry, Rollout]:
    """Take T steps of E environments: transitions [T, E, …]."""

    def one_step(carry: Carry, key: PRNGKey) -> tuple[Carry, Transition]:
        return step(env, policy, initial_memory, params, carry, key, intervention)

    if num_steps == 1:  # no loop around a single step
        after, transition = one_step(carry, key)
        transitions = jax.tree.map(lambda leaf: leaf[None], transition)
    else:
        after, transitions = jax.lax.scan(
            one_step,
            carry,
            jax.random.split(key, num_steps),
        )
    return after, Rollout(transitions, carry.memory)
