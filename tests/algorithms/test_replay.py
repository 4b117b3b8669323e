"""The ring: what it keeps, and that every kept item is equally likely."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gacrl.algorithms import replay


class Item(NamedTuple):
    number: jax.Array
    pair: jax.Array


def item(number):
    """The second leaf follows from the first: leaves that get out of step show."""
    return Item(jnp.int32(number), jnp.array([10.0 * number, -number]))


add = jax.jit(replay.add)
sample = jax.jit(lambda ring, key, size: replay.take(ring, replay.sample_rows(ring, key, size)), static_argnums=2)


def filled(count, capacity=4):
    ring = replay.empty(item(0), capacity)
    for number in range(1, count + 1):
        ring = add(ring, item(number))
    return ring


def test_the_newest_take_the_place_of_the_oldest():
    ring = filled(3)
    np.testing.assert_array_equal(ring.items.number, [1, 2, 3, 0])
    assert (ring.capacity, int(ring.size)) == (4, 3)
    ring = filled(10)
    np.testing.assert_array_equal(ring.items.number, [9, 10, 7, 8])
    np.testing.assert_array_equal(ring.items.pair[:, 0], [90, 100, 70, 80])
    assert (ring.capacity, int(ring.size), int(ring.added)) == (4, 4, 10)


def test_samples_are_uniform_over_what_is_stored():
    """8,000 draws: never the empty slots, each stored item within 5 standard deviations of its share."""
    for count, stored in ((1, [1]), (3, [1, 2, 3]), (6, [3, 4, 5, 6])):
        batch = sample(filled(count), jax.random.key(count), 8_000)
        numbers, counts = np.unique(batch.number, return_counts=True)
        np.testing.assert_array_equal(numbers, stored)
        share = 1 / len(stored)
        assert (np.abs(counts - 8_000 * share) <= 5 * np.sqrt(8_000 * share * (1 - share))).all()
        np.testing.assert_array_equal(batch.pair, np.outer(batch.number, [10, -1]))


def test_samples_hang_on_the_key_alone():
    ring = filled(6)
    first, again, other = (sample(ring, jax.random.key(k), 8_000).number for k in (0, 0, 1))
    np.testing.assert_array_equal(first, again)
    assert (np.asarray(first) != np.asarray(other)).any()
