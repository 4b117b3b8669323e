"""What every kind of message is: a module that takes in what was heard before, and says something now.

A kind has a file of its own, and a line in `gacrl.config.kinds`. It brings what it needs: an inbox, if what is said at
a step is heard at the next one; its rounds and symbols; and a loss of its own. All messages pass `received`, so that a
channel silences, delays and scrambles all of them alike.
"""

from abc import abstractmethod
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from gacrl.networks.messages import transmit
from gacrl.types import Channel, PRNGKey


class Neighbourhood(NamedTuple):
    """Who hears whom, and where the speakers stand."""

    adjacency: Bool[Array, "N N"]
    """Entry [i, j]: j's message reaches i."""
    offsets: Float[Array, "N N 2"]
    """From i to j; 0 where the task has no space."""


class Spoken(NamedTuple):
    """What came of a step's conversation."""

    hidden: Float[Array, "N H"]
    message: Float[Array, "N V"] | None
    inbox: Any = ()
    """What is carried to the next step."""
    entropy: Float[Array, " N"] | float = 0.0
    """Of the symbols sent, in nats, mean over the rounds."""
    loss: Float[Array, " N"] | None = None
    """The kind's own, for each agent: its mean is added to what every learner minimises. None: it has none."""


class Communication(eqx.Module):
    """A kind of message. It is made by `Kind(NetworkConfig, key, gain)`; gain: of orthogonal weights, where given."""

    sends_symbols: ClassVar[bool] = False
    """Whether what is played is one symbol of `vocabulary` for each round."""

    def empty_inbox(self, num_agents: int) -> Any:
        """What nobody has said anything into; () for a kind that is heard in the step in which it is said."""
        return ()

    def hear(
        self,
        hidden: Float[Array, "N H"],
        inbox: Any,
        near: Neighbourhood,
        channel: Channel,
        key: PRNGKey | None,
    ) -> Float[Array, "N H"]:
        """Take in what was said at the step before."""
        return hidden

    @abstractmethod
    def speak(
        self,
        hidden: Float[Array, "N H"],
        near: Neighbourhood,
        channel: Channel,
        key: PRNGKey | None,
        temperature: Float[Array, ""] | float,
        code: Float[Array, "N Z"] | None = None,
    ) -> Spoken:
        """Say something, and take in what the others say now. Without a key nothing is drawn: how it is played."""


def received(
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


def neighbour_mean(received: Float[Array, "N N V"], adjacency: Bool[Array, "N N"]) -> Float[Array, "N V"]:
    """Over each agent's neighbours; 0 for an agent without any."""
    weight = adjacency / jnp.maximum(adjacency.sum(1, keepdims=True), 1)
    return jnp.einsum("ij,ijv->iv", weight, received)
