"""What learners minimise, as functions of arrays."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from gacrl.algorithms.shared import mean_real


def clipped_surrogate(
    log_prob: Float[Array, "*b"],
    behaviour_log_prob: Float[Array, "*b"],
    advantage: Float[Array, "*b"],
    clip_eps: Float[Array, ""] | float,
) -> Float[Array, "*b"]:
    """Return PPO's clipped policy objective, to be minimised (Schulman et al. 2017, eq. 7); elementwise."""
    ratio = jnp.exp(log_prob - behaviour_log_prob)
    clipped = jnp.clip(ratio, 1.0 - clip_eps, 1.0 + clip_eps)
    return -jnp.minimum(ratio * advantage, clipped * advantage)


HUBER_DELTA = 10.0
"""Errors of values beyond this count linearly."""


def huber(error: Float[Array, "*b"], delta: float) -> Float[Array, "*b"]:
    """Return ½ e² up to |e| = delta, linear beyond (Huber 1964); elementwise."""
    small = jnp.minimum(jnp.abs(error), delta)
    return 0.5 * jnp.square(small) + delta * (jnp.abs(error) - small)


class ValueNorm(NamedTuple):
    """Running first and second moment of the returns, with the bias of their start taken out (Adam's way)."""

    first: Float[Array, ""]
    second: Float[Array, ""]
    weight: Float[Array, ""]

    @property
    def mean(self) -> Float[Array, ""]:
        """The mean of the returns seen."""
        return self.first / jnp.maximum(self.weight, 1e-5)

    @property
    def sd(self) -> Float[Array, ""]:
        """Their standard deviation, at least .01; 1 before any was seen."""
        variance = self.second / jnp.maximum(self.weight, 1e-5) - jnp.square(self.mean)
        return jnp.where(self.weight > 0, jnp.sqrt(jnp.maximum(variance, 1e-4)), 1.0)

    def normalise(self, values: Float[Array, "*b"]) -> Float[Array, "*b"]:
        """Return values in standard deviations around the mean."""
        return (values - self.mean) / self.sd

    def denormalise(self, values: Float[Array, "*b"]) -> Float[Array, "*b"]:
        """Return normalised values in the unit of the returns."""
        return values * self.sd + self.mean


class RewardNorm(NamedTuple):
    """Give rewards a unit of their own, around 0 where that leaves the optimum as it is."""

    moments: ValueNorm
    ended: Bool[Array, ""]
    """Whether an episode has ended by itself so far, not by its time limit."""

    def normalise(self, reward: Float[Array, "*b"], lives: bool) -> Float[Array, "*b"]:
        """Return rewards in standard deviations around the mean.

        Where episodes end by themselves, or values with the lives of agents inside them (lives), the mean stays, and
        the unit is no less than it. Taken off, it would pay, or fine, every step that an end puts off: where each step
        costs the same, nothing would be left to learn from.
        """
        unit = jnp.maximum(self.moments.sd, jnp.abs(self.moments.mean))
        return jnp.where(self.ended | lives, reward / unit, self.moments.normalise(reward))


def no_rewards() -> RewardNorm:
    """Return what was found of rewards before any was seen: normalising changes nothing."""
    return RewardNorm(no_returns(), jnp.zeros((), bool))


def no_returns() -> ValueNorm:
    """Return the moments before any return was seen: normalising changes nothing."""
    zero = jnp.zeros(())
    return ValueNorm(zero, zero, zero)


def follow_returns(
    norm: ValueNorm, returns: Float[Array, "*b"], real: Bool[Array, "*b"], step: float = 0.01
) -> ValueNorm:
    """Move the moments towards those of the real agents' returns (MAPPO's ValueNorm, with a step that suits short
    runs)."""
    return ValueNorm(
        norm.first + step * (mean_real(returns, real) - norm.first),
        norm.second + step * (mean_real(jnp.square(returns), real) - norm.second),
        norm.weight + step * (1.0 - norm.weight),
    )
