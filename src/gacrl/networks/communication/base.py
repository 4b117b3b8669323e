"""What every kind of message is: a module that takes in what was heard before, and says something now.

A kind has a file of its own, and a line in `gacrl.config.kinds`. It brings what it needs: an inbox, if what is said at
a step is heard at the next one; its rounds and symbols; and a loss of its own. All words pass `arriving`, where whoever
intervenes replaces them, and all edges are those of the neighbourhood, where cut ones are missing.
"""

from abc import abstractmethod
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from gacrl.networks.arrives import arriving
from gacrl.networks.graph import sighted
from gacrl.networks.layers import Mlp
from gacrl.types import Arrives, PRNGKey


class Neighbourhood(NamedTuple):
    """Who hears whom in a step, what a listener itself sees of a speaker, and what arrives.

    Each agent has K speakers: all N agents in order, or its nearest ones. An edge tells nothing else.
    """

    adjacency: Bool[Array, "N K"]
    """Entry [i, k]: i hears its k-th speaker."""
    sight: Float[Array, "N K S"]
    """What i sees of its k-th speaker, 0 where it does not see it; S = 0 where agents do not see each other."""
    speakers: Int[Array, "N K"] | None = None
    """Who the speakers are; None: agents 0 to N − 1."""
    arrives: Arrives = Arrives()
    features: Float[Array, "N O"] | None = None
    """What each of the N agents sees, for a kind that says it as it is."""

    def observed(self) -> Float[Array, "N O"]:
        """Return what each of the N agents sees."""
        assert self.features is not None
        return self.features

    def hear(self, words: Float[Array, "N V"]) -> Float[Array, "N K V"]:
        """Return the words of each agent's speakers."""
        if self.speakers is not None:
            return words[self.speakers]
        return jnp.broadcast_to(words[None], (words.shape[0], *words.shape))


class Weighed(NamedTuple):
    """How words came about and what they were worth to who heard them, for whoever looks on.

    A tuple has an entry for each round, as it was computed on the way: no learner reads them, and none pays for them.
    """

    scores: tuple[Float[Array, "N S"], ...]
    """Whose softmax is the attention that each agent pays to its K speakers (and perhaps, behind them, to itself)."""
    logits: tuple[Float[Array, "N V"], ...] = ()
    """Of the symbols that each agent could send; () where words are no symbols."""


class Spoken(NamedTuple):
    """What came of a step's conversation."""

    hidden: Float[Array, "N H"]
    messages: Float[Array, "R N V"] | None
    """What each agent sent in each round."""
    inbox: Any = ()
    """What is carried to the next step."""
    loss: Float[Array, " N"] | None = None
    """The kind's own, for each agent: its mean is added to what every learner minimises. None: it has none."""
    weighed: Weighed | None = None
    """None for a kind without attention."""


class Communication(eqx.Module):
    """A kind of message. It is made by `Kind(env, NetworkConfig, key, gain)`; gain: of orthogonal weights, if given."""

    sends_symbols: ClassVar[bool] = False
    """Whether what is played is one symbol of `vocabulary` for each round."""
    heard_late: ClassVar[bool] = False
    """Whether what is said at a step is heard at the next one."""
    bits_of_number: ClassVar[float] = 32.0
    """Bits of each number that is sent in play, where these are no symbols."""

    def empty_inbox(self, num_agents: int) -> Any:
        """Return what nobody has said anything into; () for a kind that is heard in the step in which it is said."""
        return ()

    def hear(
        self, hidden: Float[Array, "N H"], inbox: Any, near: Neighbourhood, key: PRNGKey | None
    ) -> Float[Array, "N H"]:
        """Take in what was said at the step before."""
        return hidden

    @abstractmethod
    def speak(
        self,
        hidden: Float[Array, "N H"],
        near: Neighbourhood,
        key: PRNGKey | None,
        temperature: Float[Array, ""] | float,
        code: Float[Array, "N Z"] | None = None,
    ) -> Spoken:
        """Say something, and take in what the others say now. Without a key nothing is drawn: how it is played."""


def received(
    words: Float[Array, "N V"], near: Neighbourhood, number: int = 0, rounds: int = 1
) -> Float[Array, "N K V"]:
    """Return what each agent receives of its speakers in round `number` (from 0) of so many."""
    return near.hear(arriving(words, near.arrives, number, rounds))


def embedded(
    layers: Mlp,
    words: Float[Array, "N V"],
    near: Neighbourhood,
    number: int = 0,
    rounds: int = 1,
    who: bool = False,
) -> Float[Array, "N K H"]:
    """Embed what each agent receives of its speakers, with what it sees of them and, if asked, who they are.

    Where agents do not see each other, all hear the same of a speaker: it is embedded once, not for every listener.
    """
    said = arriving(words, near.arrives, number, rounds)
    names = [jnp.eye(len(said))] if who else []
    if not near.sight.shape[-1]:
        return near.hear(layers(jnp.concatenate([said, *names], axis=-1)))
    parts = [near.hear(said), sighted(near.sight), *map(near.hear, names)]
    return layers(jnp.concatenate(parts, axis=-1))


def neighbour_mean(received: Float[Array, "N K V"], adjacency: Bool[Array, "N K"]) -> Float[Array, "N V"]:
    """Average over each agent's neighbours; 0 for an agent without any."""
    weight = adjacency / jnp.maximum(adjacency.sum(1, keepdims=True), 1)
    return jnp.einsum("ij,ijv->iv", weight, received)
