"""A moment as plain data for a page: where everything is, what is said and heard, and what is done."""

import math
from typing import Any

import numpy as np
from jaxtyping import Bool, Int

from gacrl.evaluation.episodes import said_symbols
from gacrl.scene import Discs
from gacrl.viewer.insight import Insight
from gacrl.viewer.rooms import Decided, Meddling


def picture(decided: Decided, count: int, meddling: Meddling | None, size: float) -> dict[str, Any]:
    """Write down what was decided in one environment, on the host: the first `count` agents are there.

    size: the radius of agents without one.
    """
    scene, graph = decided.scene, decided.hears
    said = _symbols(decided.messages, count)
    arrived = said if meddling is None else _arriving(said, meddling, count)
    heard = np.zeros((count, count), bool) if graph is None or not len(said) else np.asarray(graph)[:count, :count]
    hears = [np.flatnonzero(row).tolist() for row in heard]
    actions = np.asarray(decided.action)[:count]
    return {
        "agents": _discs(scene.agents, count, size),
        "marks": _discs(scene.marks, len(scene.marks.radius)),
        "lines": _rounded(scene.lines).reshape(-1, 4).tolist(),
        "ground": _rounded(scene.ground).ravel().tolist(),
        "said": said.tolist(),
        "arrived": arrived.tolist(),
        "hears": hears,
        "actions": actions.tolist() if actions.ndim == 1 else None,
        **({} if decided.insight is None else _told(decided.insight, count, heard)),
    }


def _told(insight: Insight, count: int, heard: Bool[np.ndarray, "N N"]) -> dict[str, Any]:
    """Write down how a decision came about: shares in whole percent, worth to two digits, None where nothing is known.

    heeded: of those whom each agent hears, in the order of `hears`. words [R N] and looks [N]: index and share, one
    after the other. sees [N]: the nearest marks, the nearest agents, and how many things besides.
    """
    found: dict[str, Any] = {}
    if insight.heeded is not None:
        shares = _percent(insight.heeded[:count, :count])
        found["heeded"] = [row[there].tolist() for row, there in zip(shares, heard, strict=True)]
    if insight.words is not None and insight.chances is not None:
        pairs = np.stack([insight.words[:, :count], _percent(insight.chances[:, :count])], axis=-1)
        found["words"] = pairs.reshape(*pairs.shape[:2], -1).tolist()
    if insight.head is not None:
        found["values"] = [[_or_none(value) for value in row] for row in insight.head[:count].round(2).tolist()]
    if insight.looks is not None:
        which, share = insight.looks.which[:count], _percent(insight.looks.value[:count])
        pairs, known = np.stack([which, share], axis=-1), (which >= 0) & (share > 0)
        found["looks"] = [row[there].ravel().tolist() for row, there in zip(pairs, known, strict=True)]
    if insight.marks is not None and insight.others is not None and insight.more is not None:
        sides = insight.marks.which[:count], insight.others.which[:count], insight.more[:count]
        found["sees"] = [
            [marks[marks >= 0].tolist(), others[others >= 0].tolist(), int(more)]
            for marks, others, more in zip(*map(np.asarray, sides), strict=True)
        ]
    return found


def _percent(shares: Any) -> Int[np.ndarray, "*b"]:
    return np.nan_to_num(100 * np.asarray(shares)).round().astype(int)


def _or_none(value: float) -> float | None:
    return value if math.isfinite(value) else None


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
