"""What more than one learner needs: functions on a team's arrays, and the optimiser."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import optax
from jax.flatten_util import ravel_pytree
from jax.sharding import PartitionSpec
from jaxtyping import Array, Bool, Float, Int, PyTree

from gacrl.types import Transition

ENVS = "envs"
"""The axis of a mesh over which one seed's environments are spread (training.devices)."""


def share_out(tree: PyTree) -> PyTree:
    """Ask the compiler to give each device of the axis `envs` a share of the first axis; where there is none, nothing.

    An axis that cannot be shared evenly is left as it is: every device then has all of it.
    """
    devices = num_shares()
    if devices == 1:
        return tree
    return jax.tree.map(
        lambda leaf: (
            leaf if leaf.shape[0] % devices else jax.lax.with_sharding_constraint(leaf, PartitionSpec(ENVS))
        ),
        tree,
    )


def num_shares() -> int:
    """Return how many devices the axis `envs` has."""
    return dict(jax.sharding.get_abstract_mesh().shape).get(ENVS, 1)


def sum_over_devices(
    function: Callable[[PyTree, Int[Array, " R"]], PyTree], whole: PyTree, rows: Int[Array, " R"]
) -> PyTree:
    """Return function(whole, rows), summed over shares of the rows, of which each device of the axis `envs` has one.

    Of all rows where there is one device, or no even share. The terms are told as one vector: of several arrays each is
    a message, which costs more than its numbers.
    """
    if num_shares() == 1 or rows.size % num_shares():
        return function(whole, rows)

    def on_one_device(whole: PyTree, rows: Int[Array, " share"]) -> PyTree:
        term, unravel = ravel_pytree(function(whole, rows))
        return unravel(jax.lax.psum(term, ENVS))

    everywhere = PartitionSpec()
    return jax.shard_map(
        on_one_device,
        in_specs=(everywhere, PartitionSpec(ENVS)),
        out_specs=everywhere,
        axis_names={ENVS},
        check_vma=False,
    )(whole, rows)


def clipped_adam(max_grad_norm: float, eps: float = 1e-8) -> optax.GradientTransformation:
    """Make the transformation that gives Adam's directions (to be multiplied by the step size) of gradients shortened
    to a norm, on one flat vector.
    """
    return optax.chain(optax.clip_by_global_norm(max_grad_norm), optax.flatten(optax.scale_by_adam(eps=eps)))


def taken(values: Float[Array, "*b A"], action: Int[Array, "*b"]) -> Float[Array, "*b"]:
    """Return the entry of the action taken.

    (A product with the one-hot: the gradient of a lookup is a slow scatter.)
    """
    chosen = jax.nn.one_hot(action, values.shape[-1], dtype=bool)
    return jnp.where(chosen, values, 0.0).sum(-1)


def mean_real(
    values: Float[Array, "*b"], real: Bool[Array, "*b"], count: Int[Array, ""] | None = None
) -> Float[Array, ""]:
    """Return the mean over the real agents; with their count, a share's part of the mean over all shares."""
    return jnp.where(real, values, 0.0).sum() / jnp.maximum(real.sum() if count is None else count, 1)


def share_reward(steps: Transition, team: bool) -> Float[Array, "*b N"]:
    """Return the mean over the real agents for everyone, or each its own.

    Where agents come and go within an episode, the mean is over all slots, and an empty one earns 0. A mean over those
    who are there would not rise when a jam clears.
    """
    if not team:
        return steps.reward
    real = steps.observation.agent_mask
    among = jnp.maximum(real.sum(-1, keepdims=True), 1) if steps.left is None else real.shape[-1]
    mean = jnp.where(real, steps.reward, 0.0).sum(-1, keepdims=True) / among
    return jnp.broadcast_to(mean, steps.reward.shape)
