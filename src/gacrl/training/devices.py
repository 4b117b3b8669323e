"""Independent seeds side by side on the devices of this machine."""

import os
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import PyTree


def prepare_cpu(num_devices: int | None = None) -> None:
    """Make one CPU device per core (or as many as asked), each computing on one thread.

    XLA's own thread pool makes the small programs of this field slower, not faster (0.9 ms instead of 0.6
    for a step of the paper's schedule): two cores serve two seeds better than one. Without effect once JAX
    has started, or where the user has set these things already.
    """
    os.environ.setdefault("NPROC", "1")  # the size of XLA's thread pool
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    try:
        if jax.config.jax_num_cpu_devices < 0:  # pyright: ignore[reportAttributeAccessIssue]
            jax.config.update("jax_num_cpu_devices", cores if num_devices is None else num_devices)
    except RuntimeError:
        pass  # JAX has started: it keeps the devices that it has


def devices_for(num_seeds: int) -> list[jax.Device]:
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


def without_padding(stacked: PyTree, num_seeds: int) -> PyTree:
    """The real seeds of a sharded pytree, on one device."""
    return jax.device_put(jax.tree.map(lambda leaf: leaf[:num_seeds], stacked), jax.local_devices()[0])


def map_seeds(function: Callable[..., Any], num_seeds: int) -> Callable[..., Any]:
    """`function(member, *shared)` for one seed, as a function of the stacked seeds.

    Seeds are sharded over the devices and mapped within one. A device with a single seed runs the very
    program of a single seed, without a batch axis.
    """
    devices = devices_for(num_seeds)
    mesh = Mesh(np.asarray(devices), ("seeds",))

    def on_one_device(stacked: PyTree, *shared: PyTree) -> PyTree:
        if jax.tree.leaves(stacked)[0].shape[0] == 1:
            result = function(jax.tree.map(lambda leaf: leaf[0], stacked), *shared)
            return jax.tree.map(lambda leaf: leaf[None], result)
        return jax.vmap(lambda member: function(member, *shared))(stacked)

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
