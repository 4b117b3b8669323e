"""What arrives of what was said: the one place that every message passes."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from gacrl.config.checks import require
from gacrl.types import Arrives


def arriving(said: Float[Array, "N V"], arrives: Arrives, number: int = 0, rounds: int = 1) -> Float[Array, "N V"]:
    """Return the words of round `number` (from 0) of so many as they reach everyone who hears their speaker.

    Raises ConfigError where somebody lets words arrive that have another shape.
    """
    if arrives.values is None:
        return said
    fitting, found = [rounds, *said.shape], list(arrives.values.shape)
    require(found == fitting, f"what arrives must be [rounds, agents, symbols] = {fitting}, not {found}")
    if arrives.replaced is None:
        return arrives.values[number]
    return jnp.where(arrives.replaced[number][:, None], arrives.values[number], said)
