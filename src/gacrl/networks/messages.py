"""Discrete messages, and the one function that every message passes on its way."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from gacrl.types import Channel, Memory, PRNGKey


def gumbel_softmax(
    logits: Float[Array, "*b V"],
    noise: Float[Array, "*b V"],
    temperature: Float[Array, ""] | float,
    straight_through: bool = False,
    axis: int = -1,
) -> Float[Array, "*b V"]:
    """Equation (9): softmax((logits + Gumbel noise) / τ) over the axis of symbols (Jang et al. 2017).

    With `straight_through` the value is the one-hot of the largest entry and the gradient that of the soft
    sample.
    """
    soft = jax.nn.softmax((logits + noise) / temperature, axis=axis)
    if not straight_through:
        return soft
    return soft + jax.lax.stop_gradient(most_likely_symbol(soft, axis) - soft)


def most_likely_symbol(logits: Float[Array, "*b V"], axis: int = -1) -> Float[Array, "*b V"]:
    """The one-hot of the largest entry: the message when nothing is explored."""
    return jax.nn.one_hot(logits.argmax(axis), logits.shape[axis], dtype=logits.dtype, axis=axis)


def normal_and_gumbel(
    key: PRNGKey, num_normal: int, num_gumbel: int
) -> tuple[Float[Array, " num_normal"], Float[Array, " num_gumbel"]]:
    """Standard normal and Gumbel numbers out of one draw, by their inverse distribution functions."""
    uniform = jax.random.uniform(key, (num_normal + num_gumbel,), minval=jnp.finfo(jnp.float32).tiny)
    centred = jnp.maximum(2 * uniform[:num_normal] - 1, jnp.nextafter(-1.0, 0.0))
    return jnp.sqrt(2.0) * jax.lax.erf_inv(centred), -jnp.log(-jnp.log(uniform[num_normal:]))


class Mailbox(NamedTuple):
    """Messages still under way: the newest first."""

    sent: Float[Array, "D N V"]


def mailbox(num_agents: int, vocabulary: int, max_delay: int) -> Mailbox:
    """A policy memory that lets `Channel.delay` go up to `max_delay` steps; silence before the start."""
    return Mailbox(jnp.zeros((max_delay + 1, num_agents, vocabulary)))


def transmit(
    messages: Float[Array, "V N"], channel: Channel, key: PRNGKey | None = None, memory: Memory = ()
) -> tuple[Float[Array, "V N N"], Memory]:
    """What each agent receives of each other one: entry [:, i, j] is j's message as it reaches i.

    In order: late (delay), garbled (noise, which needs the key), translated (symbol_map), cut off
    (edge_keep). With the default channel every receiver gets what was sent.
    Raises ValueError for a delay without a mailbox, or noise without a key.
    """
    vocabulary, num_agents = messages.shape
    if isinstance(memory, Mailbox):
        memory = Mailbox(jnp.concatenate([messages.T[None], memory.sent[:-1]]))
    if channel.delay is not None:
        if not isinstance(memory, Mailbox):
            raise ValueError("a channel with a delay needs a policy memory made by networks.messages.mailbox")
        messages = jnp.take(memory.sent, channel.delay, axis=0, mode="clip").T
    if channel.noise is not None:
        if key is None:
            raise ValueError("a channel with noise needs a random key")
        garbled_key, symbol_key = jax.random.split(key)
        garbled = jax.random.bernoulli(garbled_key, channel.noise, (1, num_agents))
        random_symbol = jax.random.randint(symbol_key, (num_agents,), 0, vocabulary)
        messages = jnp.where(garbled, jax.nn.one_hot(random_symbol, vocabulary, axis=0), messages)
    if channel.symbol_map is not None:
        messages = jnp.einsum("vj,jvw->wj", messages, channel.symbol_map)
    received = jnp.broadcast_to(messages[:, None, :], (vocabulary, num_agents, num_agents))
    if channel.edge_keep is not None:
        received *= channel.edge_keep[None]
    return received, memory
