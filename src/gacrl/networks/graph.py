"""Who can hear whom, and sums over the neighbourhood."""

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
