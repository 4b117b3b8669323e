"""Policies of `traffic_junction` that learn nothing: `yielder`, which knows everything, and `gas`, which never brakes.

The yielder shows what talk can reach: each car knows where all cars are and where they go, and nothing else. It had no
crash in 20,000 episodes of any level. Silent cars without vision were found to do as `gas` does.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from gacrl.tasks.traffic.environment import BRAKE, GAS, TrafficJunction
from gacrl.types import Actor, Decision, Memory, Observation, PRNGKey


def gas(env: TrafficJunction) -> Actor:
    """Make all cars drive on, whatever happens."""

    def policy(memory: Memory, observation: Observation, key: PRNGKey):
        return Decision(jnp.full(env.num_agents, GAS)), memory

    return Actor(policy, ())


def yielder(env: TrafficJunction) -> Actor:
    """Make cars brake for who is in the junction, then for who has the longer queue behind.

    A car also brakes behind one that does, so that nobody is ever hit. A queue is as long as it is near to its entry,
    where the next car arrives even into a cell that is taken.
    """
    num_routes, nowhere = len(env.roads.routes), len(env.roads.cells)
    routes = jnp.pad(jnp.asarray(env.roads.routes), ((0, 0), (0, 1)), constant_values=nowhere)
    junction = jnp.asarray([*env.roads.junction, False])
    order, places, cells = jnp.arange(env.num_agents), jnp.arange(routes.shape[1]), jnp.arange(nowhere + 1)

    def policy(memory: Memory, observation: Observation, key: PRNGKey):
        seen, there = observation.features, observation.agent_mask
        path = routes[_number(seen[:, :num_routes])]
        cell = jnp.where(there, _number(seen[:, num_routes : num_routes + nowhere]), nowhere)
        place = _number(path == cell[:, None])
        after = jnp.where(there, jnp.take_along_axis(path, place[:, None] + 1, axis=1)[:, 0], nowhere)
        taken = (cell[:, None] == cells[None, :]).any(0)[path]
        free = ~taken & (places[None, :] < place[:, None])
        room = jnp.where(free, places[None, :] + 1, 0).max(1)  # between its queue and its entry
        rank = jnp.where(junction[cell], len(places), -room) * env.num_agents - order
        return Decision(jnp.where(give_way(cell, after, rank, nowhere), BRAKE, GAS)), memory

    return Actor(policy, ())


def _number(one_hot: Array) -> Int[Array, " N"]:
    """Return where the 1 of each row is; 0 in a row without one. (On a CPU an argmax takes several times as long.)"""
    return (one_hot * jnp.arange(one_hot.shape[1])[None, :]).sum(1).astype(int)


def give_way(
    cell: Int[Array, " N"], after: Int[Array, " N"], rank: Int[Array, " N"], nowhere: int
) -> Bool[Array, " N"]:
    """Return who must brake, so that no two cars share a cell after the step.

    cell, after: where each car is, and where it would be. Of several cars that would enter a cell the one of the
    highest rank does, unless a car brakes in it: then none of them.
    """

    def settle(loop: tuple[Array, Array]) -> tuple[Array, Array]:
        brakes, _ = loop
        then = jnp.where(brakes, cell, after)
        same = (then[:, None] == then[None, :]) & (then != nowhere)[None, :]
        first = brakes[None, :] | (rank[None, :] > rank[:, None])
        return brakes | (same & first).any(1), brakes

    nobody = jnp.zeros(cell.shape, bool)
    return jax.lax.while_loop(lambda loop: (loop[0] != loop[1]).any(), settle, (nobody, ~nobody))[0]
