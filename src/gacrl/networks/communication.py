"""How agents talk: nothing, CommNet's averages, DIAL's regularised units, or discrete symbols over the graph.

Each kind is a module with two moments: `hear` takes in what was said at the last step (DIAL), `speak` says
something now and takes in what the others say now (CommNet, discrete). All messages pass
`networks.messages.transmit`, so that a channel silences, delays and scrambles all of them alike.
"""

import math
from typing import Any, NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from gacrl.config.algorithms import NetworkConfig
from gacrl.networks.graph import attend, with_length
from gacrl.networks.layers import Linear, Mlp
from gacrl.networks.messages import gumbel_softmax, most_likely_symbol, transmit
from gacrl.types import Channel, PRNGKey


class Neighbourhood(NamedTuple):
    """Who hears whom, and where the speakers stand."""

    adjacency: Bool[Array, "N N"]
    """Entry [i, j]: j's message reaches i."""
    offsets: Float[Array, "N N 2"]
    """From i to j; 0 where the task has no space."""


class Spoken(NamedTuple):
    hidden: Float[Array, "N H"]
    message: Float[Array, "N V"] | None
    inbox: Any
    """What is carried to the next step: () but for DIAL."""
    entropy: Float[Array, " N"] | float = 0.0
    """Of the symbols sent, in nats, mean over the rounds."""


class Silence(eqx.Module):
    """No communication."""

    def empty_inbox(self, num_agents: int) -> Any:
        return ()

    def hear(self, hidden: Array, inbox: Any, near: Neighbourhood, channel: Channel, key: PRNGKey | None) -> Array:
        return hidden

    def speak(
        self,
        hidden: Float[Array, "N H"],
        near: Neighbourhood,
        channel: Channel,
        key: PRNGKey | None,
        temperature: Float[Array, ""] | float,
        code: Float[Array, "N Z"] | None = None,
    ) -> Spoken:
        return Spoken(hidden, None, ())


class CommNet(Silence):
    """h ← tanh(H h + C mean of the neighbours' h), for some rounds (Sukhbaatar et al. 2016, eq. 2 and 3)."""

    own: tuple[Linear, ...]
    heard: tuple[Linear, ...]

    def __init__(self, config: NetworkConfig, key: PRNGKey, gain: float | None = None):
        own_key, heard_key = jax.random.split(key)
        width, rounds = config.width, config.rounds
        self.own = tuple(Linear(width, width, k, gain) for k in jax.random.split(own_key, rounds))
        self.heard = tuple(Linear(width, width, k, gain) for k in jax.random.split(heard_key, rounds))

    def speak(
        self,
        hidden: Float[Array, "N H"],
        near: Neighbourhood,
        channel: Channel,
        key: PRNGKey | None,
        temperature: Float[Array, ""] | float,
        code: Float[Array, "N Z"] | None = None,
    ) -> Spoken:
        message = hidden
        for own, heard in zip(self.own, self.heard, strict=True):
            message = hidden
            received = _received(message, channel, key)
            hidden = jnp.tanh(own(hidden) + heard(_mean(received, near.adjacency)))
        return Spoken(hidden, message, ())


class Dial(Silence):
    """Messages of V numbers that are noisy sigmoids while learning and bits when not (Foerster et al. 2016).

    What is said at a step is heard at the next one, and gradients flow back through it from hearer to speaker.
    """

    encode: Linear
    decode: Linear
    noise: float = eqx.field(static=True)

    def __init__(self, config: NetworkConfig, key: PRNGKey, gain: float | None = None):
        encode_key, decode_key = jax.random.split(key)
        self.encode = Linear(config.width, config.vocabulary, encode_key, gain)
        self.decode = Linear(config.vocabulary, config.width, decode_key, gain)
        self.noise = config.dial_noise

    def empty_inbox(self, num_agents: int) -> Any:
        return jnp.zeros((num_agents, self.encode.bias.shape[0]))

    def hear(self, hidden: Array, inbox: Any, near: Neighbourhood, channel: Channel, key: PRNGKey | None) -> Array:
        heard = _mean(_received(inbox, channel, key), near.adjacency)
        return hidden + jax.nn.relu(self.decode(heard))

    def speak(
        self,
        hidden: Float[Array, "N H"],
        near: Neighbourhood,
        channel: Channel,
        key: PRNGKey | None,
        temperature: Float[Array, ""] | float,
        code: Float[Array, "N Z"] | None = None,
    ) -> Spoken:
        message = discretise_regularise(self.encode(hidden), key, self.noise)
        return Spoken(hidden, message, message)


class Symbols(Silence):
    """Rounds of discrete messages: one symbol for each agent and round, straight-through Gumbel-Softmax.

    The first round's symbol is made of the agent's code, where it has one, as the paper's is of its latent; those
    of later rounds of what it knows by then. A receiver knows where the speaker stands: an edge's embedding is of
    the symbol and the offset. Over the neighbours: the mean, weighted by attention (scaled dot product of the
    receiver's query and the edge's embedding).

    With `nearest_agents` each agent hears its nearest neighbours alone, and the cost grows with N · nearest_agents.
    """

    encode: tuple[Linear, ...]
    edge: tuple[Mlp, ...]
    query: tuple[Linear, ...]
    merge: tuple[Linear, ...]
    straight_through: bool = eqx.field(static=True)
    nearest: int | None = eqx.field(static=True)

    def __init__(self, config: NetworkConfig, key: PRNGKey, gain: float | None = None):
        width, narrow, symbols = config.width, config.width // 2, config.vocabulary
        encode, edge, query, merge = jax.random.split(key, (4, config.rounds))
        first = width if config.latent == "none" else config.latent_size
        sizes = (first, *[width] * (config.rounds - 1))
        self.encode = tuple(Linear(i, symbols, k, gain) for i, k in zip(sizes, encode, strict=True))
        self.edge = tuple(Mlp(symbols + 3, (narrow,), k, gain) for k in edge)
        self.query = tuple(Linear(width, narrow, k, gain) for k in query)
        self.merge = tuple(Linear(width + narrow, width, k, gain) for k in merge)
        self.straight_through = config.communication == "discrete"
        self.nearest = config.nearest_agents

    def speak(
        self,
        hidden: Float[Array, "N H"],
        near: Neighbourhood,
        channel: Channel,
        key: PRNGKey | None,
        temperature: Float[Array, ""] | float,
        code: Float[Array, "N Z"] | None = None,
    ) -> Spoken:
        edges, speakers = _edges(near, self.nearest)
        where, message, entropy = with_length(edges.offsets), None, jnp.zeros(hidden.shape[0])
        for number, (encode, edge, query, merge) in enumerate(
            zip(self.encode, self.edge, self.query, self.merge, strict=True)
        ):
            logits = encode(hidden if code is None or number else code)
            log_symbol = jax.nn.log_softmax(logits)
            entropy -= (jnp.exp(log_symbol) * log_symbol).sum(-1) / len(self.encode)
            if key is None and not self.straight_through:
                message = jax.nn.softmax(logits / temperature)  # as continuous in play as in learning
            elif key is None:
                message = most_likely_symbol(logits)
            else:
                noise = jax.random.gumbel(jax.random.fold_in(key, number), logits.shape)
                message = gumbel_softmax(logits, noise, temperature, self.straight_through)
            symbols = _received(message, channel, key, speakers)
            received = edge(jnp.concatenate([symbols, where], axis=-1))  # [N K H/2]
            score = jnp.einsum("nh,nkh->nk", query(hidden), received) / math.sqrt(received.shape[-1])
            heard = attend(received, jnp.where(edges.adjacency, score, -jnp.inf))
            hidden = hidden + jax.nn.relu(merge(jnp.concatenate([hidden, heard], axis=-1)))
        return Spoken(hidden, message, (), entropy)


Communication: TypeAlias = Silence | CommNet | Dial | Symbols


def make(config: NetworkConfig, key: PRNGKey, gain: float | None = None) -> Communication:
    """The communication that the configuration names."""
    if config.communication == "none":
        return Silence()
    kinds = {"commnet": CommNet, "dial": Dial, "discrete": Symbols, "soft": Symbols}
    return kinds[config.communication](config, key, gain)


def discretise_regularise(message: Float[Array, "N V"], key: PRNGKey | None, noise: float) -> Float[Array, "N V"]:
    """DIAL's DRU: σ(m + noise · N(0, 1)) while learning (with a key), 1{m > 0} when not."""
    if key is None:
        return (message > 0).astype(message.dtype)
    return jax.nn.sigmoid(message + noise * jax.random.normal(key, message.shape))


def _edges(near: Neighbourhood, nearest: int | None) -> tuple[Neighbourhood, Int[Array, "N K"] | None]:
    """The edges to each agent from its nearest neighbours, and who those are; all edges and None for no limit."""
    if nearest is None or nearest >= near.adjacency.shape[0]:
        return near, None
    squared = jnp.where(near.adjacency, jnp.square(near.offsets).sum(-1), jnp.inf)
    speakers = jax.lax.top_k(-squared, nearest)[1]
    offsets = jnp.take_along_axis(near.offsets, speakers[..., None], axis=1)
    return Neighbourhood(jnp.take_along_axis(near.adjacency, speakers, axis=1), offsets), speakers


def _received(
    message: Float[Array, "N V"], channel: Channel, key: PRNGKey | None, speakers: Int[Array, "N K"] | None = None
) -> Float[Array, "N K V"]:
    """Entry [i, k]: the message of i's k-th speaker as it reaches i; of all agents for None."""
    if channel == Channel():
        if speakers is not None:
            return message[speakers]
        return jnp.broadcast_to(message[None], (message.shape[0], *message.shape))
    key = None if key is None else jax.random.fold_in(key, 1_000)
    received = jnp.moveaxis(transmit(message.T, channel, key)[0], 0, -1)
    return received if speakers is None else jnp.take_along_axis(received, speakers[..., None], axis=1)


def _mean(received: Float[Array, "N N V"], adjacency: Bool[Array, "N N"]) -> Float[Array, "N V"]:
    """Over each agent's neighbours; 0 for an agent without any."""
    weight = adjacency / jnp.maximum(adjacency.sum(1, keepdims=True), 1)
    return jnp.einsum("ij,ijv->iv", weight, received)
