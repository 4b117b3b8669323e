"""TarMAC: messages with a signature, of which each receiver weighs those that it asks for."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from gacrl.config.algorithms import NetworkConfig
from gacrl.envs.environment import Environment
from gacrl.networks.communication.base import Communication, Neighbourhood, Spoken, Weighed, received
from gacrl.networks.graph import attend
from gacrl.networks.layers import Linear
from gacrl.types import PRNGKey


class Tarmac(Communication):
    """A message is a signature k and a value v; receiver i weighs j by softmax_j(q_i · k_j / √d_k) (Das et al. 2019).

    In each round h ← tanh(W [Σ_j α_ij v_j, h]). As in the paper the softmax has the receiver itself among its
    speakers, so that an agent may leave aside what it hears, and an agent alone hears itself. Over the graph, not over
    everyone, and heard in the step in which it is said, where the paper's first round is heard at the next one.
    Messages are numbers, in play too.
    """

    signature: tuple[Float[Array, "D H"], ...]
    """Without a bias, which adds the same to all scores of a receiver: its gradient would be rounding alone."""
    value: tuple[Linear, ...]
    query: tuple[Linear, ...]
    merge: tuple[Linear, ...]
    signature_size: int = eqx.field(static=True)

    def __init__(self, env: Environment, config: NetworkConfig, key: PRNGKey, gain: float | None = None):
        width, size, value_size = config.width, config.signature_size, config.value_size
        signature, value, query, merge = jax.random.split(key, (4, config.rounds))
        self.signature = tuple(Linear(width, size, k, gain).weight for k in signature)
        self.value = tuple(Linear(width, value_size, k, gain) for k in value)
        self.query = tuple(Linear(width, size, k, gain) for k in query)
        self.merge = tuple(Linear(value_size + width, width, k, gain) for k in merge)
        self.signature_size = size

    def speak(
        self,
        hidden: Float[Array, "N H"],
        near: Neighbourhood,
        key: PRNGKey | None,
        temperature: Float[Array, ""] | float,
        code: Float[Array, "N Z"] | None = None,
    ) -> Spoken:
        itself = jnp.ones((hidden.shape[0], 1), bool)
        listens, said = jnp.concatenate([near.adjacency, itself], axis=1), []
        scores: list[Array] = []
        for number, (signature, value, query, merge) in enumerate(
            zip(self.signature, self.value, self.query, self.merge, strict=True)
        ):
            message = jnp.concatenate([hidden @ signature.T, value(hidden)], axis=-1)
            said.append(message)
            others = received(message, near, number, len(self.value))
            heard = jnp.concatenate([others, message[:, None]], axis=1)  # one's own words do not travel
            signatures, values = jnp.split(heard, [self.signature_size], axis=-1)
            score = jnp.einsum("nd,nkd->nk", query(hidden), signatures) / math.sqrt(self.signature_size)
            scores.append(jnp.where(listens, score, -jnp.inf))
            context = attend(values, scores[-1])
            hidden = jnp.tanh(merge(jnp.concatenate([context, hidden], axis=-1)))
        return Spoken(hidden, jnp.stack(said), weighed=Weighed(tuple(scores)))
