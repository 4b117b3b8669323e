"""Playing a policy on fixed episodes of an environment that lives in Python.

Episodes are played some at a time: an intervention that takes words of other episodes takes them from those.
"""

import contextlib
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from gacrl import rollout
from gacrl.envs.environment import TimeStep
from gacrl.envs.hosted import Copies, Hosted
from gacrl.evaluation.metrics import Table, Tally, count_step_if, episode_metrics, measures_of, no_steps, table_of
from gacrl.hosting import Decide, Stage, decider, seeds_from
from gacrl.rollout import Carry, measured
from gacrl.tasks.task import Metric
from gacrl.types import Decision, Intervention, Memory, Policy, PRNGKey

AT_ONCE = 32
"""Copies that are open at a time, at most."""


class Actors(NamedTuple):
    """A policy as the host plays it."""

    policy: Policy
    memory: Memory
    """Its memory at an episode's start, for one environment."""
    intervention: Intervention | None
    decide: Decide
    """Of all three, compiled."""


def actors(env: Hosted, policy: Policy, memory: Memory, intervention: Intervention | None) -> Actors:
    """Compile a policy; its numbers become constants of the program."""
    return Actors(policy, memory, intervention, jax.jit(decider(policy, memory, env.max_cycles, intervention)))


class Moment(NamedTuple):
    """A step of E episodes side by side."""

    decided: Carry
    decision: Decision
    after: TimeStep
    going: Bool[np.ndarray, " E"]
    """Whose episode had not ended before the step."""


def evaluate(
    env: Hosted, playing: Actors, key: PRNGKey, num_episodes: int, metrics: Mapping[str, Metric]
) -> dict[str, Float[np.ndarray, " K"]]:
    """Measure K episodes, as `evaluate.evaluate` has them. Raises Faulty."""
    table = table_of(measures_of(env, ()), metrics)
    count, close = _counting(table)
    played: list[np.ndarray] = []
    for episodes in batches(num_episodes):
        tally = jax.vmap(lambda _: no_steps(table))(jnp.arange(len(episodes)))
        for moment in play(env, playing, key, episodes):
            tally = count(moment.going, tally, moment.after)
        played.append(np.asarray(close(tally)))
    values = np.concatenate(played)[:num_episodes]
    return dict(zip(table.names, values.T, strict=True))


def _counting(table: Table) -> tuple[Callable[..., Tally], Callable[[Tally], Any]]:
    """Programs that count a step of E episodes, and close their tallies."""

    def count(going: Any, tally: Tally, after: TimeStep) -> Tally:
        return jax.vmap(count_step_if)(going, tally, measured(after))

    return jax.jit(count), jax.jit(jax.vmap(partial(episode_metrics, table=table)))


def batches(num_episodes: int) -> Iterator[range]:
    """Return episodes by number, as many each time: a last batch goes beyond the end."""
    count = -(-num_episodes // AT_ONCE)
    size = -(-num_episodes // count)
    return (range(start, start + size) for start in range(0, count * size, size))


def play(
    env: Hosted, playing: Actors, key: PRNGKey, episodes: range, look: Callable[[Copies], None] | None = None
) -> Iterator[Moment]:
    """Play these episodes side by side, step by step, up to the end of the longest.

    An episode has the seed of its number, whichever others are played beside it. look: sees the copies as they begin,
    and after every step.
    """
    start_key, act_key = jax.random.split(key)
    batch_key = jax.random.fold_in(act_key, episodes.start) if episodes.start else act_key
    carry = rollout.start(env, (), playing.memory, start_key, len(episodes), playing.intervention, playing.policy)
    stage = Stage(env, len(episodes), look is not None)
    look = (lambda copies: None) if look is None else look
    with contextlib.closing(stage.copies):
        stage.begin(seeds_from(start_key, episodes.stop)[episodes.start :])
        look(stage.copies)
        going = np.ones(len(episodes), bool)
        for step in range(env.max_cycles):
            carry, decision = playing.decide(stage.carry(carry), stage.left, batch_key, np.int32(step))
            after = stage.step(decision, again=False, going=going)
            look(stage.copies)
            yield Moment(carry, decision, after, going)
            going = going & ~stage.first
            stage.first = np.zeros_like(going)  # an episode that has ended opens no other
            if not going.any():
                break
