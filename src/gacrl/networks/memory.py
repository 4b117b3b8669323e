"""Where a memory begins anew: with an episode, or with a life inside one."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from gacrl.types import Memory


def restarted(fresh: Memory, memory: Memory, begins: Bool[Array, "#N"] | Bool[Array, ""]) -> Memory:
    """Return the memory of one environment, fresh where something begins: for all of it, or for some agents [N].

    What belongs to the whole team (scalars) outlives an agent.
    """

    def choose(new: Array, old: Array) -> Array:
        if begins.ndim == 0:
            return jnp.where(begins, new, old)
        return old if old.ndim == 0 else jnp.where(begins.reshape(-1, *[1] * (old.ndim - 1)), new, old)

    return jax.tree.map(choose, fresh, memory)


def beginnings(
    first: Bool[Array, " T"], left: Bool[Array, "T N"] | None
) -> Bool[Array, " T"] | Bool[Array, "T N"]:
    """Return before which of an environment's T steps memories begin anew: [T]; where lives end inside episodes [T, N].

    left: whose life ended with each step. What was remembered before the first of the steps is as it should be.
    """
    if left is None:
        return first
    return first[:, None] | jnp.concatenate([jnp.zeros_like(left[:1]), left[:-1]])
