"""Which agent should go to which landmark: minimum-cost assignment inside a compiled program.

Two exact methods, chosen while tracing, from the shapes:

* Up to `_MAX_PERMUTATIONS` candidates (teams of five), all of them are compared: no loop, so that it costs
  next to nothing in an environment step.
* Above, shortest augmenting paths (Jonker & Volgenant 1987, without their initial heuristics; in the form of
  Crouse 2016, which scipy also follows). Agents enter one by one; each takes the cheapest chain of
  reassignments that ends at a free landmark, found by Dijkstra's algorithm on reduced costs.
  O(N^2 L) at worst, about N^1.5 L on random points.

The auction algorithm (Bertsekas 1988) suits parallel machines better on paper. With epsilon scaling and every
agent bidding at once, each of its rounds reads the whole [N, L] matrix, where a path step reads one row; on a
CPU it measured 30 (10 agents) to over 100 times slower (100 and more), for a nearly optimal answer.

The methods see R rows and C columns: agents and landmarks, or the other way round, such that R <= C.
"""

import itertools
import math
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

_MAX_PERMUTATIONS = 120


def assign(cost: Float[Array, "N L"]) -> Int[Array, " N"]:
    """Choose the landmark of each agent, such that the total cost is as small as possible.

    cost: [N, L], any unit and sign. Returns the landmark's index [N], int32. With N <= L every agent gets a
    landmark of its own; with N > L each landmark gets one agent and the other agents get -1.

    A pair whose cost is not finite (inf, -inf, NaN) is forbidden: it is used only where no complete
    assignment avoids it, and then as seldom as possible. Padded agents and landmarks can be masked that way.

    Optimal up to the rounding of sums in the precision of cost; which of several equally good answers is
    returned is not specified. Works under jit and vmap; no gradient flows back into cost.

    Raises ValueError if there is no agent or no landmark.
    """
    if cost.ndim != 2 or 0 in cost.shape:
        raise ValueError(f"cost must be [N, L] with N, L >= 1, not of shape {cost.shape}")
    cost = _normalise(lax.stop_gradient(cost))
    num_agents, num_landmarks = cost.shape
    few, many = sorted(cost.shape)
    solve = _try_all if math.perm(many, few) <= _MAX_PERMUTATIONS else _shortest_augmenting_paths
    if num_agents <= num_landmarks:
        return solve(cost)
    agent_of_landmark = solve(cost.T)
    return _inverse(agent_of_landmark, size=num_agents, missing=-1)


def _normalise(cost: Float[Array, "N L"]) -> Float[Array, "N L"]:
    """Maps finite costs into [0, 2] and the others to a value that no set of finite ones can outweigh.

    Neither changes which assignment is best. Huge costs then cannot overflow when they are added up.
    """
    allowed = jnp.isfinite(cost)
    cost = jnp.where(allowed, cost, 0.0)
    largest = jnp.abs(cost).max()
    # Twice the root, because 1 / largest may be subnormal, which XLA takes for 0.
    scale = lax.rsqrt(jnp.where(largest > 0.0, largest, 1.0))
    cost = cost * scale * scale
    return jnp.where(allowed, cost - cost.min(), 2.0 * min(cost.shape) + 1.0)


def _inverse(mapping: Int[Array, " I"], size: int, missing: int) -> Int[Array, " J"]:
    """The i with mapping[i] = j, for each j below size; missing where there is none."""
    sources = jnp.arange(mapping.shape[0], dtype=jnp.int32)
    return jnp.full(size, missing, jnp.int32).at[mapping].set(sources, mode="drop")


def _try_all(cost: Float[Array, "R C"]) -> Int[Array, " R"]:
    """Column of each row, R <= C, by comparing every injective choice."""
    rows, columns = cost.shape
    choices = np.array(list(itertools.permutations(range(columns), rows)), np.int32)  # [P, R]
    totals = cost[np.arange(rows)[None, :], choices].sum(axis=-1)
    return jnp.asarray(choices)[totals.argmin()]


class _Search(NamedTuple):
    """Dijkstra's algorithm from one new row over the columns, C of them."""

    column: Int[Array, ""]  # reached last; -1 before the first
    distance: Float[Array, " C"]  # reduced cost of the best known chain to each column
    parent: Int[Array, " C"]  # the column before it on that chain; -1: the new row itself
    reached: Bool[Array, " C"]


def _shortest_augmenting_paths(cost: Float[Array, "R C"]) -> Int[Array, " R"]:
    """Column of each row, R <= C, by R searches for a cheapest chain of reassignments.

    Between searches, every owned column is the cheapest for its owner at cost + price, and a column without
    owner has price 0 (complementary slackness): the assignment is optimal for the rows entered so far.
    """
    rows, columns = cost.shape
    free = rows  # as owner of a column; out of bounds, so that _inverse drops it

    def enter(state: tuple[Int[Array, " C"], Float[Array, " C"]], row: Int[Array, ""]):
        owner, price = state
        search = _cheapest_chain(cost, row, owner, price, free)
        # The dual update: columns reached before the free end become dearer, until the chain is tight.
        increase = search.distance[search.column] - search.distance
        price = price + jnp.where(search.reached, increase, 0.0)
        return (_reassign(owner, search, row), price), None

    nobody = jnp.full(columns, free, jnp.int32)
    no_price = jnp.zeros(columns, cost.dtype)
    (owner, _), _ = lax.scan(enter, (nobody, no_price), jnp.arange(rows, dtype=jnp.int32))
    return _inverse(owner, size=rows, missing=0)


def _cheapest_chain(
    cost: Float[Array, "R C"],
    row: Int[Array, ""],
    owner: Int[Array, " C"],
    price: Float[Array, " C"],
    free: int,
) -> _Search:
    """Reaches columns in order of distance, until one is free. Every step reaches a new one, so it ends."""
    num_columns = cost.shape[1]
    columns = jnp.arange(num_columns, dtype=jnp.int32)
    # Among equally near columns a free one goes first: it ends the search, which ties would draw out.
    rank = jnp.where(owner == free, columns, columns + num_columns)

    def owned(search: _Search) -> Bool[Array, ""]:
        return (search.column < 0) | (owner[search.column] != free)

    def step(search: _Search) -> _Search:
        start = search.column < 0
        reduced = cost[jnp.where(start, row, owner[search.column])] + price
        offset = jnp.where(start, 0.0, search.distance[search.column] - reduced[search.column])
        through = offset + reduced
        shorter = ~search.reached & (through < search.distance)
        distance = jnp.where(shorter, through, search.distance)
        parent = jnp.where(shorter, search.column, search.parent)
        # Two plain minima: XLA's argmin is not vectorised on CPUs and made the whole half as fast.
        open_distance = jnp.where(search.reached, jnp.inf, distance)
        is_nearest = open_distance == open_distance.min()
        nearest = jnp.where(is_nearest, rank, 2 * num_columns - 1).min() % num_columns
        return _Search(nearest, distance, parent, search.reached | (columns == nearest))

    nothing = _Search(
        column=jnp.int32(-1),
        distance=jnp.full_like(price, jnp.inf),
        parent=jnp.full_like(columns, -1),
        reached=jnp.zeros_like(columns, bool),
    )
    return lax.while_loop(owned, step, nothing)


def _reassign(owner: Int[Array, " C"], search: _Search, row: Int[Array, ""]) -> Int[Array, " C"]:
    """Walks the chain back from its free end: each column's owner moves on, and row takes the first."""
    columns = jnp.arange(owner.shape[0], dtype=jnp.int32)

    def move(state: tuple[Int[Array, " C"], Int[Array, ""]]):
        owner, column = state
        before = search.parent[column]
        mover = jnp.where(before < 0, row, owner[before])
        return jnp.where(columns == column, mover, owner), before

    # A select instead of a scatter: batched scatters are slow on CPUs.
    owner, _ = lax.while_loop(lambda state: state[1] >= 0, move, (owner, search.column))
    return owner
