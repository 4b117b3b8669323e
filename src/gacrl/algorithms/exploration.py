"""How much agents explore: linearly less, or less where much is covered."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from gacrl.types import PRNGKey, Transition


def progress_between(
    start: Float[Array, ""] | float, end: Float[Array, ""] | float, fraction: Float[Array, ""]
) -> Float[Array, ""]:
    """Linear from start to end while the fraction goes from 0 to 1; the end after it."""
    return start + jnp.clip(fraction, 0.0, 1.0) * (end - start)


class Level(NamedTuple):
    """How much to explore now."""

    epsilon: Float[Array, ""]
    """Share of random actions."""
    temperature: Float[Array, ""]
    """Of the Gumbel-Softmax messages."""


class Exploration(NamedTuple):
    """An exploration rule of a learner from replay, as pure functions."""

    init: Callable[[], Any]
    level: Callable[[Any, Int[Array, ""]], Level]
    """(state, env_steps) -> level."""
    follow: Callable[[Any, Transition], Any]
    """(state, the steps of a rollout [T, E, …]) -> state."""
    initial_memory: Any
    """What an episode carries before its first step; () where episodes are all alike."""
    begin: Callable[[Any, PRNGKey, Float[Array, ""]], tuple[Any, Float[Array, ""]]]
    """(what the episode carries, key, ε) -> (the same, settled; the ε of this episode)."""


def linear(epsilon: tuple[float, float], steps: int, temperature: tuple[float, float] = (1.0, 1.0)) -> Exploration:
    """ε and τ fall linearly over the environment steps, whatever happens."""

    def level(state: Any, env_steps: Int[Array, ""]) -> Level:
        progress = env_steps / max(steps, 1)
        return Level(progress_between(*epsilon, progress), progress_between(*temperature, progress))

    return Exploration(
        init=lambda: (),
        level=level,
        follow=lambda state, steps: state,
        initial_memory=(),
        begin=lambda mode, key, epsilon: (mode, epsilon),
    )


class Follower(NamedTuple):
    """What adaptive exploration knows: how much greedy episodes covered at their end, a running mean.

    Greedy in their actions: what they say is drawn as in all of training.
    """

    coverage: Float[Array, ""]


UNSETTLED, EXPLORING, GREEDY = range(3)
"""What an episode is: settled by its first step."""


def adaptive(
    epsilon: tuple[float, float],
    temperature: tuple[float, float],
    greedy_share: float,
    measure: str,
    recorded: Sequence[float] = (),
    planned_steps: int = 1,
    memory: float = 0.05,
) -> Exploration:
    """ε and τ follow coverage c: end + (start − end) (1 − c)², with c from episodes that do not explore.

    The paper's (13) to (16) without the clock, and with a signal that exploration itself does not depress: a
    share of the training episodes is played greedily (their steps count as any others), and c is the running
    mean of what they cover at their last step.

    measure: the name of the coverage among the task's measurements; a task that does not measure it is explored
    as if nothing were covered.
    recorded: c of another training, at even spaces over `planned_steps`, to be followed in place of this one's: the
    same levels without the feedback (yoked). The share of greedy episodes stays, so that nothing else differs.
    """

    def level(state: Follower, env_steps: Int[Array, ""]) -> Level:
        coverage = state.coverage
        if recorded:
            stretch = env_steps // -(-planned_steps // len(recorded))
            coverage = jnp.asarray(recorded)[jnp.minimum(stretch, len(recorded) - 1)]
        missing = jnp.square(1.0 - coverage)
        return Level(*(end + (start - end) * missing for start, end in (epsilon, temperature)))

    def follow(state: Follower, steps: Transition) -> Follower:
        if measure not in steps.info:
            return state
        ended = (steps.terminated | steps.truncated) & (steps.decision.extras["mode"] == GREEDY)
        covered = jnp.where(ended, steps.info[measure], 0.0).sum() / jnp.maximum(ended.sum(), 1)
        weight = 1.0 - (1.0 - memory) ** ended.sum()
        return Follower(state.coverage + weight * (covered - state.coverage))

    def begin(
        mode: Int[Array, ""], key: PRNGKey, epsilon: Float[Array, ""]
    ) -> tuple[Int[Array, ""], Float[Array, ""]]:
        drawn = jnp.where(jax.random.bernoulli(key, greedy_share), GREEDY, EXPLORING)
        mode = jnp.where(mode == UNSETTLED, drawn, mode)
        return mode, jnp.where(mode == GREEDY, 0.0, epsilon)

    return Exploration(lambda: Follower(jnp.zeros(())), level, follow, jnp.asarray(UNSETTLED), begin)
