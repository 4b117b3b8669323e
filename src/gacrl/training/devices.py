"""How this machine is used: devices, the compilation cache, independent seeds side by side, several processes."""

import contextlib
import ctypes
import os
from collections import Counter
from collections.abc import Callable
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import PyTree

from gacrl.algorithms.shared import ENVS
from gacrl.errors import UserError
from gacrl.training import accelerator, program_cache

KNOWN_XLA = jax.__version__.startswith("0.10.")
"""Whether XLA's flags and options below are known to this version."""
_QUICKLY = "--xla_cpu_use_fusion_emitters=false --xla_backend_optimization_level=2"
"""XLA's flags for programs that are compiled for longer than they run: it then takes a third to a half of the time."""


def prepare_jax(num_seeds: int = 1) -> None:
    """Settle how JAX uses this machine; call it before anything is computed.

    A CPU device for each seed, as far as the cores go, and one thread for each: with more threads XLA hands
    the tiny pieces of these programs back and forth between them, and a single seed takes twice the time.
    Compiled programs are kept in the user's cache folder, so that a second start is quick; and most are compiled
    quickly, not for speed (`compiler_options`).

    What the user has set already stays, and once JAX has started its devices stay as they are. Raises UserError where
    the user asks for a GPU that JAX was installed without.
    """
    os.environ.setdefault("NPROC", "1")  # the size of XLA's thread pool, where there is one device
    chosen = accelerator.flags(_QUICKLY if KNOWN_XLA else None)
    if chosen is not None:
        os.environ.setdefault("XLA_FLAGS", chosen)
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    with contextlib.suppress(RuntimeError):  # JAX has started
        if jax.config.jax_num_cpu_devices < 0:  # pyright: ignore[reportAttributeAccessIssue]
            jax.config.update("jax_num_cpu_devices", min(cores, num_seeds))
    program_cache.keep()


def compiler_options(for_speed: bool = True, library_sums: bool = False) -> dict[str, Any]:
    """Return options for a training program, of many small pieces, on the versions that they were measured with.

    XLA hands matrix products and, from 0.10 on, also sums to a kernel library; for sums of this size the call
    costs more than the sum (0.57 instead of 0.67 ms for a step of the paper's schedule). Along windows of many steps it
    is the other way round (docs/design.md): there `library_sums` leaves them to the library.

    for_speed: optimised as XLA does by itself, not as quickly compiled as all else is. Whoever sets XLA_FLAGS has the
    choice of both.
    """
    if not (KNOWN_XLA and jax.default_backend() == "cpu"):
        return {}
    options: dict[str, Any] = {}
    if not library_sums:
        options["xla_cpu_experimental_ynn_fusion_type"] = "LIBRARY_FUSION_TYPE_DOT"
    if for_speed and os.environ.get("XLA_FLAGS") == _QUICKLY:
        options |= {"xla_cpu_use_fusion_emitters": True, "xla_backend_optimization_level": 3}
    return options


def release_memory() -> None:
    """Let go of the programs of the runs that have ended, and give their memory back to the system.

    JAX keeps every program, some 90 MB a run, as long as the process lives; and glibc keeps what was freed between
    what was not, several hundred MB that grow with every run.
    """
    jax.clear_caches()
    with contextlib.suppress(AttributeError, OSError, TypeError):  # another C library
        ctypes.CDLL(None).malloc_trim(0)


def mesh_for(num_seeds: int, num_envs: int | None = None) -> Mesh:
    """Return the devices of all processes, as many as can be kept busy, with the axes `seeds` and `envs`.

    num_envs: environments of a seed, where the algorithm can learn from a share of them on each device; one process
    on a CPU leaves them together. Raises UserError where some process would have nothing to do.
    """
    seeds, envs, devices = _shares(num_seeds, num_envs)
    uneven = num_envs is not None and num_envs % envs > 0
    if jax.process_count() == 1:
        if uneven:
            seeds, envs = min(num_seeds, len(devices)), 1
    elif num_envs is None and num_seeds < jax.process_count():
        raise UserError(
            f"{jax.process_count()} processes cannot share {num_seeds} seeds of an algorithm that learns from replay: "
            f"give --num-seeds {jax.process_count()} or more, start fewer processes, or take a PPO preset"
        )
    elif uneven:
        raise UserError(
            f"training.num_envs {num_envs} cannot be shared evenly by the {envs} devices of a seed: make it a multiple"
        )
    return Mesh(np.asarray(devices[: seeds * envs]).reshape(seeds, envs), ("seeds", ENVS))


def _shares(num_seeds: int, num_envs: int | None) -> tuple[int, int, list[Any]]:
    """How many groups of seeds, how many devices for each, and the devices, those of a process side by side."""
    local = Counter(device.process_index for device in jax.devices())
    each = min(local.values())
    if num_envs is None or jax.default_backend() == "cpu":
        each = min(each, -(-num_seeds // len(local)))
    devices = [device for k in sorted(local) for device in jax.local_devices(k)[:each]]
    if num_envs is None or num_seeds >= len(devices):
        return len(devices), 1, devices
    seeds = max(count for count in range(1, num_seeds + 1) if len(devices) % count == 0)
    return seeds, len(devices) // seeds, devices


@jax.jit
def stack_seeds(members: list[PyTree]) -> PyTree:
    """Stack pytrees of single seeds as one, with the seeds in front of every axis.

    One program, as is each of those below: leaf by leaf a start would compile hundreds of tiny ones.
    """
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *members)


def shard_seeds(stacked: PyTree, mesh: Mesh) -> PyTree:
    """Return a stacked pytree laid out on the devices; with several processes each has the whole of it to begin with.

    Where the seeds do not fill the devices evenly the last one is repeated: computed, never looked at.
    """
    layout = NamedSharding(mesh, PartitionSpec("seeds"))
    if mesh.size == 1:
        return jax.device_put(stacked, layout)
    parts = _split(stacked, mesh.shape["seeds"])
    own = [
        jax.device_put(part, device)
        for part, group in zip(parts, mesh.devices, strict=True)
        for device in group
        if device.process_index == jax.process_index()
    ]

    def whole(*shards: jax.Array) -> jax.Array:
        shape = (len(parts) * shards[0].shape[0], *shards[0].shape[1:])
        return jax.make_array_from_single_device_arrays(shape, layout, list(shards))

    return jax.tree.map(whole, *own)


@partial(jax.jit, static_argnums=1)
def _split(stacked: PyTree, parts: int) -> list[PyTree]:
    """Equal parts of the seeds, the last seed repeated until they are equal."""

    def part(leaf: jax.Array, number: int) -> jax.Array:
        padded = jnp.concatenate([leaf, *[leaf[-1:]] * (-leaf.shape[0] % parts)])
        return jnp.split(padded, parts)[number]

    return [jax.tree.map(partial(part, number=number), stacked) for number in range(parts)]


def gathered(tree: PyTree) -> PyTree:
    """Gather a tree that is spread over several processes; every process must call this. Others stay as they are."""
    if jax.process_count() == 1:
        return tree
    wait_for_all()
    leaves = jax.tree.leaves(tree)
    whole = _gathering(leaves[0].sharding.mesh)(tree)
    return jax.tree.map(lambda leaf: leaf.addressable_data(0), whole)


@cache
def _gathering(mesh: Mesh) -> Callable[[PyTree], PyTree]:
    return jax.jit(lambda tree: tree, out_shardings=NamedSharding(mesh, PartitionSpec()))


def leads() -> bool:
    """Return whether this process writes: one of several does."""
    return jax.process_index() == 0


def anyone(yes: bool) -> bool:
    """Return whether any of the processes says yes; all must ask."""
    return yes if jax.process_count() == 1 else bool(multihost_utils.process_allgather(np.asarray(yes)).any())


def wait_for_all() -> None:
    """Go on when all processes are here.

    gloo gives processes 30 s between the first and the last to set up what they need for a new computation, less than
    compiling may take; for one that is set up it waits as long as it must. This one is set up when a process joins.
    """
    anyone(False)


def same_everywhere(number: int) -> bool:
    """Return whether all processes have the same number; all must ask, and none goes on before all have."""
    if jax.process_count() == 1:
        return True
    return len(set(multihost_utils.process_allgather(np.asarray(number)).tolist())) == 1


def one_seed(stacked: PyTree, member: int) -> PyTree:
    """Return a single seed of a stacked pytree, on one device."""
    return _only(rows(stacked, member, member + 1))


def without_padding(stacked: PyTree, num_seeds: int) -> PyTree:
    """Return the real seeds of a sharded pytree, on one device."""
    return rows(stacked, 0, num_seeds)


def rows(stacked: PyTree, start: int, stop: int) -> PyTree:
    """Return the seeds from `start` up to `stop` of a sharded pytree, on one device, fetched shard by shard.

    Indexing the sharded arrays themselves would make their devices wait for each other, and XLA ends the process
    when one of them, on a busy machine, is late by 40 seconds.
    """
    leaves, structure = jax.tree.flatten(stacked)
    home = jax.local_devices()[0]
    fetched: list[list[jax.Array]] = []
    before = 0
    for leaf in leaves:
        shards = sorted(_distinct(leaf), key=lambda shard: shard.index[0].start or 0)
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


def _distinct(leaf: jax.Array) -> list[Any]:
    """Its shards, each once: the environments of a seed may be spread over several devices, its state is on each."""
    return [shard for shard in leaf.addressable_shards if shard.replica_id == 0]


def map_seeds(function: Callable[..., Any], mesh: Mesh, in_place: bool = False) -> Callable[..., Any]:
    """Make of `function(member, *shared)`, for one seed, a function of the stacked seeds.

    in_place: the function returns the member as it is afterwards, and what else it has to say. Members that take turns
    are then written where they were: beside them their replays would lie once more.

    Seeds are sharded over the devices. Within one device they take turns: on a CPU, mapping them instead makes
    every small matrix product a batch of them, and gains nothing (docs/design.md). What is within a seed is left to
    the compiler to spread over the axis `envs`, as `algorithms.shared.share_out` asks.
    """

    def on_one_device(stacked: PyTree, *shared: PyTree) -> PyTree:
        if jax.tree.leaves(stacked)[0].shape[0] == 1:
            result = function(jax.tree.map(lambda leaf: leaf[0], stacked), *shared)
            return jax.tree.map(lambda leaf: leaf[None], result)
        if jax.default_backend() != "cpu":
            return jax.vmap(lambda member: function(member, *shared))(stacked)
        if in_place:
            return _one_after_another(lambda member: function(member, *shared), stacked)
        return jax.lax.map(lambda member: function(member, *shared), stacked)

    def on_all_devices(stacked: PyTree, *shared: PyTree) -> PyTree:
        if mesh.size == 1:
            return on_one_device(stacked, *shared)
        seeds, everywhere = PartitionSpec("seeds"), PartitionSpec()
        mapped = jax.shard_map(
            on_one_device,
            mesh=mesh,
            in_specs=(seeds, *[everywhere] * len(shared)),
            out_specs=seeds,
            axis_names={"seeds"} if mesh.shape[ENVS] > 1 else set(mesh.axis_names),
            check_vma=False,
        )(stacked, *shared)
        if mesh.shape[ENVS] == 1:
            return mapped
        return jax.lax.with_sharding_constraint(mapped, NamedSharding(mesh, seeds))

    return on_all_devices


def _one_after_another(
    function: Callable[[PyTree], tuple[PyTree, PyTree]], stacked: PyTree
) -> tuple[PyTree, PyTree]:
    """Map a function over stacked members, and put each, as it is afterwards, back into its place."""

    def turn(stacked: PyTree, number: jax.Array) -> tuple[PyTree, PyTree]:
        member, shown = function(jax.tree.map(lambda leaf: leaf[number], stacked))
        return jax.tree.map(lambda leaf, new: leaf.at[number].set(new), stacked, member), shown

    return jax.lax.scan(turn, stacked, jnp.arange(jax.tree.leaves(stacked)[0].shape[0]))
