"""The raw observation of whoever may be heard: the ceiling of what messages are worth."""

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from gacrl.config.algorithms import NetworkConfig
from gacrl.envs.environment import Environment
from gacrl.networks.communication.base import Communication, Neighbourhood, Spoken, embedded
from gacrl.networks.graph import attend, sighted_size
from gacrl.networks.layers import Linear, Mlp, rectified
from gacrl.types import PRNGKey


class Told(Communication):
    """Every agent hears all that its speakers see: `Observation.features`, as they are, in one round.

    Nothing stands between the two but the receiver's own weights: it embeds each observation with who spoke and with
    what itself sees of the speaker, in as many layers as an mlp torso has, and attends to these as it does to symbols.
    It hears before it remembers, so that a recurrent agent keeps what it was told. Not told is what a speaker
    remembers from before it was heard. Who spoke ties the network to the number of agents.
    """

    edge: Mlp
    query: Linear
    merge: Linear
    slope: float = eqx.field(static=True)

    def __init__(self, env: Environment, config: NetworkConfig, key: PRNGKey, gain: float | None = None):
        edge_key, query_key, merge_key = jax.random.split(key, 3)
        width = config.width
        known = env.observation_size + sighted_size(env) + env.num_agents
        self.edge = Mlp(known, (width,) * config.depth, edge_key, gain, config.heard_slope)
        self.query = Linear(width, width, query_key, gain)
        self.merge = Linear(2 * width, width, merge_key, gain)
        self.slope = config.heard_slope

    def hear(
        self, hidden: Float[Array, "N H"], inbox: Any, near: Neighbourhood, key: PRNGKey | None
    ) -> Float[Array, "N H"]:
        edges = embedded(self.edge, near.observed(), near, who=True)
        score = jnp.einsum("nh,nkh->nk", self.query(hidden), edges) / math.sqrt(edges.shape[-1])
        heard = attend(edges, jnp.where(near.adjacency, score, -jnp.inf))
        return hidden + rectified(self.merge(jnp.concatenate([hidden, heard], axis=-1)), self.slope)

    def speak(
        self,
        hidden: Float[Array, "N H"],
        near: Neighbourhood,
        key: PRNGKey | None,
        temperature: Float[Array, ""] | float,
        code: Float[Array, "N Z"] | None = None,
    ) -> Spoken:
        return Spoken(hidden, near.observed()[None])
