"""The affine layer, laid out as papers write it: W x + b; and small stacks of it."""

from typing import Any, Literal, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from gacrl.types import PRNGKey

Net = TypeVar("Net", bound=eqx.Module)


class Linear(eqx.Module):
    """x ↦ W x + b over the last axis of x, or with `axis=0` over the first.

    Features first suits small networks on a CPU: softmax and concatenation over a handful of features then
    run along the batch, which is the contiguous axis when a caller vmaps over the last one.
    """

    weight: Float[Array, "out in"]
    bias: Float[Array, " out"]
    gain: float | None = eqx.field(static=True)

    def __init__(self, in_size: int, out_size: int, key: PRNGKey, gain: float | None = None):
        """With a gain: orthogonal weights times it, no bias (Saxe et al. 2014; what PPO is usually given).

        Without: weights and biases uniform in ±1/√in_size (the default of torch.nn.Linear).
        """
        self.gain = gain
        self.weight, self.bias = _first(_uniform(key, (out_size, in_size + 1)), gain)

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
    gain: float | None = eqx.field(static=True)

    def __init__(self, in_size: int, key: PRNGKey, gain: float | None = None):
        """Weights like those of `Linear`."""
        self.weight, self.gain = Linear(in_size, 1, key, gain).weight, gain

    def __call__(self, x: Float[Array, "*b in"]) -> Float[Array, "*b"]:
        return (x @ self.weight.T)[..., 0]


def rectified(x: Float[Array, "*b"], slope: float = 0.0) -> Float[Array, "*b"]:
    """Return x where it is positive, else slope · x: a ReLU, or a leaky one (Maas et al. 2013)."""
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


def redrawn(network: Net, key: PRNGKey) -> Net:
    """Give the layers of a network their first numbers anew, all of them from one draw.

    A draw a layer, which is what their constructors make, is a loop a layer to compile: that was most of what makes a
    training state. What is in no `Linear` and no `Score` stays as it is: constants, and TarMAC's signatures, drawn by a
    split of the same key. Another key for either would change the first numbers of stored runs.
    """
    nodes, tree = jax.tree.flatten(network, is_leaf=_is_layer)
    layers = [node for node in nodes if _is_layer(node)]
    ends = np.cumsum([layer.weight.size + len(layer.weight) for layer in layers])
    pieces = iter(jnp.split(_uniform(key, (int(ends[-1]),)), ends[:-1]) if layers else ())
    return jax.tree.unflatten(tree, [_refilled(node, next(pieces)) if _is_layer(node) else node for node in nodes])


def _is_layer(node: Any) -> bool:
    return isinstance(node, Linear | Score)


def _refilled(layer: Linear | Score, numbers: Float[Array, " n"]) -> Linear | Score:
    """The layer with weights, and a bias where it has one, made of these numbers."""
    weight, bias = _first(numbers.reshape(len(layer.weight), -1), layer.gain)
    if isinstance(layer, Score):
        return eqx.tree_at(lambda layer: layer.weight, layer, weight)
    return eqx.tree_at(lambda layer: (layer.weight, layer.bias), layer, (weight, bias))


def _uniform(key: PRNGKey, shape: tuple[int, ...]) -> Float[Array, "..."]:
    """Numbers within ±1, neither of which is drawn: each has a quantile of the normal distribution."""
    return jax.random.uniform(key, shape, minval=np.nextafter(np.float32(-1), np.float32(0)), maxval=1.0)


def _first(
    numbers: Float[Array, "out columns"], gain: float | None
) -> tuple[Float[Array, "out in"], Float[Array, " out"]]:
    """Weights and bias of a layer that has learned nothing, as `Linear` says."""
    weight, bias = numbers[:, :-1], numbers[:, -1]
    if gain is None:
        limit = max(weight.shape[1], 1) ** -0.5
        return limit * weight, limit * bias
    return gain * _orthogonal(jnp.sqrt(2.0) * jax.scipy.special.erfinv(weight)), jnp.zeros(len(weight))


def _orthogonal(normal: Float[Array, "out in"]) -> Float[Array, "out in"]:
    """Orthonormal rows, or columns where there are fewer of them, in a direction that is as likely as any other."""
    tall = normal.shape[0] >= normal.shape[1]
    q, r = jnp.linalg.qr(normal if tall else normal.T)
    q = q * jnp.sign(jnp.diag(r))[None]
    return q if tall else q.T


def num_parameters(network: eqx.Module) -> int:
    """Return how many numbers a network learns."""
    return sum(leaf.size for leaf in jax.tree.leaves(network))
