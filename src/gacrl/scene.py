"""What a picture of a state is made of: discs for agents, rings for places, lines for roads, all of fixed shape.

A task says with `Task.scene` what there is to see; `render` draws it. Edges and speech are not the task's: they come
from what a policy decides.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

PLAIN = -1
"""The colour of what has none of its own."""


class Discs(NamedTuple):
    """K things that lie in the plane. Lengths in the task's own units."""

    positions: Float[Array | np.ndarray, "*b K 2"]
    radius: Float[Array | np.ndarray, "*b K"]
    there: Bool[Array | np.ndarray, "*b K"]
    """False for what is not to be seen now."""
    lit: Bool[Array | np.ndarray, "*b K"]
    """What deserves attention: a place that is covered, an agent that has crashed."""
    colour: Int[Array | np.ndarray, "*b K"]
    """An index into the palette of symbols, or `PLAIN`."""


class Placed(NamedTuple):
    """Where a hand puts K things."""

    positions: Float[Array | np.ndarray, "*b K 2"]
    moved: Bool[Array | np.ndarray, "*b K"]
    """False for what it leaves alone."""


class Edit(NamedTuple):
    """What a hand does to a moment: agents and marks in the order of the scene. Lengths in the task's own units."""

    agents: Placed
    marks: Placed


class Scene(NamedTuple):
    """One moment of one environment."""

    agents: Discs
    """One for each agent, in their order."""
    marks: Discs
    """Places and things, drawn as rings."""
    lines: Float[Array | np.ndarray, "*b M 2 2"]
    """From where to where: roads and walls."""
    ground: Float[Array | np.ndarray, "*b 2 2"]
    """Lower left and upper right corner of where everything starts."""


def discs(
    positions: Float[Array, "K 2"],
    radius: Float[Array, ""] | float,
    there: Bool[Array, " K"] | None = None,
    lit: Bool[Array, " K"] | None = None,
    colour: Int[Array, " K"] | int = PLAIN,
) -> Discs:
    """Make K things of one radius; all are there, and none is lit, unless it is said."""
    count = positions.shape[0]
    return Discs(
        positions=positions,
        radius=jnp.broadcast_to(jnp.asarray(radius, float), (count,)),
        there=jnp.ones(count, bool) if there is None else there,
        lit=jnp.zeros(count, bool) if lit is None else lit,
        colour=jnp.broadcast_to(jnp.asarray(colour, jnp.int32), (count,)),
    )


def compose(
    agents: Discs,
    marks: Discs | None = None,
    lines: Float[Array, "M 2 2"] | None = None,
    ground: Float[Array, "2 2"] | None = None,
) -> Scene:
    """Make a scene of these parts; without a ground everything may start anywhere."""
    return Scene(
        agents=agents,
        marks=discs(jnp.zeros((0, 2)), 0.0) if marks is None else marks,
        lines=jnp.zeros((0, 2, 2)) if lines is None else lines,
        ground=jnp.zeros((2, 2)) if ground is None else ground,
    )
