"""A task of your own, in one file: two agents, and only by talking can it be solved.

    gacrl train --env examples/own_task.py:Beacon
    gacrl evaluate runs/gacrl-1 --env examples/own_task.py:Beacon

The first agent sees a beacon on a line and cannot move; the second must go there and sees only where it stands.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp

from gacrl import Environment, TimeStep, observe

STAY, LEFT, RIGHT = range(3)


@dataclass(frozen=True)
class Beacon(Environment):
    """The second agent must go to a beacon on a line that only the first one sees."""

    places: int = 5
    """Places on the line."""
    max_cycles: int = 6
    """Steps of an episode."""

    num_agents = 2
    num_actions = 3

    @property
    def observation_size(self):
        return self.places + 2  # a place, and who one is

    def reset(self, key, params=()):
        beacon = jax.random.randint(key, (), 0, self.places)
        state = {"beacon": beacon, "mover": jnp.asarray(self.places // 2), "clock": jnp.asarray(0)}
        return state, self.look(state)

    def step(self, state, action, key, params=()):
        move = (action[1] == RIGHT).astype(int) - (action[1] == LEFT)
        mover = jnp.clip(state["mover"] + move, 0, self.places - 1)
        state = {**state, "mover": mover, "clock": state["clock"] + 1}
        there = (mover == state["beacon"]).astype(float)
        over = state["clock"] >= self.max_cycles
        info = {"found": there}  # measured in every run, beside the return
        return state, TimeStep(self.look(state), jnp.full(2, there), jnp.asarray(False), over, info)

    def look(self, state):
        seen = jax.nn.one_hot(jnp.stack([state["beacon"], state["mover"]]), self.places)
        cannot_move = jnp.array([[True, False, False], [True, True, True]])
        return observe(jnp.concatenate([seen, jnp.eye(2)], axis=1), available=cannot_move)
