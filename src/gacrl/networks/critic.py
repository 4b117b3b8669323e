"""Critics: the value of an agent's situation, seen through its own eyes or with the whole world in view."""

from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from gacrl.config.algorithms import NetworkConfig
from gacrl.envs.environment import Environment
from gacrl.networks import torso as torsos
from gacrl.networks.gru import Gru
from gacrl.networks.layers import Linear, Mlp
from gacrl.types import Memory, Observation, PRNGKey

View = Literal["local", "central"]


def global_state(observation: Observation) -> Float[Array, " S"]:
    """Return what a central critic may know: the task's state, or all features side by side where it has none."""
    return observation.features.reshape(-1) if observation.state is None else observation.state


def team_mean(values: Float[Array, "N H"], observation: Observation) -> Float[Array, " H"]:
    """Return the mean over the real agents."""
    mask = observation.agent_mask[:, None]
    return jnp.where(mask, values, 0.0).sum(0) / jnp.maximum(mask.sum(), 1)


class Critic(eqx.Module):
    """One value for each agent.

    The central one also sees the state: as a vector with the mlp torso; with the graph torso as the mean of all
    agents' vectors, which holds for any number of them.
    """

    torso: torsos.Torso
    world: Mlp | None
    merge: Linear | None
    memory: Gru | None
    head: Linear

    def __init__(
        self, env: Environment, config: NetworkConfig, view: View, key: PRNGKey, gain: float | None = None
    ):
        torso_key, world_key, merge_key, memory_key, head_key = jax.random.split(key, 5)
        width, central = config.width, view == "central"
        self.torso = torsos.make(env, config, torso_key, gain)
        state_size = jax.eval_shape(
            lambda: global_state(env.reset(jax.random.key(0), env.default_params())[1])
        ).size
        by_vector = central and config.torso == "mlp"
        self.world = Mlp(state_size, (width,), world_key, gain) if by_vector else None
        self.merge = Linear(2 * width, width, merge_key, gain) if central else None
        self.memory = Gru(width, memory_key) if config.recurrent else None
        self.head = Linear(width, 1, head_key, gain)

    def initial_memory(self, num_agents: int) -> Memory:
        return () if self.memory is None else self.memory.empty(num_agents)

    def __call__(self, observation: Observation, memory: Memory = ()) -> tuple[Float[Array, " N"], Memory]:
        hidden = self._see(observation)
        if self.memory is not None:
            memory = hidden = self.memory(hidden, memory)
        return self.head(hidden)[:, 0], memory

    def unroll(
        self, observations: Observation, first: Bool[Array, "T ..."], memory: Memory
    ) -> tuple[Float[Array, "T N"], Memory]:
        """Return the values along T steps of one environment, and the memory after each step; it starts anew where
        `first` [T], or [T, N] for each agent.
        """
        hidden = jax.vmap(self._see)(observations)
        if self.memory is not None:
            memory = hidden = self.memory.unroll(hidden, first, memory)
        return self.head(hidden)[..., 0], memory

    def _see(self, observation: Observation) -> Float[Array, "N H"]:
        hidden = self.torso(observation).hidden
        if self.merge is not None:
            mean = team_mean(hidden, observation) if self.world is None else self.world(global_state(observation))
            everyone = jnp.broadcast_to(mean, hidden.shape)
            hidden = jax.nn.relu(self.merge(jnp.concatenate([hidden, everyone], axis=-1)))
        return hidden
