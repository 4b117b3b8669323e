"""Latent codes: the paper's encoder (a VAE without its decoder), and a code of any torso's vector, with one."""

from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from gacrl.config.algorithms import NetworkConfig
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
    """Compute equation (3): z = μ + ε exp(½ log σ²), with ε the given standard normal noise."""
    return mean + noise * jnp.exp(0.5 * log_variance)


def kl_divergence(
    mean: Float[Array, "..."], log_variance: Float[Array, "..."], axis: int = -1
) -> Float[Array, "..."]:
    """Return KL(N(μ, σ²) ‖ N(0, I)), summed over the axis of the latent dimensions."""
    return -0.5 * (1 + log_variance - jnp.square(mean) - jnp.exp(log_variance)).sum(axis)


class Code(eqx.Module):
    """A code z of each agent's vector h: Gaussian, learned with its evidence lower bound, or deterministic.

    Reconstructed is h itself, which holds for any number of entities; h takes no gradient from that.
    """

    encode: Linear
    decode: Linear
    merge: Linear
    gaussian: bool = eqx.field(static=True)
    hears_mean: bool = eqx.field(static=True)

    def __init__(self, config: NetworkConfig, key: PRNGKey):
        encode_key, decode_key, merge_key = jax.random.split(key, 3)
        self.gaussian, self.hears_mean = config.latent == "vae", config.latent_use == "mean"
        size = config.latent_size
        self.encode = Linear(config.width, 2 * size if self.gaussian else size, encode_key)
        self.decode = Linear(size, config.width, decode_key)
        self.merge = Linear(size, config.width, merge_key)

    def __call__(
        self, hidden: Float[Array, "N H"], key: PRNGKey | None
    ) -> tuple[Float[Array, "N Z"], Float[Array, "N H"], Float[Array, " N"]]:
        """Return the code that agents act and speak on, the vector that knows of it, and the code's loss.

        Without a key the code is the mean. With one it is a sample, or the mean again where `latent_use` says so: the
        sample then serves the reconstruction alone.
        """
        divergence = 0.0
        if self.gaussian:
            mean, log_variance = jnp.split(self.encode(hidden), 2, axis=-1)
            noise = 0.0 if key is None else jax.random.normal(key, mean.shape)
            sample = sample_latent(mean, log_variance, noise * jnp.ones_like(mean))
            code = mean if self.hears_mean else sample
            divergence = kl_divergence(mean, log_variance)
        else:
            sample = code = self.encode(hidden)
        error = jnp.square(self.decode(sample) - jax.lax.stop_gradient(hidden)).sum(-1)
        return code, hidden + jax.nn.relu(self.merge(code)), 0.5 * error + divergence
