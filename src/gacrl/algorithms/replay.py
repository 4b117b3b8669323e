"""A ring of past experience: fixed size, any pytree, uniform sampling of single items or of windows in time."""

from collections.abc import Callable
from typing import Generic, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int

from gacrl.types import PRNGKey

Item = TypeVar("Item")


class Replay(eqx.Module, Generic[Item]):
    """The newest `capacity` items; every leaf of `items` has the capacity as its first axis."""

    items: Item
    added: Int[Array, ""]
    """Items ever added; the next one goes to `added % capacity`."""

    @property
    def capacity(self) -> int:
        return jax.tree.leaves(self.items)[0].shape[0]

    @property
    def size(self) -> Int[Array, ""]:
        """Items that can be sampled."""
        return jnp.minimum(self.added, self.capacity)


def empty(example: Item, capacity: int) -> Replay[Item]:
    """Make a ring for items shaped like the example."""
    return Replay(
        jax.tree.map(lambda leaf: jnp.zeros((capacity, *leaf.shape), leaf.dtype), example),
        jnp.zeros((), jnp.int32),
    )


def add(replay: Replay[Item], item: Item) -> Replay[Item]:
    """Put one item in place of the oldest."""
    return add_block(replay, jax.tree.map(lambda leaf: leaf[None], item))


def add_block(replay: Replay[Item], block: Item) -> Replay[Item]:
    """Put T items [T, …] in place of the oldest; the capacity must be a multiple of T."""
    length = jax.tree.leaves(block)[0].shape[0]
    slot = replay.added % replay.capacity
    items = jax.tree.map(
        lambda ring, leaf: jax.lax.dynamic_update_slice_in_dim(ring, leaf, slot, 0), replay.items, block
    )
    return Replay(items, replay.added + length)


def newest(replay: Replay[Item]) -> Int[Array, ""]:
    """Return the row of the item that was added last."""
    return (replay.added - 1) % replay.capacity


def sample_rows(replay: Replay[Item], key: PRNGKey, batch_size: int) -> Int[Array, " B"]:
    """Draw uniform rows, with replacement; there must be at least one item.

    The remainder of 32 random bits: no row is favoured by more than one part in 2³² / size.
    """
    bits = jax.random.bits(key, (batch_size,), jnp.uint32)
    return (bits % replay.size.astype(jnp.uint32)).astype(jnp.int32)


def sample_windows(replay: Replay[Item], key: PRNGKey, batch_size: int, length: int) -> Int[Array, "W B"]:
    """Draw rows of uniform stretches of `length` items that were added one after the other; oldest first."""
    starts = jnp.maximum(replay.size - length + 1, 1).astype(jnp.uint32)
    first = (jax.random.bits(key, (batch_size,), jnp.uint32) % starts).astype(jnp.int32)
    oldest = jnp.where(replay.added > replay.capacity, replay.added % replay.capacity, 0)
    return (oldest + first[None, :] + jnp.arange(length)[:, None]) % replay.capacity


def take(replay: Replay[Item], rows: Int[Array, " B"]) -> Item:
    """Return the items in these rows."""
    return jax.tree.map(lambda ring: ring.at[rows].get(mode="promise_in_bounds"), replay.items)


def pack(item: object) -> Float[Array, " W"]:
    """Return an item as one vector of numbers.

    Of rings with small items XLA makes whole copies where it reads what it has just written.
    """
    return ravel_pytree(item)[0]


def packing(example: Callable[[], Item]) -> tuple[int, Callable[[Float[Array, " W"]], Item]]:
    """Return the length of an item as a vector, and the inverse of `pack`; nothing is computed, only shapes are looked
    at.
    """
    inverses: list[Callable[[Float[Array, " W"]], Item]] = []

    def packed() -> Float[Array, " W"]:
        vector, unpack = ravel_pytree(example())
        inverses.append(unpack)
        return vector

    return jax.eval_shape(packed).size, inverses[0]
