"""CommNet: agents average each other's hidden states."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from gacrl.config.algorithms import NetworkConfig
from gacrl.envs.environment import Environment
from gacrl.networks.communication.base import Communication, Neighbourhood, Spoken, neighbour_mean, received
from gacrl.networks.layers import Linear
from gacrl.types import PRNGKey


class CommNet(Communication):
    """h ← tanh(H h + C mean of the neighbours' h), for some rounds (Sukhbaatar et al. 2016, eq. 2 and 3)."""

    own: tuple[Linear, ...]
    heard: tuple[Linear, ...]

    def __init__(self, env: Environment, config: NetworkConfig, key: PRNGKey, gain: float | None = None):
        own_key, heard_key = jax.random.split(key)
        width, rounds = config.width, config.rounds
        self.own = tuple(Linear(width, width, k, gain) for k in jax.random.split(own_key, rounds))
        self.heard = tuple(Linear(width, width, k, gain) for k in jax.random.split(heard_key, rounds))

    def speak(
        self,
        hidden: Float[Array, "N H"],
        near: Neighbourhood,
        key: PRNGKey | None,
        temperature: Float[Array, ""] | float,
        code: Float[Array, "N Z"] | None = None,
    ) -> Spoken:
        return averaging_rounds(hidden, near, self.own, self.heard)


def averaging_rounds(
    hidden: Float[Array, "N H"],
    near: Neighbourhood,
    own: tuple[Linear, ...],
    heard: tuple[Linear, ...],
    speaks: Float[Array, "N 1"] | None = None,
) -> Spoken:
    """Let agents hear the mean of their neighbours, round by round. speaks: 1 or 0 for each; None: all do."""
    said = []
    for number, (own_layer, heard_layer) in enumerate(zip(own, heard, strict=True)):
        said.append(hidden if speaks is None else speaks * hidden)
        told = received(said[-1], near, number, len(own))
        hidden = jnp.tanh(own_layer(hidden) + heard_layer(neighbour_mean(told, near.adjacency)))
    return Spoken(hidden, jnp.stack(said))
