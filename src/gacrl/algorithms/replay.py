"""A ring of past experience: fixed size, any pytree, uniform sampling."""

from typing import Generic, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

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
    """A ring for items shaped like the example."""
    return Replay(
        jax.tree.map(lambda leaf: jnp.zeros((capacity, *leaf.shape), leaf.dtype), example),
        jnp.zeros((), jnp.int32),
    )


def add(replay: Replay[Item], item: Item) -> Replay[Item]:
    """Put one item in place of the oldest."""
    slot = replay.added % replay.capacity
    items = jax.tree.map(
        lambda ring, leaf: jax.lax.dynamic_update_index_in_dim(ring, leaf, slot, 0), replay.items, item
    )
    return Replay(items, replay.added + 1)


def newest(replay: Replay[Item]) -> Int[Array, ""]:
    """The row of the item that was added last."""
    return (replay.added - 1) % replay.capacity


def sample_rows(replay: Replay[Item], key: PRNGKey, batch_size: int) -> Int[Array, " B"]:
    """Uniform rows, with replacement; there must be at least one item.

    The remainder of 32 random bits: no row is favoured by more than one part in 2³² / size.
    """
    bits = jax.random.bits(key, (batch_size,), jnp.uint32)
    return (bits % replay.size.astype(jnp.uint32)).astype(jnp.int32)


def take(replay: Replay[Item], rows: Int[Array, " B"]) -> Item:
    """The items in these rows."""
    return jax.tree.map(lambda ring: ring.at[rows].get(mode="promise_in_bounds"), replay.items)
