"""The memory that a run takes at the least, counted from shapes alone: nothing is allocated or compiled for it."""

import os
from pathlib import Path
from typing import Any

import jax
from jaxtyping import PyTree

from gacrl.algorithms.contract import Algorithm
from gacrl.config.run import RunConfig
from gacrl.errors import UserError
from gacrl.training.trainer import TrainState
from gacrl.types import Learner

_CGROUP_LIMITS = ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes")


def size(tree: PyTree) -> int:
    """Bytes of arrays, or of their shapes."""
    return sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(tree))


def working_bytes(config: RunConfig, algorithm: Algorithm, member: TrainState) -> int:
    """What a seed's chunk or evaluation holds at once besides its state, at the least.

    member: a seed's training state, or its shapes. Counted are a rollout (every step's observation, before and after),
    the episodes of an evaluation, and the batch of a gradient step; not what XLA puts between them.
    """
    carry = size(member.carry)
    rollout = 2 * carry * config.training.num_steps
    episodes = max(config.evaluation.num_episodes, config.evaluation.final_episodes)
    evaluation = carry // config.training.num_envs * episodes
    return max(rollout, evaluation, _batch_bytes(algorithm, member.learner))


def require_room(needed: int, device: Any) -> None:
    """Raises UserError, with both numbers, for a run that this machine has not the memory for."""
    there = memory_of(device)
    if there is not None and needed > there:
        raise UserError(
            f"this run needs at least {readable(needed)} of memory and {device.platform}:{device.id} has "
            f"{readable(there)}: take fewer seeds, environments or agents, or a smaller replay or network"
        )


def memory_of(device: Any) -> int | None:
    """Bytes of an accelerator's memory, or of the machine's (the container's, where it has less); None: not known."""
    if device.platform != "cpu":
        return (device.memory_stats() or {}).get("bytes_limit")
    try:
        there = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, OSError, ValueError):
        return None
    limits = [Path(path).read_text().strip() for path in _CGROUP_LIMITS if Path(path).is_file()]
    return min([there, *(int(limit) for limit in limits if limit.isdigit())])


def readable(count: int) -> str:
    """Bytes in words: 1.5 GiB."""
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
