"""What the words of a policy go with, counted in recorded episodes: where those who hear one must go, and do go."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from gacrl.evaluation.episodes import Episode
from gacrl.scene import PLAIN

HERE = 0.1
"""Arena units within which a place is here."""
DIRECTIONS = 8
"""Sectors of the compass: 0 is to the right, then anticlockwise; `DIRECTIONS` is here."""


class Steps(NamedTuple):
    """K steps of an episode or of several, one below the other."""

    symbols: Int[np.ndarray, "K R N"]
    hears: Bool[np.ndarray, "K N N"]
    actions: Int[np.ndarray, "K N"]
    goal: Int[np.ndarray, "K N"]
    """The colour of what an agent seeks; `PLAIN` for an agent without a colour."""
    offset: Float[np.ndarray, "K N 2"]
    """From each agent to the mark in its colour, or to the nearest one."""


def dictionary(episodes: Sequence[Episode], vocabulary: int, apart: bool) -> list[dict[str, Any]]:
    """Return an entry for each word that is said: {agent, round, symbol, share, of, …} and what it goes with.

    apart: each agent has words of its own; otherwise they are counted together, and agent is −1. An entry is about
    those who hear the word where agents have goals of their own (of "heard"), else about who says it (of "said").
    goal: [colour, share], the commonest; direction: [sector, share]; distance: the mean; action: [index, share].
    """
    if episodes[0].symbols is None or episodes[0].scene is None or episodes[0].scene.marks.radius.shape[1] == 0:
        return []
    steps = Steps(*(np.concatenate(parts) for parts in zip(*map(_steps, episodes), strict=True)))
    heard = bool((steps.goal != PLAIN).any())
    agents = range(steps.goal.shape[1])
    entries: list[dict[str, Any]] = []
    for group in [[agent] for agent in agents] if apart else [list(agents)]:
        said = steps.symbols[:, :, group]
        for number in range(said.shape[1]):
            for symbol in range(vocabulary):
                entry = _entry(steps, said[:, number] == symbol, group, heard)
                if entry is not None:
                    name = {"agent": group[0] if apart else -1, "round": number, "symbol": symbol}
                    entries.append({**name, "of": "heard" if heard else "said", **entry})
    return entries


def _entry(steps: Steps, said: Bool[np.ndarray, "K G"], group: list[int], heard: bool) -> dict[str, Any] | None:
    """What goes with a word that these agents say in these steps; None where nobody says it."""
    if not said.any():
        return None
    about = np.zeros(steps.goal.shape, int)
    for column, speaker in enumerate(group):
        if heard:
            about += said[:, column, None] & steps.hears[:, :, speaker] & (steps.goal != PLAIN)
        else:
            about[:, speaker] += said[:, column]
    weight = about.ravel().astype(float)
    share = round(float(said.mean()), 4)
    if not weight.any():
        return {"share": share}
    offset, goal, action = steps.offset.reshape(-1, 2), steps.goal.ravel(), steps.actions.ravel()
    distance = np.hypot(*offset.T)
    sector = np.round(np.arctan2(offset[:, 1], offset[:, 0]) / (2 * np.pi / DIRECTIONS)).astype(int) % DIRECTIONS
    sector[distance < HERE] = DIRECTIONS
    return {
        "share": share,
        "goal": _commonest(goal + 1, weight, -1),
        "direction": _commonest(sector, weight),
        "distance": round(float(np.average(distance, weights=weight)), 3),
        "action": _commonest(action, weight),
    }


def _commonest(values: Int[np.ndarray, " K"], weight: Float[np.ndarray, " K"], add: int = 0) -> list[Any]:
    """Return the value with the most weight, and its share of it."""
    counts = np.bincount(values, weight)
    return [int(counts.argmax()) + add, round(float(counts.max() / counts.sum()), 4)]


def _steps(episode: Episode) -> Steps:
    scene, symbols = episode.scene, episode.symbols
    assert scene is not None and symbols is not None
    count, agents = episode.agent_mask.shape
    places, marks = scene.agents.positions[:count], scene.marks.positions[:count]
    offsets = marks[:, None] - places[:, :, None]  # [K N L 2]
    goal = scene.agents.colour[:count]
    distance = np.where(scene.marks.there[:count, None], np.hypot(offsets[..., 0], offsets[..., 1]), np.inf)
    own = goal[:, :, None] == scene.marks.colour[:count, None]
    target = np.where((goal != PLAIN) & own.any(-1), own.argmax(-1), distance.argmin(-1))
    offset = np.take_along_axis(offsets, target[:, :, None, None], axis=2)[:, :, 0]
    hears = np.ones((count, agents, agents), bool) if episode.adjacency is None else episode.adjacency
    return Steps(symbols, hears, episode.actions, np.asarray(goal), np.asarray(offset))
