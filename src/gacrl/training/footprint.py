"""The memory that a run takes at the least, counted from shapes alone: nothing is allocated or compiled for it."""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
from jaxtyping import PyTree

from gacrl import rollout as rollouts
from gacrl.algorithms.contract import Algorithm
from gacrl.config.run import RunConfig
from gacrl.envs.environment import Environment, EnvParams
from gacrl.errors import UserError
from gacrl.evaluation.episodes import Look, recorded_bytes
from gacrl.training.trainer import TrainState
from gacrl.types import Learner, Memory

_OWN_CGROUPS = Path("/proc/self/cgroup")
_CGROUPS = (("/sys/fs/cgroup", "", "memory.max"), ("/sys/fs/cgroup/memory", "memory", "memory.limit_in_bytes"))
"""Both versions of Linux's control groups: where they are, what they are called in a process's list of its groups, and
the file of a group's limit."""


def size(tree: PyTree) -> int:
    """Return the bytes of arrays, or of their shapes."""
    return sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(tree))


def working_bytes(config: RunConfig, algorithm: Algorithm, member: TrainState) -> int:
    """Return what a seed's chunk or evaluation holds at once besides its state, at the least.

    member: a seed's training state, or its shapes. Counted are a rollout (every step's observation, before and after),
    the episodes of an evaluation, and the batch of a gradient step; not what XLA puts between them.
    """
    carry = size(member.carry)
    rollout = 2 * carry * config.training.num_steps
    episodes = max(config.evaluation.num_episodes, config.evaluation.final_episodes)
    evaluation = carry // config.training.num_envs * episodes
    return max(rollout, evaluation, _batch_bytes(algorithm, member.learner))


def playing_bytes(env: Environment, params: EnvParams, memory: Memory, num_episodes: int) -> int:
    """Return what episodes that are played side by side hold at once, at the least: states, observations and
    memories.
    """
    return size(jax.eval_shape(lambda: rollouts.start(env, params, memory, jax.random.key(0), num_episodes)))


def recording_bytes(env: Environment, params: EnvParams, num_episodes: int, look: Look | None) -> int:
    """Return what episodes that are kept hold at once, at the least: as they are played, and as they are handed out."""
    return 2 * recorded_bytes(env, params, num_episodes, look)


def require_room(
    needed: int,
    device: Any,
    what: str = "this run needs",
    mend: str = "take fewer seeds, environments or agents, or a smaller replay or network",
) -> None:
    """Raise UserError, with both numbers, for something that this machine has not the memory for."""
    there = memory_of(device)
    if there is not None and needed > there:
        raise UserError(
            f"{what} at least {readable(needed)} of memory and {device.platform}:{device.id} has "
            f"{readable(there)}: {mend}"
        )


def require_room_to_play(needed: int) -> None:
    """Raise UserError, with both numbers, for episodes that this machine has not the memory to play."""
    mend = "take fewer or shorter episodes, or fewer agents"
    require_room(needed, jax.local_devices()[0], "to play these episodes takes", mend)


def memory_of(device: Any) -> int | None:
    """Return the bytes of an accelerator's memory, or of the machine's (what the process may have, where that is less);
    None: not known.
    """
    if device.platform != "cpu":
        return (device.memory_stats() or {}).get("bytes_limit")
    try:
        there = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, OSError, ValueError):
        return None
    return min([there, *_limits()])


def _limits() -> Iterator[int]:
    """What this process may have: by its control groups, as containers and cluster jobs have, and by `ulimit`."""
    try:
        groups = [line.split(":", 2) for line in _OWN_CGROUPS.read_text().splitlines()]
    except OSError:
        groups = []
    for root, kind, name in _CGROUPS:
        own = [path.strip("/") for _, kinds, path in groups if kind in kinds.split(",")]
        for folder in {place for path in [*own, ""] for place in (Path(path), *Path(path).parents)}:
            try:
                limit = (Path(root) / folder / name).read_text().strip()
            except OSError:
                continue
            if limit.isdigit():
                yield int(limit)
    try:
        import resource
    except ImportError:  # not on Windows
        return
    for kind in (resource.RLIMIT_AS, resource.RLIMIT_DATA):
        if (soft := resource.getrlimit(kind)[0]) != resource.RLIM_INFINITY:
            yield soft


def readable(count: int) -> str:
    """Write bytes in words: 1.5 GiB."""
    units = ("KiB", "MiB", "GiB", "TiB", "PiB", "EiB", "ZiB", "YiB")
    amount, unit = count / 1024, 0
    while amount >= 1024 and unit < len(units) - 1:
        amount, unit = amount / 1024, unit + 1
    return f"{amount:,.1f} {units[unit]}"


def _batch_bytes(algorithm: Algorithm, learner: Learner) -> int:
    """What a gradient step takes out of the replay, where there is one."""
    replay = algorithm.replay(learner)
    if replay is None:
        return 0
    remembered = replay.items.size // replay.items.shape[-1]
    return size(replay.items) // remembered * algorithm.batch_steps
