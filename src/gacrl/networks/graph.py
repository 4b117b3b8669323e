"""Who can hear whom, where they stand, and sums over the neighbourhood."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from gacrl.envs.environment import Environment
from gacrl.types import Observation


def proximity_adjacency(
    positions: Float[Array, "N 2"], agent_mask: Bool[Array, " N"], radius: Float[Array, ""] | float
) -> Bool[Array, "N N"]:
    """Compute equation (4): A_ij = 1 if i ≠ j and d_ij < radius. Padded agents have no edges."""
    distance_squared = jnp.square(positions[:, None, :] - positions[None, :, :]).sum(-1)
    near = (distance_squared < radius * radius) & ~jnp.eye(positions.shape[0], dtype=bool)
    return near & agent_mask[:, None] & agent_mask[None, :]


def observed_adjacency(observation: Observation, radius: Float[Array, ""] | float) -> Bool[Array, "N N"]:
    """Return the task's own graph where it prescribes one, else proximity, else everyone hears everyone."""
    if observation.adjacency is not None:
        return observation.adjacency
    if observation.positions is not None:
        return proximity_adjacency(observation.positions, observation.agent_mask, radius)
    mask = observation.agent_mask
    return mask[:, None] & mask[None, :] & ~jnp.eye(mask.shape[0], dtype=bool)


def heard_adjacency(observation: Observation, radius: Float[Array, ""] | float) -> Bool[Array, "N N"]:
    """Return the edges along which something arrives: those of the graph that nobody has cut."""
    adjacency, kept = observed_adjacency(observation, radius), observation.arrives.kept
    return adjacency if kept is None else adjacency & kept


def nearest_speakers(
    positions: Float[Array, "N 2"] | None, adjacency: Bool[Array, "N N"], count: int
) -> Int[Array, "N K"]:
    """Return each agent's `count` nearest neighbours, nearest first; without positions its first ones."""
    if positions is None:
        squared = jnp.zeros(adjacency.shape)
    else:
        squared = jnp.square(positions[None, :, :] - positions[:, None, :]).sum(-1)
    return jax.lax.top_k(-jnp.where(adjacency, squared, jnp.inf), count)[1]


def neighbour_sum(messages: Float[Array, "V N"], adjacency: Bool[Array, "N N"]) -> Float[Array, "V N"]:
    """Compute equation (7): column i is the sum of the columns of i's neighbours; no normalisation, no self edge."""
    return messages @ adjacency.astype(messages.dtype).T


def with_length(offsets: Float[Array, "*b 2"]) -> Float[Array, "*b 3"]:
    """Return the offset and its length; finite gradients at 0."""
    length = jnp.sqrt(jnp.square(offsets).sum(-1, keepdims=True) + 1e-8)
    return jnp.concatenate([offsets, length], axis=-1)


def sighted(sight: Float[Array, "N K S"]) -> Float[Array, "N K F"]:
    """Return what one sees of others as numbers for a network: offset, its length, features; F = 0 for S = 0."""
    if not sight.shape[-1]:
        return sight
    return jnp.concatenate([with_length(sight[..., :2]), sight[..., 2:]], axis=-1)


def sighted_size(env: Environment) -> int:
    """Return F of `sighted` in this task."""
    seen = jax.eval_shape(lambda: env.sight(env.reset(jax.random.key(0), env.default_params())[1]))
    return jax.eval_shape(sighted, seen).shape[-1]


def attend(values: Float[Array, "N M H"], score: Float[Array, "N M"]) -> Float[Array, "N H"]:
    """Return the mean over M, weighted by the softmax of the score; 0 where every score is −∞ (nobody is there)."""
    largest = jax.lax.stop_gradient(jnp.max(score, axis=1, keepdims=True, initial=-1e9))
    weight = jnp.exp(score - largest)
    return jnp.einsum("nm,nmh->nh", weight, values) / jnp.maximum(weight.sum(1, keepdims=True), 1e-9)


def shares_of(score: Float[Array, "N M"]) -> Float[Array, "N M"]:
    """Return the weights of that mean; 0 where every score is −∞."""
    weight = jnp.exp(score - jnp.max(score, axis=1, keepdims=True, initial=-1e9))
    return weight / jnp.maximum(weight.sum(1, keepdims=True), 1e-9)


def attend_to_speakers(
    values: Float[Array, "N M H"], score: Float[Array, "N M"], spoke: Float[Array, "N M"]
) -> Float[Array, "N H"]:
    """Return the same mean over those alone who spoke (1, else 0); 0 where nobody did.

    The gradient of `spoke` is the value times the share that this speaker has, or would have. That of a softmax over
    those who spoke would be 0 for a lone speaker, whose share is 1 in any case.
    """
    loud = jax.lax.stop_gradient(spoke)
    largest = jnp.max(jnp.where(loud > 0, score, -jnp.inf), axis=1, keepdims=True, initial=-1e9)
    # Of silent ones the score may be any number above the largest of those who spoke.
    weight = jnp.exp(jnp.minimum(score - jax.lax.stop_gradient(largest), 20.0))
    spoken = weight * loud
    share = weight / jnp.maximum(spoken.sum(1, keepdims=True) - spoken + weight, 1e-9)
    return jnp.einsum("nm,nmh->nh", share * spoke, values)
