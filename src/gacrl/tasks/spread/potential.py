"""Shaping that leaves the optimal policy as it is: differences of a potential (Ng, Harada and Russell 1999)."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from gacrl.envs.particles import pairwise_offsets
from gacrl.tasks.spread.assignment import assign


def assignment_potential(
    positions: Float[Array, "N 2"],
    landmarks: Float[Array, "L 2"],
    agent_mask: Bool[Array, " N"] | None = None,
    landmark_mask: Bool[Array, " L"] | None = None,
) -> Float[Array, ""]:
    """Return Φ(s), in arena units: minus the summed distance when agents go to the landmarks that suit the team best.

    It says who should go where, as the scripted oracle knows it.
    """
    _, distance = pairwise_offsets(positions, landmarks)
    there = jnp.ones(distance.shape, bool)
    if agent_mask is not None:
        there &= agent_mask[:, None]
    if landmark_mask is not None:
        there &= landmark_mask[None, :]
    goal = assign(jnp.where(there, distance, jnp.inf))
    rows = jnp.arange(goal.size)
    walked = (goal >= 0) & there[rows, goal]
    return -jnp.where(walked, distance[rows, goal], 0.0).sum()


def potential_difference(
    before: Float[Array, "*e"],
    after: Float[Array, "*e"],
    discount: Float[Array, ""] | float,
    terminated: Bool[Array, "*e"],
) -> Float[Array, "*e"]:
    """Return F(s, s′) = γ Φ(s′) − Φ(s), with Φ = 0 where nothing follows.

    Discounted and summed over an episode it is γᵀ Φ(s_T) − Φ(s_0), whatever was done in between; at a time limit the
    learner's bootstrapped value stands for what Φ(s_T) has lent.
    """
    return discount * jnp.where(terminated, 0.0, after) - before
