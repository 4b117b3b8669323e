"""The paper's shaped reward."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from gacrl.envs.particles import along
from gacrl.tasks.spread.settings import CollisionTerm


def paper_shaped_reward(
    raw: Float[Array, "*e"],
    landmark_distance: Float[Array, "N *e"],
    agent_distance: Float[Array, "N *e"],
    threshold: Float[Array, ""] | float,
    collision_distance: Float[Array, ""] | float = 0.2,
    collision_term: CollisionTerm = "per_agent",
    agent_mask: Bool[Array, " N"] | None = None,
) -> Float[Array, "*e"]:
    """Compute equation (1): the team's reward of one step.

    raw: r_raw, the mean over agents of MPE2's reward. landmark_distance: d_min,i, from each agent to its
    nearest landmark. agent_distance: d_agent,i, to its nearest agent (infinity where there is none).
    threshold: θ. The printed collision term stands outside the sum although its index i is bound there:
    `per_agent` takes it inside, `once` counts it a single time when any agent is that close.

    As printed, the proximity term 10(1 − d/2)² grows again beyond d = 2: running away is paid.
    """
    proximity = 10.0 * jnp.square(1.0 - landmark_distance / 2.0)
    coverage = jnp.where(landmark_distance < threshold, 3.0 * (1.0 - landmark_distance / threshold), 0.0)
    colliding = agent_distance < collision_distance
    bonus = proximity + coverage
    if agent_mask is not None:
        real = along(agent_mask, bonus)
        bonus = jnp.where(real, bonus, 0.0)
        colliding &= real
    penalty = colliding.sum(0) if collision_term == "per_agent" else colliding.any(0)
    return raw + bonus.sum(0) - penalty
