"""From what an agent sees to a vector for each agent: a plain network, or a graph of the entities in sight.

Both are computed by each agent from its own observation; what other agents know reaches it only by messages
(`networks.communication`).
"""

import math
from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from gacrl.config.algorithms import NetworkConfig
from gacrl.envs.environment import Environment
from gacrl.networks.graph import attend, with_length
from gacrl.networks.layers import Linear, Mlp, Score, rectified
from gacrl.types import Entities, Observation, PRNGKey

NEAR = 0.2
"""Arena units within which an offset is also given magnified: an agent's push moves it this far."""
SCALES = 5
"""Numbers that an offset is given as."""


class Looked(NamedTuple):
    """What came of looking: a vector for each agent, and one for each landmark that it sees."""

    hidden: Float[Array, "N H"]
    places: Float[Array, "N L H"] | None = None
    """None for a torso that does not tell landmarks apart."""
    there: Bool[Array, "N L"] | None = None
    """Which of them are in sight."""
    offsets: Float[Array, "N L 2"] | None = None
    """Where they are, from each agent."""


class Gaze(NamedTuple):
    """Where a second look went: for whoever looks on."""

    offsets: Float[Array, "N L 2"]
    scores: Float[Array, "N L"]
    """Whose softmax is the attention that each agent pays to the landmark there."""


class MlpTorso(eqx.Module):
    """Layers over the observation as one vector: tied to the number of entities, and to their order."""

    layers: Mlp

    def __init__(self, env: Environment, config: NetworkConfig, key: PRNGKey, gain: float | None = None):
        self.layers = Mlp(env.observation_size, (config.width,) * config.depth, key, gain)

    def __call__(self, observation: Observation) -> Looked:
        return Looked(self.layers(observation.features))


class GraphTorso(eqx.Module):
    """A graph around each agent: itself, the landmarks and the other agents it sees, by relative position.

    Messages run along the edges agent → landmark (who else stands how near to it), then landmark → agent and
    agent → agent. All weights are shared, so the same parameters serve any number of entities, their order does
    not matter, and the vector of an agent does not change when the whole world is moved.
    """

    rival: Mlp
    """Of a landmark and another agent: how the latter stands to the former."""
    landmark: Mlp
    agent: Mlp
    attention: Score
    out: Mlp
    view: Callable[[Observation], Entities] = eqx.field(static=True)
    nearest_landmarks: int | None = eqx.field(static=True)
    nearest_agents: int | None = eqx.field(static=True)

    def __init__(self, env: Environment, config: NetworkConfig, key: PRNGKey, gain: float | None = None):
        rival_key, landmark_key, agent_key, attention_key, out_key = jax.random.split(key, 5)
        width, narrow = config.width, config.width // 2
        seen = jax.eval_shape(lambda: env.entities(env.reset(jax.random.key(0), env.default_params())[1]))
        own = seen.own.shape[-1]
        known, told = (0 if it is None else it.shape[-1] for it in (seen.landmark_features, seen.agent_features))
        self.rival = Mlp(2 * SCALES + known + told, (narrow,), rival_key, gain)
        self.landmark = Mlp(own + SCALES + known + narrow, (width, width), landmark_key, gain, config.seen_slope)
        self.agent = Mlp(own + SCALES + told, (narrow,), agent_key, gain)
        self.attention = Score(width, attention_key, gain)
        self.out = Mlp(own + 2 * width + narrow, (width,), out_key, gain)
        self.view = env.entities
        self.nearest_landmarks, self.nearest_agents = config.nearest_landmarks, config.nearest_agents

    def __call__(self, observation: Observation) -> Looked:
        seen = self.view(observation)
        own = seen.own
        landmarks = _nearest(seen.landmarks, seen.landmark_mask, seen.landmark_features, self.nearest_landmarks)
        agents = _nearest(seen.agents, seen.agent_mask, seen.agent_features, self.nearest_agents)

        # Agent → landmark, in the agent's own frame: where each rival stands from each landmark, and where I do.
        between = _scales(agents.offsets[:, None, :, :] - landmarks.offsets[:, :, None, :])  # [N L M 5]
        mine = jnp.broadcast_to(_scales(-landmarks.offsets)[:, :, None, :], between.shape)
        told = _features(landmarks, between, axis=2) + _features(agents, between, axis=1)
        rivals = self.rival(jnp.concatenate([between, mine, *told], axis=-1))  # [N L M H/2]
        contest = _pool_max(rivals, agents.there[:, None, :], axis=2)

        # Landmark → agent, and agent → agent.
        places = [_repeat(own, landmarks.offsets), _scales(landmarks.offsets), *_features(landmarks), contest]
        places = self.landmark(jnp.concatenate(places, axis=-1))
        score = jnp.where(landmarks.there, self.attention(places), -jnp.inf)
        chosen = attend(places, score)
        best = _pool_max(places, landmarks.there, axis=1)
        others = [_repeat(own, agents.offsets), _scales(agents.offsets), *_features(agents)]
        others = self.agent(jnp.concatenate(others, axis=-1))
        crowd = _pool_max(others, agents.there, axis=1)
        hidden = self.out(jnp.concatenate([own, chosen, best, crowd], axis=-1))
        return Looked(hidden, places, landmarks.there, landmarks.offsets)


class SecondLook(eqx.Module):
    """One more look at the landmarks, for what was heard: without it, who is told "go to green" has nothing left to
    choose from, since the torso has pooled the landmarks before anything is heard.

    Attention over the landmarks' vectors, queried by what the agent knows after the messages. A sharpness of 4 nearly
    undoes the division by √H: agents that hesitate between two landmarks stop between them.
    """

    query: Linear
    merge: Linear
    sharpness: float = eqx.field(static=True)
    slope: float = eqx.field(static=True)

    def __init__(self, config: NetworkConfig, key: PRNGKey, gain: float | None = None):
        query_key, merge_key = jax.random.split(key)
        self.query = Linear(config.width, config.width, query_key, gain)
        self.merge = Linear(2 * config.width, config.width, merge_key, gain)
        self.sharpness, self.slope = config.look_sharpness, config.heard_slope

    def __call__(self, hidden: Float[Array, "N H"], looked: Looked) -> tuple[Float[Array, "N H"], Gaze]:
        places, there = looked.places, looked.there
        assert places is not None and there is not None and looked.offsets is not None
        score = jnp.einsum("nh,nlh->nl", self.query(hidden), places) * (
            self.sharpness / math.sqrt(places.shape[-1])
        )
        score = jnp.where(there, score, -jnp.inf)
        merged = rectified(self.merge(jnp.concatenate([hidden, attend(places, score)], axis=-1)), self.slope)
        return hidden + merged, Gaze(looked.offsets, score)


class _Group(NamedTuple):
    """The entities of one kind that an agent looks at."""

    offsets: Float[Array, "N M 2"]
    there: Bool[Array, "N M"]
    features: Float[Array, "N M F"] | None


Torso: TypeAlias = MlpTorso | GraphTorso


def make(env: Environment, config: NetworkConfig, key: PRNGKey, gain: float | None = None) -> Torso:
    """Make the torso that the configuration names."""
    return (GraphTorso if config.torso == "graph" else MlpTorso)(env, config, key, gain)


def _nearest(
    offsets: Float[Array, "N M 2"],
    there: Bool[Array, "N M"],
    features: Float[Array, "N M F"] | None,
    count: int | None,
) -> _Group:
    """The nearest of the entities that are there; all of them for None."""
    if count is None or count >= offsets.shape[1]:
        return _Group(offsets, there, features)
    squared = jnp.square(offsets).sum(-1)
    near = jax.lax.top_k(-jnp.where(there, squared, jnp.inf), count)[1]

    def chosen(values: Float[Array, "N M F"]) -> Float[Array, "N K F"]:
        return jnp.take_along_axis(values, near[..., None], axis=1)

    there = jnp.take_along_axis(there, near, axis=1)
    return _Group(chosen(offsets), there, None if features is None else chosen(features))


def _features(group: _Group, like: Float[Array, "N L M S"] | None = None, axis: int = 0) -> list[Array]:
    """The features of a group, none or one array; `like`: repeated along an axis, for each pair."""
    if group.features is None:
        return []
    if like is None:
        return [group.features]
    values = jnp.expand_dims(group.features, axis)
    return [jnp.broadcast_to(values, (*like.shape[:3], values.shape[-1]))]


def _scales(offsets: Float[Array, "*b 2"]) -> Float[Array, "*b 5"]:
    """The offset, its length, and the offset near by magnified; finite gradients at 0."""
    return jnp.concatenate([with_length(offsets), jnp.tanh(offsets / NEAR)], axis=-1)


def _repeat(own: Float[Array, "N K"], entities: Float[Array, "N M 2"]) -> Float[Array, "N M K"]:
    return jnp.broadcast_to(own[:, None, :], (*entities.shape[:2], own.shape[-1]))


def _pool_max(values: Float[Array, "..."], there: Bool[Array, "..."], axis: int) -> Float[Array, "..."]:
    """The largest over an axis of those that are there, and at least 0, which stands for nobody there."""
    return jnp.max(jnp.where(there[..., None], values, 0.0), axis=axis, initial=0.0)
