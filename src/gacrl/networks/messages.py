"""Discrete messages: Gumbel-Softmax, a gate of two values, and the noise they take."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from gacrl.types import PRNGKey


def gumbel_softmax(
    logits: Float[Array, "*b V"],
    noise: Float[Array, "*b V"],
    temperature: Float[Array, ""] | float,
    straight_through: bool = False,
    axis: int = -1,
) -> Float[Array, "*b V"]:
    """Compute equation (9): softmax((logits + Gumbel noise) / τ) over the axis of symbols (Jang et al. 2017).

    With `straight_through` the value is the one-hot of the largest entry and the gradient that of the soft
    sample.
    """
    soft = jax.nn.softmax((logits + noise) / temperature, axis=axis)
    if not straight_through:
        return soft
    return soft + jax.lax.stop_gradient(most_likely_symbol(soft, axis) - soft)


def most_likely_symbol(logits: Float[Array, "*b V"], axis: int = -1) -> Float[Array, "*b V"]:
    """Return the one-hot of the largest entry: the message when nothing is explored."""
    return jax.nn.one_hot(logits.argmax(axis), logits.shape[axis], dtype=logits.dtype, axis=axis)


def gumbel_sigmoid(
    logits: Float[Array, "*b"], noise: Float[Array, "*b"] | None, temperature: Float[Array, ""] | float
) -> Float[Array, "*b"]:
    """Decide between 0 and 1: 1 where logits + logistic noise > 0, with the gradient of sigmoid((logits + noise) / τ).

    It is the straight-through Gumbel-Softmax of two symbols, as the difference of two Gumbel numbers is logistic.
    Without noise it is the likelier of the two.
    """
    if noise is not None:
        logits = logits + noise
    soft = jax.nn.sigmoid(logits / temperature)
    return soft + jax.lax.stop_gradient((logits > 0).astype(soft.dtype) - soft)


def normal_and_gumbel(
    key: PRNGKey, num_normal: int, num_gumbel: int
) -> tuple[Float[Array, " num_normal"], Float[Array, " num_gumbel"]]:
    """Draw standard normal and Gumbel numbers out of one draw, by their inverse distribution functions."""
    uniform = jax.random.uniform(key, (num_normal + num_gumbel,), minval=jnp.finfo(jnp.float32).tiny)
    centred = jnp.maximum(2 * uniform[:num_normal] - 1, jnp.nextafter(-1.0, 0.0))
    return jnp.sqrt(2.0) * jax.lax.erf_inv(centred), -jnp.log(-jnp.log(uniform[num_normal:]))
