"""Distributions that a policy's actions are drawn from, made of the numbers of its head.

A learner is given one and asks nothing else about actions: another one is a function that makes this record.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from gacrl.algorithms.actions import ActionSet, choices
from gacrl.algorithms.shared import taken
from gacrl.envs.environment import Environment

LOG_STD_RANGE = (-5.0, 2.0)
"""Bounds of a Gaussian's log standard deviation, in half widths of the task's range."""


class Distribution(NamedTuple):
    """A family of distributions over what agents do, as pure functions.

    `pi` is one of the family, whatever `of` made.
    """

    actions: ActionSet
    """What is drawn, and what the task takes for it; its size is that of the head."""
    of: Callable[[Float[Array, "*b A"], Bool[Array, "*b A"]], Any]
    """(head, what is available) -> pi."""
    mixed: Callable[[Any, Any], Any]
    """(pi, ε) -> pi with a share ε of random actions."""
    sample: Callable[[Any, Key[Array, ""]], Array]
    mode: Callable[[Any], Array]
    """The most likely action."""
    log_prob: Callable[[Any, Array], Float[Array, "*b"]]
    entropy: Callable[[Any], Float[Array, "*b"]]
    """In nats."""


def distribution(env: Environment) -> Distribution:
    """Return the family that fits the task: a Gaussian where actions are continuous."""
    return gaussian(env) if env.continuous_actions else categorical(choices(env))


# Among a set of actions.


def categorical(actions: ActionSet) -> Distribution:
    """Make the distributions over a set; pi is log π [*b A]."""
    return Distribution(
        actions=actions,
        of=log_policy,
        mixed=mixed,
        sample=lambda pi, key: jax.random.categorical(key, pi),
        mode=lambda pi: pi.argmax(-1),
        log_prob=taken,
        entropy=entropy,
    )


def log_policy(logits: Float[Array, "*b A"], action_mask: Bool[Array, "*b A"]) -> Float[Array, "*b A"]:
    """Return log π; −∞ for actions that are not available."""
    return jax.nn.log_softmax(jnp.where(action_mask, logits, -jnp.inf))


def explores(epsilon: Float[Array, "..."] | float) -> bool:
    """Return whether there may be random actions: False for a plain 0, which costs nothing."""
    return not (isinstance(epsilon, float) and epsilon == 0.0)


def mixed(log_probs: Float[Array, "*b A"], epsilon: Float[Array, "*#b"] | float | None) -> Float[Array, "*b A"]:
    """Return what is acted by: (1 − ε) π + ε · uniform over the available actions; π itself for no ε."""
    if epsilon is None or not explores(epsilon):
        return log_probs
    available = log_probs > -jnp.inf
    uniform = available / available.sum(-1, keepdims=True)
    share = jnp.asarray(epsilon)
    share = share[..., None] if share.ndim else share
    probs = jnp.where(available, jnp.exp(jnp.where(available, log_probs, 0.0)), 1.0)  # finite gradients everywhere
    return jnp.where(available, jnp.log((1.0 - share) * probs + share * uniform), -jnp.inf)


def entropy(log_probs: Float[Array, "*b A"]) -> Float[Array, "*b"]:
    """Return the entropy of categorical distributions, in nats; actions with probability 0 count nothing."""
    probs = jnp.exp(log_probs)
    return -(probs * jnp.where(probs > 0, log_probs, 0.0)).sum(-1)


# In a box.


class Normal(NamedTuple):
    """Independent normal distributions, one for each number of an action, from −1 to 1 where the task takes 0 to 1."""

    mean: Float[Array, "*b A"]
    log_std: Float[Array, "*b A"]
    there: Bool[Array, "*b A"]
    """Numbers that the agent's action has; the others count nothing."""


def gaussian(env: Environment) -> Distribution:
    """Make diagonal Gaussians over continuous actions, clipped to the task's range as they are handed to it.

    The probability is that of the number drawn, before the clipping, as in Schulman et al. 2017.
    """
    size = env.num_actions

    def turn(drawn: Float[Array, "*b A"], symmetry: Int[Array, ""]) -> Float[Array, "*b A"]:
        return 2.0 * env.turn_action(0.5 + 0.5 * drawn, symmetry) - 1.0

    return Distribution(
        actions=ActionSet(
            size=2 * size,
            act=lambda drawn: jnp.clip(0.5 + 0.5 * drawn, 0.0, 1.0),
            turn=turn,
            mask=lambda mask: mask,
        ),
        of=lambda head, there: Normal(head[..., :size], jnp.clip(head[..., size:], *LOG_STD_RANGE), there),
        mixed=lambda pi, epsilon: pi,
        sample=lambda pi, key: pi.mean + jnp.exp(pi.log_std) * jax.random.normal(key, pi.mean.shape),
        mode=lambda pi: pi.mean,
        log_prob=normal_log_prob,
        entropy=normal_entropy,
    )


def normal_log_prob(pi: Normal, drawn: Float[Array, "*b A"]) -> Float[Array, "*b"]:
    """Return log N(drawn; mean, std), summed over the numbers of an action."""
    scaled = (drawn - pi.mean) * jnp.exp(-pi.log_std)
    each = -0.5 * jnp.square(scaled) - pi.log_std - 0.5 * math.log(2 * math.pi)
    return jnp.where(pi.there, each, 0.0).sum(-1)


def normal_entropy(pi: Normal) -> Float[Array, "*b"]:
    """Return ½ log(2πe) + log std, summed over the numbers of an action."""
    return jnp.where(pi.there, pi.log_std + 0.5 * math.log(2 * math.pi * math.e), 0.0).sum(-1)
