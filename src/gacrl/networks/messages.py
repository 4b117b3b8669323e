"""Discrete messages: Gumbel-Softmax, and the noise it takes."""

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
    """Equation (9): softmax((logits + Gumbel noise) / τ) over the axis of symbols (Jang et al. 2017).

    With `straight_through` the value is the one-hot of the largest entry and the gradient that of the soft
    sample.
    """
    soft = jax.nn.softmax((logits + noise) / temperature, axis=axis)
    if not straight_through:
        return soft
    return soft + jax.lax.stop_gradient(most_likely_symbol(soft, axis) - soft)


def most_likely_symbol(logits: Float[Array, "*b V"], axis: int = -1) -> Float[Array, "*b V"]:
    """The one-hot of the largest entry: the message when nothing is explored."""
    return jax.nn.one_hot(logits.argmax(axis), logits.shape[axis], dtype=logits.dtype, axis=axis)


def normal_and_gumbel(
    key: PRNGKey, num_normal: int, num_gumbel: int
) -> tuple[Float[Array, " num_normal"], Float[Array, " num_gumbel"]]:
    """Standard normal and Gumbel numbers out of one draw, by their inverse distribution functions."""
    uniform = jax.random.uniform(key, (num_normal + num_gumbel,), minval=jnp.finfo(jnp.float32).tiny)
    centred = jnp.maximum(2 * uniform[:num_normal] - 1, jnp.nextafter(-1.0, 0.0))
    return jnp.sqrt(2.0) * jax.lax.erf_inv(centred), -jnp.log(-jnp.log(uniform[num_normal:]))
