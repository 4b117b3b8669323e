"""`traffic_junction`: the Traffic Junction of IC3Net's program, step for step (Singh et al. 2019, after CommNet's).

An episode opens on empty roads. In each step cars drive on or brake; those at the end of their route leave. Then a car
arrives at each entry with some probability: on a random route, in a random free slot, even into a cell that is taken.
Cars that share a cell have crashed: they are punished in each step of it, and drive on.

Two things differ from that program. Route and cell are one-hots of what there is, roads alone: there the route is a
number, and cells of two crossing roads share a place. And a car earns nothing for the step in which it arrives, since
it has not acted; the return counts that step.
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from gacrl.envs.environment import Environment, TimeStep, observe
from gacrl.tasks.traffic.roads import Roads, roads
from gacrl.tasks.traffic.settings import LEVELS, TrafficSettings
from gacrl.types import Observation, PRNGKey

GAS, BRAKE = range(2)
CRASH = -10.0
"""Reward of a car in each step in which it shares its cell."""
DELAY = -0.01
"""Reward of a car in each step, times the steps since it arrived."""
NOBODY = -1


class TrafficParams(NamedTuple):
    """The number of the task that difficulty moves."""

    arrival: Float[Array, ""] | float
    """Probability that a car arrives at an entry in a step."""


class TrafficState(NamedTuple):
    """The cars, a slot each."""

    there: Bool[Array, " N"]
    """Whether a slot holds a car."""
    route: Int[Array, " N"]
    place: Int[Array, " N"]
    """Cells of its route that a car has left behind."""
    age: Int[Array, " N"]
    """Steps since a car arrived."""
    braked: Bool[Array, " N"]
    """The last action that kept a car on the roads; a slot's next car finds it as it was (so does IC3Net's)."""
    crashed: Bool[Array, ""]
    """Whether there was a crash in this episode."""
    clock: Int[Array, ""]
    """Steps taken in this episode."""


@dataclass(frozen=True)
class TrafficJunction(TrafficSettings, Environment):  # pyright: ignore[reportIncompatibleVariableOverride]
    """The task of these settings."""

    num_actions = 2

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "max_cycles", self.steps)

    @property
    def num_agents(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        return LEVELS[self.level].cars

    @property
    def shortest_truncated(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.steps

    @property
    def roads(self) -> Roads:
        return roads(self.level)

    @property
    def observation_size(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Route and cell as one-hots, the last action, and cars counted in the square around."""
        return len(self.roads.routes) + len(self.roads.cells) + 1 + (2 * self.vision + 1) ** 2

    def default_params(self) -> TrafficParams:
        """Return the level's numbers."""
        return TrafficParams(jnp.asarray(LEVELS[self.level].arrival, float))

    def reset(self, key: PRNGKey, params: TrafficParams | None = None) -> tuple[TrafficState, Observation]:
        """Empty the roads."""
        none = jnp.zeros(self.num_agents, jnp.int32)
        state = TrafficState(none > 0, none, none, none, none > 0, jnp.zeros((), bool), jnp.zeros((), jnp.int32))
        return state, self.observe(state)

    def step(
        self, state: TrafficState, action: Int[Array, " N"], key: PRNGKey, params: TrafficParams | None = None
    ) -> tuple[TrafficState, TimeStep]:
        """Let every car drive on or brake, and others arrive."""
        params = self.default_params() if params is None else params
        driven = self.drive(state, action)
        state = self.admit(driven, self.arrivals(driven.there, key, params))
        crashed = self.crashes(state)
        state = state._replace(crashed=state.crashed | crashed.any())
        reward = jnp.where(crashed, CRASH, 0.0) + DELAY * state.age
        info = {
            "reward_raw": reward.mean(),
            "success": 1.0 - state.crashed,
            "crashes": crashed.sum().astype(float),
        }
        # A slot that holds no car between two steps is left again and again: the next car finds an empty memory.
        left, over = ~driven.there, state.clock >= self.steps
        return state, TimeStep(
            self.observe(state), jnp.where(left, 0.0, reward), jnp.zeros((), bool), over, info, left
        )

    def drive(self, state: TrafficState, action: Int[Array, " N"]) -> TrafficState:
        """Return the state after the cars have acted; those that drove off their route's end are gone."""
        place = state.place + (state.there & (action == GAS))
        there = state.there & (place < jnp.asarray(self.roads.lengths)[state.route])
        return state._replace(
            there=there,
            place=jnp.where(there, place, 0),
            age=jnp.where(there, state.age + 1, 0),
            braked=jnp.where(there, action == BRAKE, state.braked),
            clock=state.clock + 1,
        )

    def arrivals(self, there: Bool[Array, " N"], key: PRNGKey, params: TrafficParams) -> Int[Array, " N"]:
        """Draw the route of the car that arrives in each slot, or `NOBODY`.

        there: the slots that are taken. Entries are served in order as long as there are free slots.
        """
        entries, each = self.roads.entries, len(self.roads.routes) // self.roads.entries
        arrive_key, route_key, slot_key = jax.random.split(key, 3)
        arrives = jax.random.bernoulli(arrive_key, params.arrival, (entries,))
        route = jnp.arange(entries) * each + jax.random.randint(route_key, (entries,), 0, each)
        turn = jnp.where(there, jnp.inf, jax.random.uniform(slot_key, there.shape))
        number = (turn[None, :] < turn[:, None]).sum(1)  # the free slots in random order: 0, 1, …
        takes = ~there[:, None] & arrives[None, :] & (number[:, None] == jnp.cumsum(arrives)[None, :] - 1)
        return jnp.where(takes, route[None, :], NOBODY).max(1)

    def admit(self, state: TrafficState, arriving: Int[Array, " N"]) -> TrafficState:
        """Return the state with the cars of these routes at their entries."""
        new = arriving != NOBODY
        return state._replace(there=state.there | new, route=jnp.where(new, arriving, state.route))

    def cell(self, state: TrafficState) -> Int[Array, " N"]:
        """Return the cell of each car, C for an empty slot."""
        routes = jnp.asarray(self.roads.routes)
        return jnp.where(state.there, routes[state.route, state.place], len(self.roads.cells))

    def crashes(self, state: TrafficState) -> Bool[Array, " N"]:
        """Return which cars share their cell."""
        cell = self.cell(state)
        same = (cell[:, None] == cell[None, :]) & state.there[None, :]
        return state.there & (same.sum(1) > 1)

    def observe(self, state: TrafficState) -> Observation:
        """Show each car its route, its cell, its last action, and how many cars are in each cell around (itself
        among them). Features of an empty slot are 0. Who is there hears everyone who is."""
        cells = len(self.roads.cells)
        cell = self.cell(state)
        at = jax.nn.one_hot(cell, cells)
        counts = jnp.pad(at.sum(0), (0, 1))  # nobody is where no road is
        around = jnp.asarray(self.roads.around(self.vision))
        seen = [
            jax.nn.one_hot(state.route, len(self.roads.routes)),
            at,
            state.braked[:, None].astype(float),
            counts[around[jnp.minimum(cell, cells - 1)]],
        ]
        features = jnp.where(state.there[:, None], jnp.concatenate(seen, axis=1), 0.0)
        return observe(features, num_actions=self.num_actions, alive=state.there)
