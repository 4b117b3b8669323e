"""How much agents explore: rules that any learner takes, each a function of the learner's settings.

A rule says the level of the moment, random actions and the temperature of messages, and what an episode makes of it.
Another one is a function of this form and a line in `gacrl.config.kinds` (examples/own_exploration.py).
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from gacrl.config.algorithms import LearningConfig
from gacrl.config.checks import require
from gacrl.types import PRNGKey, Transition


def progress_between(
    start: Float[Array, ""] | float, end: Float[Array, ""] | float, fraction: Float[Array, ""]
) -> Float[Array, ""]:
    """Move linearly from start to end while the fraction goes from 0 to 1, and stay at the end."""
    return start + jnp.clip(fraction, 0.0, 1.0) * (end - start)


class Level(NamedTuple):
    """How much to explore now."""

    epsilon: Float[Array, ""] | float
    """Share of random actions."""
    temperature: Float[Array, ""] | float
    """Of the Gumbel-Softmax messages."""


class Exploration(NamedTuple):
    """A rule, as pure functions."""

    init: Callable[[], Any]
    level: Callable[[Any, Int[Array, ""]], Level]
    """(state, env_steps) -> level."""
    follow: Callable[[Any, Transition], Any]
    """(state, the steps of a rollout [T, E, …]) -> state. A decision's extras hold the episode's `mode`."""
    initial_memory: Any
    """What an episode carries before its first step; () where episodes are all alike."""
    begin: Callable[[Any, PRNGKey, Float[Array, ""] | float], tuple[Any, Float[Array, ""] | float]]
    """(what the episode carries, key, ε) -> (the same, settled; the ε of this episode)."""
    moves: bool = True
    """False where the level is always the same: nobody then counts steps for it."""


def in_time(level: Callable[[Int[Array, ""]], Level], moves: bool = True) -> Exploration:
    """Make a rule in which the environment steps alone say how much, whatever happens."""
    return Exploration(
        init=lambda: (),
        level=lambda state, env_steps: level(env_steps),
        follow=lambda state, steps: state,
        initial_memory=(),
        begin=lambda mode, key, epsilon: (mode, epsilon),
        moves=moves,
    )


def none(settings: LearningConfig, planned_steps: int, progress: str | None) -> Exploration:
    """Take no random actions: a policy that is sampled explores by itself. Messages stay at the start's temperature."""
    return in_time(lambda env_steps: Level(0.0, settings.temperature), moves=False)


def linear(settings: LearningConfig, planned_steps: int, progress: str | None) -> Exploration:
    """Let ε and τ fall linearly over `exploration_steps`."""

    def level(env_steps: Int[Array, ""]) -> Level:
        share = env_steps / max(settings.exploration_steps, 1)
        return Level(*(progress_between(start, end, share) for start, end in _ends(settings)))

    return in_time(level)


def fixed(settings: LearningConfig, planned_steps: int, progress: str | None) -> Exploration:
    """Keep ε and τ at their end."""
    return in_time(lambda env_steps: Level(settings.epsilon_end, settings.temperature_end), moves=False)


class Follower(NamedTuple):
    """What adaptive exploration knows: the progress of greedy episodes at their end, a running mean.

    Greedy in their actions: what they say is drawn as in all of training.
    """

    progress: Float[Array, ""]


UNSETTLED, EXPLORING, GREEDY = range(3)
"""What an episode is: settled by its first step."""
_MEMORY = 0.05
"""Weight of an episode in the running mean."""


def adaptive(settings: LearningConfig, planned_steps: int, progress: str | None) -> Exploration:
    """Let ε and τ follow progress c: end + (start − end) (1 − c)², with c from episodes that do not explore.

    The paper's (13) to (16) without the clock, and with a signal that exploration itself does not depress: a
    share of the training episodes is played greedily (their steps count as any others), and c is the running
    mean of the progress at their last step. A task without a measure of progress is explored linearly in time.
    """
    return linear(settings, planned_steps, None) if progress is None else _following(settings, progress)


def yoked(settings: LearningConfig, planned_steps: int, progress: str | None) -> Exploration:
    """Follow the progress of another training, at even spaces over `planned_steps`: its levels without the feedback.

    The share of greedy episodes stays, so that nothing else differs. Raises ConfigError where there is none to follow.
    """
    recorded = settings.yoked_progress
    require(
        len(recorded) > 0,
        "algorithm.exploration yoked needs the progress to follow, in algorithm.yoked_progress",
    )
    return _following(settings, progress, recorded, planned_steps)


def _following(
    settings: LearningConfig, measure: str | None, recorded: tuple[float, ...] = (), planned_steps: int = 1
) -> Exploration:
    """measure: a name in the steps' measurements. recorded: what is followed in its place."""

    def level(state: Follower, env_steps: Int[Array, ""]) -> Level:
        progress = state.progress
        if recorded:
            stretch = env_steps // -(-planned_steps // len(recorded))
            progress = jnp.asarray(recorded)[jnp.minimum(stretch, len(recorded) - 1)]
        missing = jnp.square(1.0 - progress)
        return Level(*(end + (start - end) * missing for start, end in _ends(settings)))

    def follow(state: Follower, steps: Transition) -> Follower:
        if measure is None:
            return state
        ended = (steps.terminated | steps.truncated) & (steps.decision.extras["mode"] == GREEDY)
        reached = jnp.where(ended, steps.info[measure], 0.0).sum() / jnp.maximum(ended.sum(), 1)
        weight = 1.0 - (1.0 - _MEMORY) ** ended.sum()
        return Follower(state.progress + weight * (reached - state.progress))

    def begin(
        mode: Int[Array, ""], key: PRNGKey, epsilon: Float[Array, ""] | float
    ) -> tuple[Int[Array, ""], Float[Array, ""]]:
        drawn = jnp.where(jax.random.bernoulli(key, settings.greedy_share), GREEDY, EXPLORING)
        mode = jnp.where(mode == UNSETTLED, drawn, mode)
        return mode, jnp.where(mode == GREEDY, 0.0, epsilon)

    return Exploration(lambda: Follower(jnp.zeros(())), level, follow, jnp.asarray(UNSETTLED), begin)


def _ends(settings: LearningConfig) -> tuple[tuple[float, float], tuple[float, float]]:
    """Start and end of ε, and of τ."""
    return (settings.epsilon, settings.epsilon_end), (settings.temperature, settings.temperature_end)
