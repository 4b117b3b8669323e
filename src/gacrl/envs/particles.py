"""The particle world of MPE: damped point masses that push each other apart on contact."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

NO_ACTION, LEFT, RIGHT, DOWN, UP = range(5)
DIRECTIONS = ((0.0, 0.0), (-1.0, 0.0), (1.0, 0.0), (0.0, -1.0), (0.0, 1.0))
"""The unit force of each discrete action, in MPE2's order."""


class Physics(NamedTuple):
    """MPE2's constants. Lengths in arena units, masses 1, times in units of ten steps."""

    time_step: Float[Array, ""] | float = 0.1
    damping: Float[Array, ""] | float = 0.25
    """Share of the velocity that is lost in a step."""
    contact_force: Float[Array, ""] | float = 100.0
    contact_margin: Float[Array, ""] | float = 1e-3
    action_force: Float[Array, ""] | float = 5.0
    agent_radius: Float[Array, ""] | float = 0.15

    @property
    def top_speed(self) -> Float[Array, ""] | float:
        """Where damping eats up what a constant action adds: 2.0 with MPE2's constants."""
        return self.action_force * self.time_step / self.damping


def pairwise_offsets(
    positions: Float[Array, "N 2"], others: Float[Array, "M 2"]
) -> tuple[Float[Array, "N M 2"], Float[Array, "N M"]]:
    """From each position to each of the others: offset `others - position`, and its length."""
    offsets = others[None, :, :] - positions[:, None, :]
    return offsets, jnp.sqrt(jnp.square(offsets).sum(-1))


def contact_forces(
    positions: Float[Array, "N 2"], agent_mask: Bool[Array, " N"] | None, physics: Physics
) -> Float[Array, "N 2"]:
    """The force on each agent from its contacts with the others (a softplus of the penetration).

    Two agents at the very same point have no direction to be pushed in: the force there is 0, where MPE2
    divides by zero and gives NaN.
    """
    num_agents = positions.shape[0]
    offsets, distance = pairwise_offsets(positions, positions)
    margin = physics.contact_margin
    penetration = margin * jnp.logaddexp(0.0, (2 * physics.agent_radius - distance) / margin)
    touching = distance > 0
    strength = physics.contact_force * penetration / jnp.where(touching, distance, 1.0)
    between = ~jnp.eye(num_agents, dtype=bool) & touching
    if agent_mask is not None:
        between &= agent_mask[:, None] & agent_mask[None, :]
    return -(jnp.where(between, strength, 0.0)[..., None] * offsets).sum(1)


def action_forces(action: Array, physics: Physics, continuous: bool) -> Float[Array, "N 2"]:
    """The force of each agent's own action.

    Discrete: indices [N] into `DIRECTIONS`. Continuous: [N, 5] in [0, 1], clipped there as MPE2's wrapper
    does; the force is right minus left, up minus down.
    """
    if continuous:
        pushes = jnp.clip(action, 0.0, 1.0)
        unit = jnp.stack([pushes[:, RIGHT] - pushes[:, LEFT], pushes[:, UP] - pushes[:, DOWN]], axis=-1)
    else:
        unit = jnp.asarray(DIRECTIONS)[action]
    return physics.action_force * unit


def integrate(
    positions: Float[Array, "N 2"],
    velocities: Float[Array, "N 2"],
    forces: Float[Array, "N 2"],
    physics: Physics,
) -> tuple[Float[Array, "N 2"], Float[Array, "N 2"]]:
    """One step: positions move with the old velocity, then velocities are damped and pushed (mass 1)."""
    moved = positions + velocities * physics.time_step
    return moved, velocities * (1 - physics.damping) + forces * physics.time_step
