"""Who can hear whom, where they stand, and sums over the neighbourhood."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from gacrl.types import Channel, Observation


def proximity_adjacency(
    positions: Float[Array, "N 2"], agent_mask: Bool[Array, " N"], radius: Float[Array, ""] | float
) -> Bool[Array, "N N"]:
    """Equation (4): A_ij = 1 if i ≠ j and d_ij < radius. Padded agents have no edges."""
    distance_squared = jnp.square(positions[:, None, :] - positions[None, :, :]).sum(-1)
    near = (distance_squared < radius * radius) & ~jnp.eye(positions.shape[0], dtype=bool)
    return near & agent_mask[:, None] & agent_mask[None, :]


def observed_adjacency(observation: Observation, radius: Float[Array, ""] | float) -> Bool[Array, "N N"]:
    """The task's own graph where it prescribes one, else proximity, else everyone hears everyone."""
    if observation.adjacency is not None:
        return observation.adjacency
    if observation.positions is not None:
        return proximity_adjacency(observation.positions, observation.agent_mask, radius)
    mask = observation.agent_mask
    return mask[:, None] & mask[None, :] & ~jnp.eye(mask.shape[0], dtype=bool)


def audible(adjacency: Bool[Array, "N N"], channel: Channel) -> Bool[Array, "N N"]:
    """The edges that the channel does not cut: to be silenced is not to be heard, also by attention and in means."""
    return adjacency if channel.edge_keep is None else adjacency & (channel.edge_keep > 0)


def neighbour_sum(
    messages: Float[Array, "V N"], adjacency: Bool[Array, "N N"], channel: Channel
) -> Float[Array, "V N"]:
    """Equation (7): column i is the sum of the columns of i's neighbours; no normalisation, no self edge."""
    weights = adjacency.astype(messages.dtype)
    if channel.edge_keep is not None:
        weights *= channel.edge_keep
    return messages @ weights.T


def with_length(offsets: Float[Array, "*b 2"]) -> Float[Array, "*b 3"]:
    """The offset and its length; finite gradients at 0."""
    length = jnp.sqrt(jnp.square(offsets).sum(-1, keepdims=True) + 1e-8)
    return jnp.concatenate([offsets, length], axis=-1)


def attend(values: Float[Array, "N M H"], score: Float[Array, "N M"]) -> Float[Array, "N H"]:
    """The mean over M, weighted by the softmax of the score; 0 where every score is −∞ (nobody is there)."""
    largest = jax.lax.stop_gradient(jnp.max(score, axis=1, keepdims=True, initial=-1e9))
    weight = jnp.exp(score - largest)
    return jnp.einsum("nm,nmh->nh", weight, values) / jnp.maximum(weight.sum(1, keepdims=True), 1e-9)
