"""Recorded episodes as plain data, for a page whose task or network it cannot step itself."""

import base64
from collections.abc import Sequence
from typing import Any

import numpy as np

from gacrl.evaluation.episodes import Episode
from gacrl.pen import COVERED, SYMBOL_COLOURS, UNCOVERED
from gacrl.scene import Discs

COLOURS = {"symbols": SYMBOL_COLOURS, "lit": COVERED, "unlit": UNCOVERED}
"""In which a page draws them."""
STEPS = 1000
"""Steps of an episode that are kept at the most."""


def replay(episodes: Sequence[Episode]) -> list[dict[str, Any]]:
    """Write episodes down: scene, words, graph, actions and rewards. Raises ValueError for one without a scene."""
    return [_plain(episode) for episode in episodes]


def _plain(episode: Episode) -> dict[str, Any]:
    scene, steps = episode.scene, min(episode.num_steps, STEPS)
    if scene is None:
        raise ValueError("the episode has no scene: there is nothing to see")
    symbols = episode.symbols
    return {
        "steps": steps,
        "agents": _discs(scene.agents, steps + 1),
        "marks": _discs(scene.marks, steps + 1),
        "lines": _numbers(scene.lines[0], np.float32),
        "ground": _numbers(scene.ground[0], np.float32),
        "reward": _numbers(episode.reward_raw[:steps], np.float32),
        "actions": _numbers(episode.actions[:steps], np.int16) if episode.actions.ndim == 2 else None,
        "words": None if symbols is None else _numbers(symbols[:steps], np.int16),
        "hears": None if episode.adjacency is None else _bits(episode.adjacency[:steps]),
    }


def _discs(discs: Discs, count: int) -> dict[str, Any]:
    return {
        "positions": _numbers(discs.positions[:count], np.float32),
        "radius": _numbers(discs.radius[:1], np.float32),
        "there": _bits(discs.there[:count]),
        "lit": _bits(discs.lit[:count]),
        "colour": _numbers(discs.colour[:count], np.int16),
    }


def _numbers(values: Any, kind: type) -> dict[str, Any]:
    array = np.ascontiguousarray(values, np.dtype(kind).newbyteorder("<"))
    return {
        "shape": list(array.shape),
        "kind": np.dtype(kind).name,
        "data": base64.b64encode(array.tobytes()).decode(),
    }


def _bits(values: Any) -> dict[str, Any]:
    array = np.asarray(values, bool)
    packed = np.packbits(array.ravel(), bitorder="little")
    return {"shape": list(array.shape), "kind": "bits", "data": base64.b64encode(packed.tobytes()).decode()}
