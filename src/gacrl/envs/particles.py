"""The particle world of MPE: damped point masses that push each other apart on contact.

Written for one world. Where arrays have further axes at their end (`*e`) they are as many worlds at once: a
processor's vector units then run over worlds, where a single one has only pairs of coordinates to offer them.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from gacrl.scene import Edit, Placed

NO_ACTION, LEFT, RIGHT, DOWN, UP = range(5)
DIRECTIONS = ((0.0, 0.0), (-1.0, 0.0), (1.0, 0.0), (0.0, -1.0), (0.0, 1.0))
"""The unit force of each discrete action, in MPE2's order."""
PUSHES = ("no push", "push left", "push right", "push down", "push up")
"""What they are called."""


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


def along(values: Array, like: Array) -> Array:
    """Return the numbers that all worlds share, with an axis of one for each axis that an array of worlds has at its
    end.
    """
    return values.reshape(values.shape + (1,) * (like.ndim - values.ndim))


def pairwise_offsets(
    positions: Float[Array, "N 2 *e"], others: Float[Array, "M 2 *e"]
) -> tuple[Float[Array, "N M 2 *e"], Float[Array, "N M *e"]]:
    """Return, from each position to each of the others, the offset `others - position`, and its length."""
    offsets = others[None] - positions[:, None]
    return offsets, jnp.sqrt(jnp.square(offsets).sum(2))


def between_agents(
    positions: Float[Array, "N 2 *e"], agent_mask: Bool[Array, " N"] | None
) -> tuple[Float[Array, "N N 2 *e"], Float[Array, "N N *e"], Bool[Array, "N N *#e"]]:
    """Return, from each agent to each agent, offset, distance, and whether the two are real and not one."""
    offsets, distance = pairwise_offsets(positions, positions)
    pairs = ~jnp.eye(positions.shape[0], dtype=bool)
    if agent_mask is not None:
        pairs &= agent_mask[:, None] & agent_mask[None, :]
    return offsets, distance, along(pairs, distance)


def contact_forces(
    positions: Float[Array, "N 2 *e"], agent_mask: Bool[Array, " N"] | None, physics: Physics
) -> Float[Array, "N 2 *e"]:
    """Return the force on each agent from its contacts with the others (a softplus of the penetration).

    Two agents at the very same point have no direction to be pushed in: the force there is 0, where MPE2
    divides by zero and gives NaN.
    """
    offsets, distance, pairs = between_agents(positions, agent_mask)
    margin = physics.contact_margin
    penetration = margin * jnp.logaddexp(0.0, (2 * physics.agent_radius - distance) / margin)
    apart = distance > 0
    strength = physics.contact_force * penetration / jnp.where(apart, distance, 1.0)
    return -(jnp.where(pairs & apart, strength, 0.0)[:, :, None] * offsets).sum(1)


def action_forces(action: Array, physics: Physics, continuous: bool) -> Float[Array, "N 2 *e"]:
    """Return the force of each agent's own action.

    Discrete: indices [N, *e] into `DIRECTIONS`. Continuous: [N, 5, *e] in [0, 1], clipped there as MPE2's wrapper
    does; the force is right minus left, up minus down.
    """
    # The one-hot, by comparisons, because a look-up is not vectorised.
    one_hot = partial(jax.nn.one_hot, num_classes=len(DIRECTIONS), dtype=float, axis=1)
    pushes = jnp.clip(action, 0.0, 1.0) if continuous else one_hot(action)
    unit = jnp.stack([pushes[:, RIGHT] - pushes[:, LEFT], pushes[:, UP] - pushes[:, DOWN]], axis=1)
    return physics.action_force * unit


def integrate(
    positions: Float[Array, "N 2 *e"],
    velocities: Float[Array, "N 2 *e"],
    forces: Float[Array, "N 2 *e"],
    physics: Physics,
) -> tuple[Float[Array, "N 2 *e"], Float[Array, "N 2 *e"]]:
    """Take one step: positions move with the old velocity, then velocities are damped and pushed (mass 1)."""
    moved = positions + velocities * physics.time_step
    return moved, velocities * (1 - physics.damping) + forces * physics.time_step


def coast(
    positions: Float[Array, "N 2"], velocities: Float[Array, "N 2"], physics: Physics
) -> tuple[Float[Array, "N 2"], Float[Array, ""] | float]:
    """Return positions three steps ahead without any push, and how far one of full force, now, moves them.

    A push changes the velocity after the first step; in the third, damping has taken its share.
    """
    kept, dt = 1 - physics.damping, physics.time_step
    effect = dt * (1 + kept)
    return positions + (dt + effect * kept) * velocities, effect * dt * physics.action_force


def edited(state: Any, hand: Edit) -> Any:
    """Return the state of a particle world after a hand has put agents, at rest, and landmarks somewhere else.

    state: a named tuple with positions [N, 2], velocities [N, 2] and landmarks [L, 2].
    """
    return state._replace(
        positions=_put(hand.agents, state.positions),
        velocities=jnp.where(hand.agents.moved[:, None], 0.0, state.velocities),
        landmarks=_put(hand.marks, state.landmarks),
    )


def _put(placed: Placed, positions: Float[Array, "K 2"]) -> Float[Array, "K 2"]:
    return jnp.where(placed.moved[:, None], jnp.asarray(placed.positions, positions.dtype), positions)
