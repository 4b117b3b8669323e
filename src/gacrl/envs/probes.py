"""Tiny tasks with known answers: does an algorithm learn what it must be able to learn?

All probes have the same shapes and are told apart by a number in their parameters, so that one compiled
program, mapped over that number, tests them all. There are two agents; the second never sees anything. Each
agent has two actions. The reward is the team's.
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from gacrl.envs.environment import Environment, TimeStep, observe
from gacrl.types import Observation, PRNGKey

PROBES = ("value", "observation", "discount", "action", "both", "message", "late_message")
"""In this order: a constant reward to predict; one that the observation tells; one that comes a step later;
one that the first agent's action brings; one that it brings by matching the observation; one that the second
agent must match to what only the first one sees, at once; and the same at a second step, where what is heard a
step after it was said is in time, too."""

BEST_RETURN = {"action": 1.0, "both": 1.0, "message": 1.0, "late_message": 1.0}
"""What acting well brings, in the probes in which acting matters; acting at random brings 0."""


class ProbeParams(NamedTuple):
    probe: Int[Array, ""] | int = 0
    """Index into `PROBES`."""


class ProbeState(NamedTuple):
    sign: Float[Array, ""]
    """−1 or 1: what the first agent may see, and what is to be matched."""
    clock: Int[Array, ""]


@dataclass(frozen=True)
class Probe(Environment):
    """All the probes; `probe` names the one that the default parameters select."""

    probe: str = "value"
    num_agents: int = 2
    num_actions: int = 2
    observation_size: int = 2
    max_cycles: int = 2
    continuous_actions: bool = False

    def default_params(self) -> ProbeParams:
        return ProbeParams(jnp.asarray(PROBES.index(self.probe)))

    def reset(self, key: PRNGKey, params: ProbeParams | None = None) -> tuple[ProbeState, Observation]:
        params = self.default_params() if params is None else params
        sign = jnp.where(jax.random.bernoulli(key), 1.0, -1.0)
        state = ProbeState(sign, jnp.zeros((), jnp.int32))
        return state, self.observe(state, params)

    def step(
        self, state: ProbeState, action: Int[Array, " N"], key: PRNGKey, params: ProbeParams | None = None
    ) -> tuple[ProbeState, TimeStep]:
        params = self.default_params() if params is None else params
        choice = 2.0 * action - 1.0  # the two actions, as −1 and 1
        two_steps = _is(params, "discount") | _is(params, "late_message")
        last = (state.clock == 1) | jnp.logical_not(two_steps)
        reward = jnp.stack(
            [
                jnp.ones(()),
                state.sign,
                last.astype(float),
                choice[0],
                choice[0] * state.sign,
                choice[1] * state.sign,
                choice[1] * state.sign * last,
            ]
        )[params.probe]
        state = state._replace(clock=state.clock + 1)
        team = jnp.broadcast_to(reward, (self.num_agents,))
        return state, TimeStep(
            self.observe(state, params), team, last, jnp.zeros((), bool), {"reward_raw": reward}
        )

    def observe(self, state: ProbeState, params: ProbeParams) -> Observation:
        """The first agent sees the sign, where there is something to see, and the clock; the second nothing."""
        blind = _is(params, "value") | _is(params, "discount") | _is(params, "action")
        seen = jnp.where(blind, 0.0, state.sign)
        features = jnp.zeros((self.num_agents, self.observation_size))
        features = features.at[0].set(jnp.stack([seen, state.clock.astype(float)]))
        return observe(features, num_actions=self.num_actions)


def _is(params: ProbeParams, probe: str) -> Bool[Array, ""]:
    return jnp.asarray(params.probe == PROBES.index(probe))
