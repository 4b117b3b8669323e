"""How a network came to a decision: whom its agents heeded, what else they could have said, what they saw.

The network is asked once more for what it weighed on the way, in the same program: the compiler finds that most of it
is computed already. Things are named by their place in the picture of the moment.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from gacrl.envs.environment import Environment
from gacrl.networks.agent import AgentMemory, AgentNetwork, AgentOutput
from gacrl.networks.communication.base import Weighed
from gacrl.networks.graph import nearest_speakers, shares_of
from gacrl.scene import Discs, Scene
from gacrl.types import Arrives, Memory, Observation

NAMED = 4
"""So many things and words are named of each kind, the nearest or likeliest."""
_SAME = 1e-3
"""Arena units within which what is seen and what is in the picture are the same thing."""


class Named(NamedTuple):
    """Some things of a picture for each agent."""

    which: Int[Array, "N K"]
    """−1: none, or nothing that is in the picture."""
    value: Float[Array, "N K"]


class Insight(NamedTuple):
    """What there is to say about a decision; None where the network does not say it."""

    heeded: Float[Array, "N N"] | None
    """The share of its attention that agent i pays to j, the mean over the rounds."""
    words: Int[Array, "R N K"] | None
    """The likeliest symbols, and their chances."""
    chances: Float[Array, "R N K"] | None
    head: Float[Array, "N A"] | None
    """What each action looks worth, or its logit; −∞ of those that an agent does not have."""
    looks: Named | None
    """Marks that the second look went to, and the share of each."""
    marks: Named | None
    """The nearest marks in sight."""
    others: Named | None
    """The nearest agents in sight."""
    more: Int[Array, " N"] | None
    """Things in sight besides."""


def insight(
    env: Environment,
    network: AgentNetwork,
    memory: Memory,
    seen: Observation,
    said: Float[Array, "R N V"] | None,
    scene: Scene,
) -> Insight:
    """Ask for what was weighed in one environment. memory: the policy's, before the decision. said: what was sent."""
    if said is not None:  # symbols may have been drawn: what was heard then is what counts
        seen = seen._replace(arrives=_as_said(seen.arrives, said))
    output = _asked(network, memory, seen)
    weighed, gaze = output.weighed, output.gaze
    speakers = heard_of(seen, output.adjacency, network.nearest)[1]
    words = chances = None
    if weighed is not None and weighed.logits:
        likely = jax.nn.softmax(jnp.stack(weighed.logits))
        chances, words = jax.lax.top_k(likely, min(NAMED, likely.shape[-1]))
    head = None
    if not env.continuous_actions:
        head = jnp.where(seen.action_mask, output.head, -jnp.inf)
    return Insight(
        heeded=None if weighed is None else _heeded(weighed, said, speakers),
        words=words,
        chances=chances,
        head=head,
        looks=None if gaze is None else _named(shares_of(gaze.scores), gaze.offsets, scene, scene.marks),
        **_in_sight(env, seen, scene),
    )


def heard_of(
    seen: Observation, adjacency: Bool[Array, "N N"], nearest: int | None
) -> tuple[Bool[Array, "N N"], Int[Array, "N K"] | None]:
    """Return whom each agent hears, and who its speakers are where it listens to so many of them at the most."""
    if nearest is None or nearest >= adjacency.shape[0]:
        return adjacency, None
    speakers = nearest_speakers(seen.positions, adjacency, nearest)
    listens = _spread(jnp.ones(speakers.shape, bool), speakers)
    return adjacency & listens, speakers


def _heeded(
    weighed: Weighed, said: Float[Array, "R N V"] | None, speakers: Int[Array, "N K"] | None
) -> Float[Array, "N N"]:
    """Return the shares of attention, the mean over the rounds; whoever said nothing in a round has none in it."""
    rounds: list[Array] = []
    for number, score in enumerate(weighed.scores):
        if said is not None and weighed.logits:
            spoke = said[number].sum(-1) > 0
            heard = jnp.broadcast_to(spoke[None], score.shape) if speakers is None else spoke[speakers]
            score = jnp.where(heard, score, -jnp.inf)
        rounds.append(_spread(shares_of(score)[:, : _speakers_of(score, speakers)], speakers))
    return jnp.stack(rounds).mean(0)


def _speakers_of(score: Float[Array, "N S"], speakers: Int[Array, "N K"] | None) -> int:
    return score.shape[0] if speakers is None else speakers.shape[1]


def _spread(values: Array, speakers: Int[Array, "N K"] | None) -> Array:
    """Turn a column for each speaker [N K] into one for each agent [N N]."""
    if speakers is None:
        return values
    size = values.shape[0]
    return jnp.zeros((size, size), values.dtype).at[jnp.arange(size)[:, None], speakers].set(values)


def _as_said(arrives: Arrives, said: Float[Array, "R N V"]) -> Arrives:
    """Let arrive what did: what was sent, or what stood in for it."""
    if arrives.values is None:
        return arrives._replace(values=said)
    if arrives.replaced is None:
        return arrives
    return arrives._replace(values=jnp.where(arrives.replaced[..., None], arrives.values, said), replaced=None)


def _asked(network: AgentNetwork, memory: Memory, seen: Observation) -> AgentOutput:
    """Ask the network without drawing anything. The policy's memory holds that of the network, if it has one."""
    empty = jax.eval_shape(lambda: network.initial_memory(seen.features.shape[0]))
    found = [it for it in jax.tree.leaves(memory, is_leaf=_remembers) if _remembers(it)]
    remembered = found[0] if isinstance(empty, AgentMemory) else ()
    alone = jax.tree.map(lambda leaf: leaf[None], (seen, remembered))  # shaped as it was when the agents decided
    output = jax.vmap(lambda seen, memory: network(seen, memory)[0])(*alone)
    return jax.tree.map(lambda leaf: leaf[0], output)


def _remembers(it: Any) -> bool:
    return isinstance(it, AgentMemory)


def _in_sight(env: Environment, seen: Observation, scene: Scene) -> dict[str, Any]:
    """Return the nearest things that each agent sees, for tasks that take apart what is seen."""
    entities = env.entities(seen)
    if not entities.landmarks.shape[1] + entities.agents.shape[1]:
        return dict.fromkeys(("marks", "others", "more"))
    groups = {
        "marks": (entities.landmarks, entities.landmark_mask, scene.marks),
        "others": (entities.agents, entities.agent_mask, scene.agents),
    }
    near = {
        name: _named(-jnp.where(there, jnp.square(offsets).sum(-1), jnp.inf), offsets, scene, things)
        for name, (offsets, there, things) in groups.items()
    }
    total = entities.landmark_mask.sum(-1) + entities.agent_mask.sum(-1)
    listed = sum((named.which >= 0).sum(-1) for named in near.values())
    return {**near, "more": total - listed}


def _named(rank: Float[Array, "N M"], offsets: Float[Array, "N M 2"], scene: Scene, things: Discs) -> Named:
    """Return those of the highest rank by the place of their disc: who stands where an offset leads to."""
    size, present = min(NAMED, rank.shape[1]), things.radius.shape[0]
    if not size or not present:
        return Named(jnp.full((rank.shape[0], 0), -1), jnp.zeros((rank.shape[0], 0)))
    value, chosen = jax.lax.top_k(rank, size)
    at = scene.agents.positions[:, None] + jnp.take_along_axis(offsets, chosen[..., None], axis=1)
    away = jnp.square(at[:, :, None] - things.positions[None, None]).sum(-1)
    away = jnp.where(things.there[None, None], away, jnp.inf)
    found = jnp.isfinite(value) & (away.min(-1) < _SAME**2)
    return Named(jnp.where(found, away.argmin(-1), -1), value)
