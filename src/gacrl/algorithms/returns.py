"""Targets for critics. Episodes end in two ways, which stay apart: after `terminated` there is nothing, after
`truncated` (the time limit) the task would have gone on, so its value is bootstrapped, in the same way everywhere.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int


def next_values(
    value: Float[Array, "T *b"],
    truncated: Bool[Array, " T"],
    shortest: int,
    anew: Callable[[Int[Array, " K"]], Float[Array, "K *b"]],
) -> Float[Array, "T *b"]:
    """Return the value of what followed each of T steps of one environment, from the value of each step's own
    observation.

    What followed is the next step's, and known, except where an episode was truncated, after which that is a new
    episode's, and at the end: only there `anew` computes it, given the steps. Room is made for as many truncations as
    there can be, `shortest` steps apart; where any step may be one, all values are computed. After `terminated` the
    value means nothing.
    """
    steps = truncated.shape[0]
    if shortest == 1:
        return anew(jnp.arange(steps))
    broken = truncated.at[-1].set(True)
    at = jnp.nonzero(broken, size=min(-(-steps // shortest) + 1, steps), fill_value=steps - 1)[0]
    stand_in = jnp.where(broken.reshape(-1, *[1] * (value.ndim - 1)), value, jnp.roll(value, -1, axis=0))
    return stand_in.at[at].set(anew(at))


def generalised_advantages(
    reward: Float[Array, "T *b"],
    value: Float[Array, "T *b"],
    next_value: Float[Array, "T *b"],
    terminated: Bool[Array, "T *b"],
    truncated: Bool[Array, "T *b"],
    gamma: Float[Array, ""] | float,
    gae_lambda: Float[Array, ""] | float,
) -> Float[Array, "T *b"]:
    """Return advantages (Schulman et al. 2016, eq. 16): Σ_k (γλ)^k δ_{t+k}, δ_t = r_t + γ V(s'_t) − V(s_t).

    next_value: of the observation that followed, before any reset. The sum stops where an episode ends.
    """
    delta = reward + gamma * jnp.where(terminated, 0.0, next_value) - value
    going_on = ~(terminated | truncated)

    def step(later: Float[Array, "*b"], now: tuple[Float[Array, "*b"], Bool[Array, "*b"]]):
        delta, going_on = now
        advantage = delta + gamma * gae_lambda * jnp.where(going_on, later, 0.0)
        return advantage, advantage

    return jax.lax.scan(step, jnp.zeros_like(delta[0]), (delta, going_on), reverse=True)[1]


def n_step_returns(
    reward: Float[Array, "T *b"],
    next_value: Float[Array, "T *b"],
    terminated: Bool[Array, "T *b"],
    truncated: Bool[Array, "T *b"],
    gamma: Float[Array, ""] | float,
    n: int,
) -> Float[Array, "T *b"]:
    """Return r_t + γ r_{t+1} + … + γ^m V(s'_{t+m−1}): m is n, or less where episode or T steps end before."""
    weight, last = n_step_window(terminated | truncated, n)
    time = jnp.arange(reward.shape[0]).reshape(-1, *[1] * (reward.ndim - 1))
    total = jnp.zeros_like(reward)
    for k in range(n):
        later = jnp.minimum(time + k, reward.shape[0] - 1)
        total += gamma**k * weight[k] * jnp.take_along_axis(reward, later + jnp.zeros_like(last), axis=0)
    bootstrap = jnp.where(terminated, 0.0, next_value)
    steps = last - time + 1
    return total + gamma**steps * jnp.take_along_axis(bootstrap, last, axis=0)


def n_step_window(done: Bool[Array, "T *b"], n: int) -> tuple[Float[Array, "n T *b"], Int[Array, "T *b"]]:
    """Return which of the n steps from each t on belong to its return (1 or 0), and the index of the last that does."""
    length = done.shape[0]
    time = jnp.broadcast_to(jnp.arange(length).reshape(-1, *[1] * (done.ndim - 1)), done.shape)
    ahead = jnp.pad(done, [(0, n), *[(0, 0)] * (done.ndim - 1)])
    alive, last, weights = jnp.ones(done.shape, bool), time, []
    for k in range(n):
        alive &= time + k < length
        weights.append(alive.astype(float))
        last = jnp.where(alive, time + k, last)
        alive &= ~ahead[k : k + length]
    return jnp.stack(weights), last
