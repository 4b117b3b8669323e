"""The latent encoder: a Gaussian over z for each agent's observation (a VAE without its decoder)."""

from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from gacrl.networks.layers import Linear
from gacrl.types import PRNGKey


class Encoder(eqx.Module):
    """Equation (2): observation → mean and log variance of the latent; ReLU between the layers."""

    hidden: tuple[Linear, ...]
    heads: Linear
    """Mean and log variance in one layer: its first Z outputs are the mean."""

    def __init__(self, in_size: int, hidden_sizes: tuple[int, ...], latent_size: int, key: PRNGKey):
        *hidden_keys, heads_key = jax.random.split(key, len(hidden_sizes) + 1)
        sizes = (in_size, *hidden_sizes)
        self.hidden = tuple(Linear(i, o, k) for i, o, k in zip(sizes, sizes[1:], hidden_keys, strict=False))
        self.heads = Linear(sizes[-1], 2 * latent_size, heads_key)

    def __call__(
        self, features: Float[Array, "..."], axis: Literal[0, -1] = -1
    ) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
        """Returns μ and log σ²: [*b O] -> [*b Z]; with `axis=0`, [O *b] -> [Z *b]."""
        x = features
        for layer in self.hidden:
            x = jax.nn.relu(layer(x, axis))
        mean, log_variance = jnp.split(self.heads(x, axis), 2, axis=axis)
        return mean, log_variance


def sample_latent(
    mean: Float[Array, "*b"], log_variance: Float[Array, "*b"], noise: Float[Array, "*b"]
) -> Float[Array, "*b"]:
    """Equation (3): z = μ + ε exp(½ log σ²), with ε the given standard normal noise."""
    return mean + noise * jnp.exp(0.5 * log_variance)


def kl_divergence(
    mean: Float[Array, "..."], log_variance: Float[Array, "..."], axis: int = -1
) -> Float[Array, "..."]:
    """KL(N(μ, σ²) ‖ N(0, I)), summed over the axis of the latent dimensions."""
    return -0.5 * (1 + log_variance - jnp.square(mean) - jnp.exp(log_variance)).sum(axis)
