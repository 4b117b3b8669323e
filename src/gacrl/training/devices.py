"""How this machine is used: its devices, the compilation cache, and independent seeds side by side."""

import contextlib
import os
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import PyTree

_CACHE_BYTES = 512 * 2**20
"""Bound of the compilation cache; the oldest programs go first."""


def prepare_jax(num_seeds: int = 1) -> None:
    """Settle how JAX uses this machine; call it before anything is computed.

    A CPU device for each seed, as far as the cores go, and one thread for each: with more threads XLA hands
    the tiny pieces of these programs back and forth between them, and a single seed takes twice the time.
    Compiled programs are kept in the user's cache folder, so that a second start is quick.

    What the user has set already stays, and once JAX has started its devices stay as they are.
    """
    os.environ.setdefault("NPROC", "1")  # the size of XLA's thread pool, where there is one device
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    with contextlib.suppress(RuntimeError):  # JAX has started
        if jax.config.jax_num_cpu_devices < 0:  # pyright: ignore[reportAttributeAccessIssue]
            jax.config.update("jax_num_cpu_devices", min(cores, num_seeds))
    if jax.config.jax_compilation_cache_dir is None:  # pyright: ignore[reportAttributeAccessIssue]
        caches = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        with contextlib.suppress(OSError):  # no place for a cache: work without one
            (caches / "gacrl" / "jax").mkdir(parents=True, exist_ok=True)
            jax.config.update("jax_compilation_cache_dir", str(caches / "gacrl" / "jax"))
            jax.config.update("jax_compilation_cache_max_size", _CACHE_BYTES)
            jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)


def compiler_options() -> dict[str, str]:
    """Options for programs of many small pieces, on the versions that they were measured with.

    XLA hands matrix products and, from 0.10 on, also sums to a kernel library; for sums of this size the call
    costs more than the sum (0.57 instead of 0.67 ms for a step of the paper's schedule).
    """
    tested = jax.default_backend() == "cpu" and jax.__version__.startswith("0.10.")
    return {"xla_cpu_experimental_ynn_fusion_type": "LIBRARY_FUSION_TYPE_DOT"} if tested else {}


def devices_for(num_seeds: int) -> list[Any]:
    """As many devices as can be kept busy by this many seeds."""
    return jax.local_devices()[: min(num_seeds, jax.local_device_count())]


@jax.jit
def stack_seeds(members: list[PyTree]) -> PyTree:
    """Pytrees of single seeds as one, with the seeds in front of every axis.

    One program, as is each of those below: leaf by leaf a start would compile hundreds of tiny ones.
    """
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *members)


def shard_seeds(stacked: PyTree, num_seeds: int) -> PyTree:
    """A stacked pytree laid out on the devices.

    Where the seeds do not fill the devices evenly the last one is repeated: computed, never looked at.
    """
    devices = devices_for(num_seeds)
    sharding = NamedSharding(Mesh(np.asarray(devices), ("seeds",)), PartitionSpec("seeds"))
    if len(devices) == 1:
        return jax.device_put(stacked, sharding)
    parts = map(jax.device_put, _split(stacked, len(devices)), devices)

    def whole(*shards: jax.Array) -> jax.Array:
        shape = (len(shards) * shards[0].shape[0], *shards[0].shape[1:])
        return jax.make_array_from_single_device_arrays(shape, sharding, list(shards))

    return jax.tree.map(whole, *parts)


@partial(jax.jit, static_argnums=1)
def _split(stacked: PyTree, parts: int) -> list[PyTree]:
    """Equal parts of the seeds, the last seed repeated until they are equal."""

    def part(leaf: jax.Array, number: int) -> jax.Array:
        padded = jnp.concatenate([leaf, *[leaf[-1:]] * (-leaf.shape[0] % parts)])
        return jnp.split(padded, parts)[number]

    return [jax.tree.map(partial(part, number=number), stacked) for number in range(parts)]


def one_seed(stacked: PyTree, member: int) -> PyTree:
    """A single seed of a stacked pytree, on one device."""
    return _only(rows(stacked, member, member + 1))


def without_padding(stacked: PyTree, num_seeds: int) -> PyTree:
    """The real seeds of a sharded pytree, on one device."""
    return rows(stacked, 0, num_seeds)


def rows(stacked: PyTree, start: int, stop: int) -> PyTree:
    """The seeds from `start` up to `stop` of a sharded pytree, on one device, fetched shard by shard.

    Indexing the sharded arrays themselves would make their devices wait for each other, and XLA ends the process
    when one of them, on a busy machine, is late by 40 seconds.
    """
    leaves, structure = jax.tree.flatten(stacked)
    home = jax.local_devices()[0]
    fetched: list[list[jax.Array]] = []
    before = 0
    for leaf in leaves:
        shards = sorted(leaf.addressable_shards, key=lambda shard: shard.index[0].start or 0)
        held = leaf.shape[0] // len(shards)
        first, last = start // held, (stop - 1) // held
        fetched.append([jax.device_put(shard.data, home) for shard in shards[first : last + 1]])
        before = first * held
    return structure.unflatten(_joined(fetched, start - before, stop - before))


@jax.jit
def _only(stacked: PyTree) -> PyTree:
    return jax.tree.map(lambda leaf: leaf[0], stacked)


@partial(jax.jit, static_argnums=(1, 2))
def _joined(parts: list[list[jax.Array]], start: int, stop: int) -> list[jax.Array]:
    return [jnp.concatenate(leaf)[start:stop].copy() for leaf in parts]


def map_seeds(function: Callable[..., Any], num_seeds: int) -> Callable[..., Any]:
    """`function(member, *shared)` for one seed, as a function of the stacked seeds.

    Seeds are sharded over the devices. Within one device they take turns: on a CPU, mapping them instead makes
    every small matrix product a batch of them, and gains nothing (docs/design.md).
    """
    devices = devices_for(num_seeds)
    mesh = Mesh(np.asarray(devices), ("seeds",))

    def on_one_device(stacked: PyTree, *shared: PyTree) -> PyTree:
        if jax.tree.leaves(stacked)[0].shape[0] == 1:
            result = function(jax.tree.map(lambda leaf: leaf[0], stacked), *shared)
            return jax.tree.map(lambda leaf: leaf[None], result)
        if jax.default_backend() != "cpu":
            return jax.vmap(lambda member: function(member, *shared))(stacked)
        return jax.lax.map(lambda member: function(member, *shared), stacked)

    def on_all_devices(stacked: PyTree, *shared: PyTree) -> PyTree:
        if len(devices) == 1:
            return on_one_device(stacked, *shared)
        seeds, everywhere = PartitionSpec("seeds"), PartitionSpec()
        return jax.shard_map(
            on_one_device,
            mesh=mesh,
            in_specs=(seeds, *[everywhere] * len(shared)),
            out_specs=seeds,
            check_vma=False,
        )(stacked, *shared)

    return on_all_devices
