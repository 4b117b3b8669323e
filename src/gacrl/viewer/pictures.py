"""A moment as plain data for a page: where everything is, what is said and heard, and what is done."""

from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from gacrl.evaluation.episodes import said_symbols
from gacrl.scene import Discs
from gacrl.viewer.rooms import Decided, Meddling


def picture(
    decided: Decided, count: int, meddling: Meddling | None, nearest: int | None, size: float
) -> dict[str, Any]:
    """Write down what was decided in one environment, on the host: the first `count` agents are there.

    nearest: so many neighbours an agent listens to at the most. size: the radius of agents without one.
    """
    scene, graph = decided.scene, decided.adjacency
    places = np.asarray(scene.agents.positions)[:count]
    said = _symbols(decided.messages, count)
    arrived = said if meddling is None else _arriving(said, meddling, count)
    hears = None if graph is None else _heard(np.asarray(graph)[:count, :count], places, nearest)
    actions = np.asarray(decided.action)[:count]
    return {
        "agents": _discs(scene.agents, count, size),
        "marks": _discs(scene.marks, len(scene.marks.radius)),
        "lines": _rounded(scene.lines).reshape(-1, 4).tolist(),
        "ground": _rounded(scene.ground).ravel().tolist(),
        "said": said.tolist(),
        "arrived": arrived.tolist(),
        "hears": [[] for _ in range(count)] if hears is None or not len(said) else hears,
        "actions": actions.tolist() if actions.ndim == 1 else None,
    }


def _symbols(messages: Any, count: int) -> Int[np.ndarray, "R N"]:
    """Return the symbol of each message; −1 for one that says nothing or is not made of symbols."""
    if messages is None:
        return np.zeros((0, count), int)
    return said_symbols(np.asarray(messages))[:, :count]


def _arriving(said: Int[np.ndarray, "R N"], meddling: Meddling, count: int) -> Int[np.ndarray, "R N"]:
    """Return the symbols that are heard in place of the said ones."""
    other = np.asarray(meddling.other)[:count]
    swapped = said[:, np.minimum(other, count - 1)]
    return np.where(np.asarray(meddling.replaced)[:, :count], _symbols(meddling.values, count), swapped)


def _heard(
    graph: Bool[np.ndarray, "N N"], places: Float[np.ndarray, "N 2"], nearest: int | None
) -> list[list[int]]:
    """Return whom each agent hears: its nearest ones, where it listens to so many."""
    if nearest is not None and nearest < graph.shape[0]:
        squared = np.square(places[None] - places[:, None]).sum(-1)
        squared[~graph] = np.inf
        order = np.argpartition(squared, nearest, axis=1)[:, :nearest]
        listens = np.zeros_like(graph)
        np.put_along_axis(listens, order, True, axis=1)
        graph = graph & listens
    return [np.flatnonzero(row).tolist() for row in graph]


def _discs(discs: Discs, count: int, size: float = 0.0) -> dict[str, Any]:
    """Write down the first things of a group. size: their radius where none has one."""
    x, y = _rounded(discs.positions)[:count].T
    radius = np.asarray(discs.radius)[:count]
    return {
        "x": x.tolist(),
        "y": y.tolist(),
        "radius": _rounded(radius if radius.any() else np.full_like(radius, size)).tolist(),
        "there": np.asarray(discs.there)[:count].tolist(),
        "lit": np.asarray(discs.lit)[:count].tolist(),
        "colour": np.asarray(discs.colour)[:count].tolist(),
    }


def _rounded(values: Any) -> np.ndarray:
    """To four digits behind the point; a number that is not finite is 0, which JSON can hold."""
    return np.nan_to_num(np.asarray(values, np.float64), posinf=0.0, neginf=0.0).round(4)
