"""From what an agent sees to a vector for each agent: a plain network, or a graph of the entities in sight.

Both are computed by each agent from its own observation; what other agents know reaches it only by messages
(`networks.communication`).
"""

from collections.abc import Callable
from typing import TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from gacrl.config.algorithms import NetworkConfig
from gacrl.envs.environment import Environment, SpatialEnvironment
from gacrl.networks.graph import attend, with_length
from gacrl.networks.layers import Mlp, Score
from gacrl.types import Entities, Observation, PRNGKey

NEAR = 0.2
"""Arena units within which an offset is also given magnified: an agent's push moves it this far."""
SCALES = 5
"""Numbers that an offset is given as."""


class MlpTorso(eqx.Module):
    """Layers over the observation as one vector: tied to the number of entities, and to their order."""

    layers: Mlp

    def __init__(self, env: Environment, config: NetworkConfig, key: PRNGKey, gain: float | None = None):
        self.layers = Mlp(env.observation_size, (config.width,) * config.depth, key, gain)

    def __call__(self, observation: Observation) -> Float[Array, "N H"]:
        return self.layers(observation.features)


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
        own = env.own_size if isinstance(env, SpatialEnvironment) else env.observation_size
        self.rival = Mlp(2 * SCALES, (narrow,), rival_key, gain)
        self.landmark = Mlp(own + SCALES + narrow, (width, width), landmark_key, gain)
        self.agent = Mlp(own + SCALES, (narrow,), agent_key, gain)
        self.attention = Score(width, attention_key, gain)
        self.out = Mlp(own + 2 * width + narrow, (width,), out_key, gain)
        self.view = env.entities if isinstance(env, SpatialEnvironment) else _nothing_in_sight
        self.nearest_landmarks, self.nearest_agents = config.nearest_landmarks, config.nearest_agents

    def __call__(self, observation: Observation) -> Float[Array, "N H"]:
        seen = self.view(observation)
        own = seen.own
        landmarks, landmark_there = _nearest(seen.landmarks, self.nearest_landmarks)  # [N L 2]
        agents, agent_there = _nearest(seen.agents, self.nearest_agents)  # [N M 2]

        # Agent → landmark, in the agent's own frame: where each rival stands from each landmark, and where I do.
        between = _scales(agents[:, None, :, :] - landmarks[:, :, None, :])  # [N L M 5]
        mine = jnp.broadcast_to(_scales(-landmarks)[:, :, None, :], between.shape)
        rivals = self.rival(jnp.concatenate([between, mine], axis=-1))  # [N L M H/2]
        contest = _pool_max(rivals, agent_there[:, None, :], axis=2)

        # Landmark → agent, and agent → agent.
        places = self.landmark(jnp.concatenate([_repeat(own, landmarks), _scales(landmarks), contest], axis=-1))
        score = jnp.where(landmark_there, self.attention(places), -jnp.inf)
        chosen = attend(places, score)
        best = _pool_max(places, landmark_there, axis=1)
        others = self.agent(jnp.concatenate([_repeat(own, agents), _scales(agents)], axis=-1))
        crowd = _pool_max(others, agent_there, axis=1)
        return self.out(jnp.concatenate([own, chosen, best, crowd], axis=-1))


Torso: TypeAlias = MlpTorso | GraphTorso


def make(env: Environment, config: NetworkConfig, key: PRNGKey, gain: float | None = None) -> Torso:
    """The torso that the configuration names."""
    return (GraphTorso if config.torso == "graph" else MlpTorso)(env, config, key, gain)


def _nothing_in_sight(observation: Observation) -> Entities:
    """For tasks without space: an agent, alone with its features."""
    nothing = jnp.zeros((observation.features.shape[0], 0, 2))
    return Entities(own=observation.features, landmarks=nothing, agents=nothing)


def _nearest(
    offsets: Float[Array, "N M 2"], count: int | None
) -> tuple[Float[Array, "N K 2"], Bool[Array, "N K"]]:
    """The nearest entities (all of them for None), and which are there: one at distance 0 is padding."""
    squared = jnp.square(offsets).sum(-1)
    if count is not None and count < offsets.shape[1]:
        near = jax.lax.top_k(-jnp.where(squared > 0, squared, jnp.inf), count)[1]
        offsets = jnp.take_along_axis(offsets, near[..., None], axis=1)
        squared = jnp.take_along_axis(squared, near, axis=1)
    return offsets, squared > 0


def _scales(offsets: Float[Array, "*b 2"]) -> Float[Array, "*b 5"]:
    """The offset, its length, and the offset near by magnified; finite gradients at 0."""
    return jnp.concatenate([with_length(offsets), jnp.tanh(offsets / NEAR)], axis=-1)


def _repeat(own: Float[Array, "N K"], entities: Float[Array, "N M 2"]) -> Float[Array, "N M K"]:
    return jnp.broadcast_to(own[:, None, :], (*entities.shape[:2], own.shape[-1]))


def _pool_max(values: Float[Array, "..."], there: Bool[Array, "..."], axis: int) -> Float[Array, "..."]:
    """The largest over an axis, of those that are there; they are ReLU outputs, so that nobody there is 0."""
    return jnp.max(jnp.where(there[..., None], values, 0.0), axis=axis, initial=0.0)
