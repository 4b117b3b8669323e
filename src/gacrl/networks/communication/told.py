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


class Hearing(eqx.Module):
    """Hear one round: embed what each speaker says, and attend to it as to symbols."""

    edge: Mlp
    query: Linear
    merge: Linear
    slope: float = eqx.field(static=True)

    def __init__(
        self, env: Environment, config: NetworkConfig, said: int, key: PRNGKey, gain: float | None = None
    ):
        edge_key, query_key, merge_key = jax.random.split(key, 3)
        width = config.width
        known = said + sighted_size(env) + env.num_agents
        self.edge = Mlp(known, (width,) * config.depth, edge_key, gain, config.heard_slope)
        self.query = Linear(width, width, query_key, gain)
        self.merge = Linear(2 * width, width, merge_key, gain)
        self.slope = config.heard_slope

    def take_in(
        self, hidden: Float[Array, "N H"], said: Float[Array, "N V"], near: Neighbourhood
    ) -> Float[Array, "N H"]:
        """Return what agents know once they have heard what was said."""
        edges = embedded(self.edge, said, near, who=True)
        score = jnp.einsum("nh,nkh->nk", self.query(hidden), edges) / math.sqrt(edges.shape[-1])
        heard = attend(edges, jnp.where(near.adjacency, score, -jnp.inf))
        return hidden + rectified(self.merge(jnp.concatenate([hidden, heard], axis=-1)), self.slope)


class Told(Hearing, Communication):
    """Every agent hears all that its speakers see: `Observation.features`, as they are, in one round.

    Nothing stands between the two but the receiver's own weights: it embeds each observation with who spoke and with
    what itself sees of the speaker, in as many layers as an mlp torso has, and attends to these as it does to symbols.
    It hears before it remembers, so that a recurrent agent keeps what it was told. Not told is what a speaker
    remembers from before it was heard. Who spoke ties the network to the number of agents.

    A teacher may have more rounds, in which agents hear what the others made of the one before: whether the car ahead
    will brake is in what it made of what it was told. Nobody can replace what is said there, so those who are asked
    what words are worth have one round.
    """

    later: tuple[Hearing, ...]
    """A teacher's rounds after the first."""

    def __init__(
        self, env: Environment, config: NetworkConfig, key: PRNGKey, gain: float | None = None, rounds: int = 1
    ):
        super().__init__(env, config, env.observation_size, key, gain)
        keys = jax.random.split(jax.random.fold_in(key, 1), rounds - 1)
        self.later = tuple(Hearing(env, config, config.width, key, gain) for key in keys)

    def hear(
        self, hidden: Float[Array, "N H"], inbox: Any, near: Neighbourhood, key: PRNGKey | None
    ) -> Float[Array, "N H"]:
        hidden = self.take_in(hidden, near.observed(), near)
        for again in self.later:
            hidden = again.take_in(hidden, hidden, near)
        return hidden

    def speak(
        self,
        hidden: Float[Array, "N H"],
        near: Neighbourhood,
        key: PRNGKey | None,
        temperature: Float[Array, ""] | float,
        code: Float[Array, "N Z"] | None = None,
    ) -> Spoken:
        return Spoken(hidden, near.observed()[None])
