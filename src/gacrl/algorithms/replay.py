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


def sample(replay: Replay[Item], key: PRNGKey, batch_size: int) -> Item:
    """A uniform batch, with replacement; there must be at least one item."""
    rows = jax.random.randint(key, (batch_size,), 0, replay.size)
    return jax.tree.map(lambda ring: ring[rows], replay.items)
