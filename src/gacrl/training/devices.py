"""How this machine is used: its devices, the compilation cache, and independent seeds side by side."""

import contextlib
import os
from collections.abc import Callable
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


def stack_seeds(members: list[PyTree]) -> PyTree:
    """Pytrees of single seeds as one, with the seeds in front of every axis."""
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *members)


def shard_seeds(stacked: PyTree, num_seeds: int) -> PyTree:
    """A stacked pytree laid out on the devices.

    Where the seeds do not fill the devices evenly the last one is repeated: computed, never looked at.
    """
    devices = devices_for(num_seeds)
    members = jnp.minimum(jnp.arange(num_seeds + -num_seeds % len(devices)), num_seeds - 1)
    mesh = Mesh(np.asarray(devices), ("seeds",))
    padded = jax.tree.map(lambda leaf: leaf[members], stacked)
    return jax.device_put(padded, NamedSharding(mesh, PartitionSpec("seeds")))


def one_seed(stacked: PyTree, member: int) -> PyTree:
    """A single seed of a stacked pytree, on one device."""
    return jax.tree.map(lambda leaf: _rows(leaf, member, member + 1)[0], stacked)


def without_padding(stacked: PyTree, num_seeds: int) -> PyTree:
    """The real seeds of a sharded pytree, on one device."""
    return jax.tree.map(lambda leaf: _rows(leaf, 0, num_seeds), stacked)


def _rows(leaf: Any, start: int, stop: int) -> jax.Array:
    """Rows of a sharded array, on one device, fetched shard by shard.

    Indexing the sharded array itself would make its devices wait for each other, and XLA ends the process when
    one of them, on a busy machine, is late by 40 seconds.
    """
    home = jax.local_devices()[0]
    if not isinstance(leaf, jax.Array) or len(leaf.sharding.device_set) == 1:
        return jax.device_put(leaf[start:stop], home)
    parts: list[jax.Array] = []
    for shard in sorted(leaf.addressable_shards, key=lambda shard: shard.index[0].start or 0):
        first = shard.index[0].start or 0
        wanted = slice(max(start - first, 0), max(stop - first, 0))
        if wanted.start < min(wanted.stop, shard.data.shape[0]):
            parts.append(jax.device_put(shard.data[wanted], home))
    return jnp.concatenate(parts)


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
