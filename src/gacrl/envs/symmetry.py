"""The eight symmetries of the square: exact for the dynamics, the rewards and the five actions."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from gacrl.envs.particles import DIRECTIONS

NUM_SYMMETRIES = 8
"""Four quarter turns, and the same after a reflection in the x axis; 0 is the identity."""


def _matrices() -> np.ndarray:
    quarter, mirror = np.array([[0.0, -1.0], [1.0, 0.0]]), np.diag([1.0, -1.0])
    turns = [np.linalg.matrix_power(quarter, k) for k in range(4)]
    return np.stack([*turns, *[turn @ mirror for turn in turns]])


def _action_maps(matrices: np.ndarray) -> np.ndarray:
    """Row g: the action that each action becomes."""
    directions = np.array(DIRECTIONS)
    turned = np.einsum("gxy,ay->gax", matrices, directions)
    return np.abs(turned[:, :, None] - directions).sum(-1).argmin(-1)


_MATRICES = _matrices()
_ACTION_MAPS = _action_maps(_MATRICES)


def turn_vectors(values: Float[Array, "..."], symmetry: Int[Array, ""]) -> Float[Array, "..."]:
    """Turn numbers that are vectors in the plane side by side, [*b 2K]."""
    matrix = jnp.asarray(_MATRICES, values.dtype)[symmetry]
    return (values.reshape(*values.shape[:-1], -1, 2) @ matrix.T).reshape(values.shape)


def turn_action(action: Array, symmetry: Int[Array, ""], continuous: bool) -> Array:
    """Turn actions: indices [*b], or with `continuous` five pushes each [*b 5]."""
    becomes = jnp.asarray(_ACTION_MAPS)[symmetry]
    if continuous:
        return jnp.zeros_like(action).at[..., becomes].set(action)
    return becomes[action]
