"""The affine layer, laid out as papers write it: W x + b; and small stacks of it."""

from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from gacrl.types import PRNGKey


class Linear(eqx.Module):
    """x ↦ W x + b over the last axis of x, or with `axis=0` over the first.

    Features first suits small networks on a CPU: softmax and concatenation over a handful of features then
    run along the batch, which is the contiguous axis when a caller vmaps over the last one.
    """

    weight: Float[Array, "out in"]
    bias: Float[Array, " out"]

    def __init__(self, in_size: int, out_size: int, key: PRNGKey, gain: float | None = None):
        """With a gain: orthogonal weights times it, no bias (Saxe et al. 2014; what PPO is usually given).

        Without: weights and biases uniform in ±1/√in_size (the default of torch.nn.Linear).
        """
        weight_key, bias_key = jax.random.split(key)
        if gain is not None:
            self.weight = jax.nn.initializers.orthogonal(gain)(weight_key, (out_size, in_size))
            self.bias = jnp.zeros(out_size)
            return
        limit = max(in_size, 1) ** -0.5
        self.weight = jax.random.uniform(weight_key, (out_size, in_size), minval=-limit, maxval=limit)
        self.bias = jax.random.uniform(bias_key, (out_size,), minval=-limit, maxval=limit)

    def __call__(self, x: Float[Array, "..."], axis: Literal[0, -1] = -1) -> Float[Array, "..."]:
        """[*b in] -> [*b out]; with `axis=0`, [in *b] -> [out *b]."""
        if axis == 0:
            y = jnp.tensordot(self.weight, x, axes=1)
            return y + self.bias.reshape(-1, *[1] * (x.ndim - 1))
        y = x @ self.weight.T
        return y + jnp.broadcast_to(self.bias, y.shape)


class Score(eqx.Module):
    """x ↦ w · x over the last axis of x, for a softmax: a bias would cancel, its gradient be rounding alone."""

    weight: Float[Array, "1 in"]

    def __init__(self, in_size: int, key: PRNGKey, gain: float | None = None):
        """Weights like those of `Linear`."""
        self.weight = Linear(in_size, 1, key, gain).weight

    def __call__(self, x: Float[Array, "*b in"]) -> Float[Array, "*b"]:
        return (x @ self.weight.T)[..., 0]


def rectified(x: Float[Array, "*b"], slope: float = 0.0) -> Float[Array, "*b"]:
    """x where it is positive, else slope · x: a ReLU, or a leaky one (Maas et al. 2013)."""
    return jax.nn.leaky_relu(x, slope) if slope else jax.nn.relu(x)


class Mlp(eqx.Module):
    """Affine layers with a ReLU after each of them."""

    layers: tuple[Linear, ...]
    slope: float = eqx.field(static=True)
    """What the ReLU lets pass of negative numbers."""

    def __init__(
        self,
        in_size: int,
        hidden_sizes: tuple[int, ...],
        key: PRNGKey,
        gain: float | None = None,
        slope: float = 0.0,
    ):
        self.slope = slope
        sizes = (in_size, *hidden_sizes)
        keys = jax.random.split(key, len(hidden_sizes))
        self.layers = tuple(Linear(i, o, k, gain) for i, o, k in zip(sizes, sizes[1:], keys, strict=False))

    def __call__(self, x: Float[Array, "..."]) -> Float[Array, "..."]:
        """[*b in] -> [*b out]"""
        for layer in self.layers:
            x = rectified(layer(x), self.slope)
        return x


def num_parameters(network: eqx.Module) -> int:
    """How many numbers a network learns."""
    return sum(leaf.size for leaf in jax.tree.leaves(network))
