"""Numbers that are no longer finite: seen at the end of every chunk, and traced to the first bad update."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gacrl.algorithms.replay import Replay
from gacrl.errors import Faulty, UserError
from gacrl.types import Learner


class Diverged(UserError):
    """A loss, or something that is learned, is no longer a finite number."""


def not_finite(
    seeds: Sequence[int],
    updates: Sequence[Mapping[str, Any]],
    learners: Learner,
    replay: Replay[Any] | None = None,
) -> Iterator[tuple[int, str, str]]:
    """Return the seed, name and value of whatever is NaN or infinite: what the updates told of each seed, then its
    learner.

    learners: stacked over the seeds; gradients show in the optimiser's moments. replay: the part of them that
    remembers, which is not looked at: it is most of a learner, and what is wrong there shows in the loss.
    """
    remembered = {id(leaf) for leaf in jax.tree.leaves(replay)}
    for seed, metrics in zip(seeds, updates, strict=True):
        yield from ((seed, name, str(value)) for name, value in metrics.items() if not np.isfinite(value))
    for path, leaf in jax.tree_util.tree_leaves_with_path(learners):
        name = jax.tree_util.keystr(path).lstrip(".")
        if id(leaf) in remembered or not jnp.issubdtype(leaf.dtype, jnp.inexact):
            continue
        values = np.asarray(leaf)
        if np.isfinite(values).all():
            continue
        for seed, member in zip(seeds, values, strict=False):  # a last one may be repeated, as padding
            bad = member[~np.isfinite(member)]
            if bad.size:
                yield seed, name, f"{bad[0]} in {bad.size} of {member.size} places"


def require_sound_task(seeds: Sequence[int], task: str, fault: Any) -> None:
    """Raise Faulty with the first number of the task that was not finite. fault: as in a chunk's report, [S]."""
    if fault is None:
        return
    for seed, step, agent, reward in zip(seeds, *map(np.asarray, fault), strict=False):
        if step:
            what = "got a reward" if reward else "saw a number"
            raise Faulty(
                f"agent {agent} of {task} {what} that is not finite, in step {step} of an environment (seed {seed}): "
                "mend the task"
            )


def require_finite(
    seeds: Sequence[int],
    updates: Sequence[Mapping[str, Any]],
    learners: Learner,
    replay: Replay[Any] | None,
    before: int,
    after: int,
) -> None:
    """Raise Diverged with the first quantity that is not finite.

    before, after: the environment steps between which it happened.
    """
    for seed, name, value in not_finite(seeds, updates, learners, replay):
        raise Diverged(
            f"seed {seed} diverged between environment steps {before} and {after}: {name} is {value}; "
            "try a smaller learning rate"
        )
