"""Tiny tasks with known answers: does an algorithm learn what it must be able to learn?

All probes have the same shapes and are told apart by a number in their parameters, so that one compiled
program, mapped over that number, tests them all. There are two agents; the second never sees anything. Each
agent has two actions. The reward is the team's.

`SwitchRiddle` stands apart: a riddle from the literature that takes memory and a word, and minutes to learn.
"""

import math
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
    """Which probe is played."""

    probe: Int[Array, ""] | int = 0
    """Index into `PROBES`."""


class ProbeState(NamedTuple):
    """A probe in an episode."""

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
    shortest_truncated: int = 2

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
        """Show the first agent the sign, where there is something to see, and the clock; the second nothing."""
        blind = _is(params, "value") | _is(params, "discount") | _is(params, "action")
        seen = jnp.where(blind, 0.0, state.sign)
        features = jnp.zeros((self.num_agents, self.observation_size))
        features = features.at[0].set(jnp.stack([seen, state.clock.astype(float)]))
        return observe(features, num_actions=self.num_actions)


def _is(params: ProbeParams, probe: str) -> Bool[Array, ""]:
    return jnp.asarray(params.probe == PROBES.index(probe))


WAIT, TELL = range(2)
NOBODY = -1


class RiddleState(NamedTuple):
    """The riddle on one day."""

    today: Int[Array, ""]
    """Who is in the room."""
    yesterday: Int[Array, ""]
    """Who was there the day before; `NOBODY` on the first day."""
    been: Bool[Array, " N"]
    """Who has been in the room, today included."""
    clock: Int[Array, ""]
    """Days that have passed."""


@dataclass(frozen=True)
class SwitchRiddle(Environment):
    """The riddle of the prisoners and the switch (Foerster et al. 2016): has everyone been in the room?

    Each of 4 N − 6 days a prisoner, drawn anew, is led into a room with nothing in it but a switch. Who is there may
    tell that everyone has been: the team then earns 1 if so and −1 if not, and is done. Nobody sees more than the day,
    and whether it is in the room.

    The switch is the agents' own: who is in the room hears who was there the day before, and no one else. A kind of
    message that is heard a step late (DIAL) so leaves a word in the room; with any other kind yesterday's prisoner
    says it today, from memory. If the switch were the task's, silent agents could use it, and it would take no talk.
    Somebody is in the room every day, so that a word lasts as long as everyone who finds it leaves it again. How much
    a word says is the network's: vocabulary 1 makes a DIAL message the riddle's one bit.
    """

    num_agents: int = 3
    num_actions = 2

    @property
    def max_cycles(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        return 4 * self.num_agents - 6

    @property
    def shortest_truncated(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.max_cycles

    @property
    def observation_size(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        return 1 + self.max_cycles

    @property
    def told(self) -> float:
        """Return what agents earn who know at once when all have been: the probability that it happens in time. One
        bit is enough for it with three agents."""
        n, days = self.num_agents, self.max_cycles
        return sum((-1) ** k * math.comb(n, k) * (1 - k / n) ** days for k in range(n + 1))

    def reset(self, key: PRNGKey, params: tuple[()] = ()) -> tuple[RiddleState, Observation]:
        nobody = jnp.asarray(NOBODY)
        state = RiddleState(nobody, nobody, jnp.zeros(self.num_agents, bool), jnp.asarray(0))
        state = self.enter(state, jax.random.randint(key, (), 0, self.num_agents))
        return state, self.observe(state)

    def step(
        self, state: RiddleState, action: Int[Array, " N"], key: PRNGKey, params: tuple[()] = ()
    ) -> tuple[RiddleState, TimeStep]:
        tells = action[state.today] == TELL
        reward = jnp.where(tells, jnp.where(state.been.all(), 1.0, -1.0), 0.0)
        over = tells | (state.clock + 1 >= self.max_cycles)
        state = self.enter(state, jax.random.randint(key, (), 0, self.num_agents))._replace(clock=state.clock + 1)
        team = jnp.broadcast_to(reward, (self.num_agents,))
        return state, TimeStep(self.observe(state), team, over, jnp.zeros((), bool))

    def enter(self, state: RiddleState, who: Int[Array, ""]) -> RiddleState:
        """Lead another one into the room."""
        return state._replace(today=who, yesterday=state.today, been=state.been.at[who].set(True))

    def observe(self, state: RiddleState) -> Observation:
        """Show everyone the day and who is in the room whether it is. Outside one can but wait."""
        agents = jnp.arange(self.num_agents)
        inside = agents == state.today
        day = jnp.broadcast_to(jax.nn.one_hot(state.clock, self.max_cycles), (self.num_agents, self.max_cycles))
        return observe(
            jnp.concatenate([inside[:, None].astype(float), day], axis=1),
            available=jnp.stack([jnp.ones_like(inside), inside], axis=1),
            adjacency=inside[:, None] & (agents == state.yesterday)[None, :],
        )
