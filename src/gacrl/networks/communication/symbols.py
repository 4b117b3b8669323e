"""Rounds of discrete symbols over the graph: the paper's messages."""

import math
from abc import abstractmethod
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from gacrl.config.algorithms import NetworkConfig
from gacrl.envs.environment import Environment
from gacrl.networks.communication.base import Communication, Neighbourhood, Spoken, Weighed, embedded, received
from gacrl.networks.graph import attend, attend_to_speakers, sighted_size
from gacrl.networks.layers import Linear, Mlp, rectified
from gacrl.networks.messages import gumbel_sigmoid, gumbel_softmax, most_likely_symbol
from gacrl.types import PRNGKey


class Symbols(Communication):
    """Rounds of messages: one symbol for each agent and round; what a symbol is, kinds of this say.

    The first round's symbol is made of the agent's code, where it has one, as the paper's is of its latent; those
    of later rounds of what it knows by then. An edge's embedding is of the symbol and of what the receiver itself sees
    of the speaker. Over the neighbours: the mean, weighted by attention (scaled dot product of the receiver's query
    and the edge's embedding).

    With a gate an agent may say nothing in a round. Its word is then zeros, and whoever says zeros is not heard, as if
    the edge were cut. A price makes each word that is said a loss of its speaker, another one large logits.
    """

    encode: tuple[Linear, ...]
    edge: tuple[Mlp, ...]
    query: tuple[Linear, ...]
    merge: tuple[Linear, ...]
    gate: tuple[Linear, ...]
    """Whether to speak, a layer for each round; () where every agent always does."""
    word_price: float = eqx.field(static=True)
    logit_price: float = eqx.field(static=True)
    noise: float = eqx.field(static=True)
    slope: float = eqx.field(static=True)
    straight_through: bool = eqx.field(static=True)
    speaker_identity: bool = eqx.field(static=True)

    def __init__(self, env: Environment, config: NetworkConfig, key: PRNGKey, gain: float | None = None):
        width, narrow, symbols = config.width, config.width // 2, config.vocabulary
        encode, edge, query, merge = jax.random.split(key, (4, config.rounds))
        first = width if config.latent == "none" else config.latent_size
        sizes = (first, *[width] * (config.rounds - 1))
        self.encode = tuple(Linear(i, symbols, k, gain) for i, k in zip(sizes, encode, strict=True))
        self.noise, self.straight_through = config.symbol_noise, config.symbols == "straight_through"
        self.speaker_identity = config.speaker_identity
        known = symbols + sighted_size(env) + env.num_agents * config.speaker_identity
        self.edge = tuple(Mlp(known, (narrow,), k, gain, config.heard_slope) for k in edge)
        self.query = tuple(Linear(width, narrow, k, gain) for k in query)
        self.merge = tuple(Linear(width + narrow, width, k, gain) for k in merge)
        gate = jax.random.split(jax.random.fold_in(key, 1), config.rounds) if config.gate else ()
        self.gate = tuple(Linear(i, 1, k, gain) for i, k in zip(sizes, gate, strict=False))
        self.word_price, self.logit_price, self.slope = config.word_price, config.logit_price, config.heard_slope

    def speak(
        self,
        hidden: Float[Array, "N H"],
        near: Neighbourhood,
        key: PRNGKey | None,
        temperature: Float[Array, ""] | float,
        code: Float[Array, "N Z"] | None = None,
    ) -> Spoken:
        said: list[Array] = []
        squares = jnp.zeros(hidden.shape[0])
        could_say: list[Array] = []
        scores: list[Array] = []
        rounds = len(self.encode)
        for number, (encode, edge, query, merge) in enumerate(
            zip(self.encode, self.edge, self.query, self.merge, strict=True)
        ):
            meant = hidden if code is None or number else code
            logits = encode(meant)
            could_say.append(logits)
            squares += jnp.square(logits).mean(-1)
            draw = None if key is None else jax.random.fold_in(key, number)
            said.append(self.symbol(logits, draw, temperature))
            if self.gate:
                said[-1] *= self.spoke(meant, number, draw, temperature)
            edges_heard = embedded(edge, said[-1], near, number, rounds, self.speaker_identity)
            score = jnp.einsum("nh,nkh->nk", query(hidden), edges_heard) / math.sqrt(edges_heard.shape[-1])
            heeded = edges_heard, jnp.where(near.adjacency, score, -jnp.inf)
            if self.gate:
                heard = attend_to_speakers(*heeded, received(said[-1], near, number, rounds).sum(-1))
            else:
                heard = attend(*heeded)
            scores.append(heeded[1])
            hidden = hidden + rectified(merge(jnp.concatenate([hidden, heard], axis=-1)), self.slope)
        messages = jnp.stack(said)
        prices = [self.word_price * messages.sum((0, 2))] if self.word_price else []
        prices += [self.logit_price * squares] if self.logit_price else []
        price = sum(prices[1:], prices[0]) if prices else None
        return Spoken(hidden, messages, loss=price, weighed=Weighed(tuple(scores), tuple(could_say)))

    def spoke(
        self, meant: Float[Array, "N M"], number: int, key: PRNGKey | None, temperature: Float[Array, ""] | float
    ) -> Float[Array, "N 1"]:
        """Return who says a word in a round, 1 or 0, with the gradient of a soft choice."""
        logit = self.gate[number](meant)
        noise = None if key is None else self.noise * jax.random.logistic(jax.random.fold_in(key, 1), logit.shape)
        return gumbel_sigmoid(logit, noise, temperature)

    def drawn(self, key: PRNGKey, logits: Float[Array, "N V"]) -> Float[Array, "N V"]:
        """Draw the Gumbel noise of a round."""
        noise = jax.random.gumbel(key, logits.shape)
        return noise if self.noise == 1.0 else self.noise * noise

    @abstractmethod
    def symbol(
        self, logits: Float[Array, "N V"], key: PRNGKey | None, temperature: Float[Array, ""] | float
    ) -> Float[Array, "N V"]:
        """Return the symbols of a round, from their logits; without a key as they are played."""


class DiscreteSymbols(Symbols):
    """Symbols that are one-hot when played, the most likely ones.

    While learning they are one-hot as well, with the gradient of the soft sample, or soft. (A one-hot sample is drawn
    the same way at every temperature: only soft ones grow sharper as it falls, and are heard before they are sharp.)
    """

    sends_symbols: ClassVar[bool] = True

    def symbol(
        self, logits: Float[Array, "N V"], key: PRNGKey | None, temperature: Float[Array, ""] | float
    ) -> Float[Array, "N V"]:
        if key is None:
            return most_likely_symbol(logits)
        return gumbel_softmax(logits, self.drawn(key, logits), temperature, self.straight_through)


class SoftSymbols(Symbols):
    """Distributions over symbols: as continuous when played as they are while learning."""

    def symbol(
        self, logits: Float[Array, "N V"], key: PRNGKey | None, temperature: Float[Array, ""] | float
    ) -> Float[Array, "N V"]:
        if key is None:
            return jax.nn.softmax(logits / temperature)
        return gumbel_softmax(logits, self.drawn(key, logits), temperature)
