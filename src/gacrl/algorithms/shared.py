"""What more than one learner needs: functions on a team's arrays, and the optimiser."""

import jax
import jax.numpy as jnp
import optax
from jax.sharding import PartitionSpec
from jaxtyping import Array, Bool, Float, Int, PyTree

ENVS = "envs"
"""The axis of a mesh over which one seed's environments are spread (training.devices)."""


def share_out(tree: PyTree, axis: int = 0) -> PyTree:
    """Ask the compiler to give each device of the axis `envs` a share of this axis; where there is none, nothing.

    An axis that cannot be shared evenly is left as it is: every device then has all of it.
    """
    devices = dict(jax.sharding.get_abstract_mesh().shape).get(ENVS, 1)
    if devices == 1:
        return tree
    layout = PartitionSpec(*[None] * axis, ENVS)
    return jax.tree.map(
        lambda leaf: leaf if leaf.shape[axis] % devices else jax.lax.with_sharding_constraint(leaf, layout), tree
    )


def clipped_adam(max_grad_norm: float, eps: float = 1e-8) -> optax.GradientTransformation:
    """Adam's directions (to be multiplied by the step size) of gradients shortened to a norm, on one flat vector."""
    return optax.chain(optax.clip_by_global_norm(max_grad_norm), optax.flatten(optax.scale_by_adam(eps=eps)))


def taken(values: Float[Array, "*b A"], action: Int[Array, "*b"]) -> Float[Array, "*b"]:
    """The entry of the action taken. (A product with the one-hot: the gradient of a lookup is a slow scatter.)"""
    chosen = jax.nn.one_hot(action, values.shape[-1], dtype=bool)
    return jnp.where(chosen, values, 0.0).sum(-1)


def mean_real(values: Float[Array, "*b"], real: Bool[Array, "*b"]) -> Float[Array, ""]:
    """Mean over the real agents."""
    return jnp.where(real, values, 0.0).sum() / jnp.maximum(real.sum(), 1)


def share_reward(reward: Float[Array, "*b N"], real: Bool[Array, "*b N"], team: bool) -> Float[Array, "*b N"]:
    """The mean over the real agents for everyone, or each its own."""
    if not team:
        return reward
    mean = jnp.where(real, reward, 0.0).sum(-1, keepdims=True) / jnp.maximum(real.sum(-1, keepdims=True), 1)
    return jnp.broadcast_to(mean, reward.shape)
