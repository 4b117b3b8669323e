"""The network of the agents: torso, memory, communication, second look and head, in this order, each by a setting.

Q-learning takes the head for the values of the actions, PPO for logits, and critics have a head of one.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key

from gacrl.config.algorithms import NetworkConfig
from gacrl.envs.environment import Environment
from gacrl.networks import communication
from gacrl.networks import torso as torsos
from gacrl.networks.communication.base import Communication, Neighbourhood, Weighed
from gacrl.networks.encoder import Code
from gacrl.networks.graph import heard_adjacency, nearest_speakers
from gacrl.networks.gru import Gru
from gacrl.networks.layers import Linear, num_parameters
from gacrl.networks.memory import restarted
from gacrl.types import Memory, Observation, PRNGKey


class AgentMemory(NamedTuple):
    """What an agent network carries from step to step; () for what it does not have."""

    carry: Any
    inbox: Any


class AgentOutput(NamedTuple):
    """What the network gives for N agents in one step: A outputs, H features, R rounds of messages."""

    head: Float[Array, "N A"]
    hidden: Float[Array, "N H"]
    messages: Float[Array, "R N V"] | None
    adjacency: Bool[Array, "N N"]
    code_loss: Float[Array, " N"] | float
    """Negative evidence lower bound of the code, up to constants; 0 without a code."""
    message_loss: Float[Array, " N"] | None = None
    """The loss of the kind of message, where it has one."""
    weighed: Weighed | None = None
    """What the words were to who heard them; None for a kind without attention."""
    gaze: torsos.Gaze | None = None
    """Where the second look went; None without one."""


class Seen(NamedTuple):
    """What an agent network knows before it remembers."""

    hidden: Float[Array, "N H"]
    looked: torsos.Looked
    code: Float[Array, "N Z"] | None
    code_loss: Float[Array, " N"] | float


class AgentNetwork(eqx.Module):
    """Shared by all agents; for one environment at one step."""

    torso: torsos.Torso
    code: Code | None
    memory: Gru | None
    communication: Communication
    look: torsos.SecondLook | None
    head: Linear
    radius: float = eqx.field(static=True)
    nearest: int | None = eqx.field(static=True)
    sight: Callable[[Observation], Float[Array, "N N S"]] = eqx.field(static=True)
    telling: Callable[[Observation], Float[Array, "N O"]] = eqx.field(static=True)

    def __init__(
        self,
        env: Environment,
        config: NetworkConfig,
        num_outputs: int,
        key: PRNGKey,
        gain: float | None = None,
        head_gain: float | None = None,
    ):
        """gain, head_gain: orthogonal initialisation, where they are given."""
        torso_key, code_key, memory_key, communication_key, head_key = jax.random.split(key, 5)
        self.torso = torsos.make(env, config, torso_key, gain)
        self.code = None if config.latent == "none" else Code(config, code_key)
        self.memory = Gru(config.width, memory_key) if config.recurrent else None
        self.communication = communication.make(env, config, communication_key, gain)
        self.look = None
        if config.second_look:
            self.look = torsos.SecondLook(config, jax.random.fold_in(head_key, 1), gain)
        self.head = Linear(config.width, num_outputs, head_key, head_gain)
        self.radius, self.nearest = config.radius, config.nearest_agents
        self.sight, self.telling = env.sight, env.telling

    def initial_memory(self, num_agents: int) -> Memory:
        """Return an empty memory; () for a network that remembers nothing."""
        inbox = self.communication.empty_inbox(num_agents)
        if self.memory is None and isinstance(inbox, tuple):
            return ()
        carry = () if self.memory is None else self.memory.empty(num_agents)
        return AgentMemory(carry, inbox)

    def __call__(
        self,
        observation: Observation,
        memory: Memory = (),
        key: PRNGKey | None = None,
        temperature: Float[Array, ""] | float = 1.0,
    ) -> tuple[AgentOutput, Memory]:
        """Without a key nothing is drawn: the most likely symbols, DIAL's bits."""
        remembered = memory if isinstance(memory, AgentMemory) else AgentMemory((), ())
        seen = self.see(observation, remembered.inbox, key)
        carry = remembered.carry
        if self.memory is not None:
            carry = self.memory(seen.hidden, carry)
            seen = seen._replace(hidden=carry)
        output, inbox = self.say(observation, seen, key, temperature)
        return output, AgentMemory(carry, inbox) if isinstance(memory, AgentMemory) else ()

    def see(self, observation: Observation, inbox: Any, key: PRNGKey | None) -> Seen:
        """Return what comes before the memory: what is seen, its code, and what was heard of the step before."""
        looked = self.torso(observation)
        hidden, code, code_loss = looked.hidden, None, 0.0
        if self.code is not None:
            code, hidden, code_loss = self.code(hidden, None if key is None else jax.random.fold_in(key, 2_000))
        _, near = self._around(observation)
        return Seen(self.communication.hear(hidden, inbox, near, key), looked, code, code_loss)

    def say(
        self,
        observation: Observation,
        seen: Seen,
        key: PRNGKey | None,
        temperature: Float[Array, ""] | float,
    ) -> tuple[AgentOutput, Any]:
        """Return what comes after the memory: communication and head; and the inbox for the next step."""
        adjacency, near = self._around(observation)
        spoken = self.communication.speak(seen.hidden, near, key, temperature, seen.code)
        messages = spoken.messages
        if messages is not None:
            messages = jnp.where(observation.agent_mask[:, None], messages, 0.0)
        hidden, gaze = (spoken.hidden, None) if self.look is None else self.look(spoken.hidden, seen.looked)
        output = AgentOutput(
            head=self.head(hidden),
            hidden=hidden,
            messages=messages,
            adjacency=adjacency,
            code_loss=seen.code_loss,
            message_loss=spoken.loss,
            weighed=spoken.weighed,
            gaze=gaze,
        )
        return output, spoken.inbox

    def _around(self, observation: Observation) -> tuple[Bool[Array, "N N"], Neighbourhood]:
        """Return the edges along which something arrives, and what each agent's network is given of them."""
        adjacency, sight = heard_adjacency(observation, self.radius), self.sight(observation)
        telling = self.telling(observation)
        if self.nearest is None or self.nearest >= adjacency.shape[0]:
            return adjacency, Neighbourhood(adjacency, sight, None, observation.arrives, telling)
        speakers = nearest_speakers(observation.positions, adjacency, self.nearest)
        near = jnp.take_along_axis(adjacency, speakers, axis=1)
        seen = jnp.take_along_axis(sight, speakers[..., None], axis=1)
        return adjacency, Neighbourhood(near, seen, speakers, observation.arrives, telling)


def unroll(
    network: AgentNetwork,
    observations: Observation,
    first: Bool[Array, "T ..."],
    memory: Memory,
    keys: Key[Array, "T ..."] | None,
    temperature: Float[Array, ""] | float = 1.0,
) -> tuple[AgentOutput, Memory]:
    """Unroll the network over T steps of one environment [T, …], or of B [T, B, …]: outputs, and the memory *after*
    each step.

    The memory starts anew where `first` [T, B], or [T, B, N] for each agent. What does not wait for the step before is
    computed for all steps at once. Time stays in front: mapping this over environments turns every array twice.
    """

    def each(function: Callable[..., Any]) -> Callable[..., Any]:
        return jax.vmap(function) if observations.features.ndim == 4 else function

    if not isinstance(memory, AgentMemory):
        return jax.vmap(each(lambda seen, key: network(seen, (), key, temperature)))(observations, keys)
    if network.memory is not None and not jax.tree.leaves(memory.inbox):
        seen = jax.vmap(each(lambda observation, key: network.see(observation, (), key)))(observations, keys)
        carries = network.memory.unroll(seen.hidden, first, memory.carry)
        say = partial(network.say, temperature=temperature)
        output, _ = jax.vmap(each(say))(observations, seen._replace(hidden=carries), keys)
        return output, AgentMemory(carries, memory.inbox)
    fresh = network.initial_memory(observations.features.shape[-2])

    def advance(
        memory: Memory, seen: Observation, first: Bool[Array, "..."], key: Any
    ) -> tuple[AgentOutput, Memory]:
        return network(seen, restarted(fresh, memory, first), key, temperature)

    def step(memory: Memory, inputs: tuple[Observation, Bool[Array, "..."], Any]):
        output, memory = each(advance)(memory, *inputs)
        return memory, (output, memory)

    return jax.lax.scan(step, memory, (observations, first, keys))[1]


def words_said(network: AgentNetwork, env: Environment) -> tuple[int, ...] | None:
    """Return the shape [R, N, V] of what the agents say in a step; None where they say nothing.

    network: with numbers, or their shapes alone.
    """

    def messages(network: AgentNetwork) -> Array | None:
        seen = env.reset(jax.random.key(0), env.default_params())[1]
        return network(seen, network.initial_memory(env.num_agents))[0].messages

    said = eqx.filter_eval_shape(messages, network)
    return None if said is None else said.shape


def acting_parameters(env: Environment, config: NetworkConfig, num_outputs: int) -> int:
    """Return how many parameters the network of these settings has."""
    return num_parameters(eqx.filter_eval_shape(AgentNetwork, env, config, num_outputs, jax.random.key(0)))


def matched(env: Environment, config: NetworkConfig, num_outputs: int) -> NetworkConfig:
    """Return the configuration with the width at which the network's parameters come nearest to those asked for."""
    wanted = config.parameters
    if wanted is None:
        return config

    def size(width: int) -> int:
        return acting_parameters(env, replace(config, width=width, parameters=None), num_outputs)

    low, high = 2, 4
    while size(high) < wanted and high < 65_536:
        low, high = high, 2 * high
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if size(middle) < wanted else (low, middle)
    width = min((low, high), key=lambda width: abs(size(width) - wanted))
    return replace(config, width=width, parameters=None)
