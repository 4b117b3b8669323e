"""A run as one page: where the page knows task and network it steps them itself, else it replays what was recorded."""

import json
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from gacrl.errors import UserError
from gacrl.evaluation.episodes import Episode, record_many
from gacrl.evaluation.evaluate import stream_key
from gacrl.evaluation.references import look_of
from gacrl.export import bundle, portable, replays
from gacrl.export.dictionary import dictionary
from gacrl.export.source import Source
from gacrl.export.yardsticks import yardsticks
from gacrl.messages import interventions
from gacrl.networks.communication import kind_of
from gacrl.play import TrainedRun
from gacrl.replacing import replaced
from gacrl.tasks.task import Task
from gacrl.types import Intervention

MOST_BYTES = 400_000
HEARD = 1_000
"""Recorded episodes that the dictionary is counted in."""
REPLAYED = 8
UNBOUNDED = 12
"""Agents at the most for a network in which every agent looks at all others: its work grows with their cube."""


def write(source: Source, out: Path) -> Sequence[Path]:
    """Write a page of at most 400 KB that needs no server. Raises UserError where nothing can be shown."""
    opened = source.opened
    data = common(opened.task, opened.config.env, Path(source.name).name)  # it goes elsewhere
    live = _live(opened)
    data |= _recorded(opened) if live is None else live
    text = bundle.page(f"{data['title']} · gacrl", data)
    size = len(text.encode())
    if size > MOST_BYTES:
        raise UserError(
            f"the page would have {size:,} bytes, and a page has at most {MOST_BYTES:,}: train a narrower network, or "
            "export npz"
        )
    with replaced(out) as file:
        file.write(text.encode())
    return [out]


def common(task: Task, settings: Any, name: str) -> dict[str, Any]:
    """Return what every page says of its policies. name: theirs, without the folders of this machine."""
    words = task.words
    return {
        "title": f"{task.name}: {name}",
        "task": task.name,
        "summary": task.summary,
        "actions": list(task.actions(settings)),
        "words": {"agent": words.agent, "mark": words.mark, "lit": words.lit},
        "colours": replays.COLOURS,
        "measures": {},
        "yardsticks": {},
        "dictionary": [],
        "heard": 0,
        "world": None,
        "network": None,
        "replays": None,
    }


def _live(opened: TrainedRun) -> dict[str, Any] | None:
    """Rules and weights, for a page that plays; None where it knows one of them not."""
    task, env, params = opened.task, opened.env, opened.trainer.evaluation_params
    known = None if task.world is None else task.world(env, params)
    network = portable.network(opened)
    if known is None or network is None:
        return None
    rules: dict[str, Any] = {**known}
    if "most_agents" in rules and network["settings"]["nearest_agents"] is None:
        rules["most_agents"] = max(UNBOUNDED, env.num_agents)
    return {
        "world": rules,
        "network": network,
        "measures": rules["measures"],
        "yardsticks": yardsticks(task, env, params, rules["measures"]),
        **heard(opened, HEARD),
    }


def heard(opened: TrainedRun, count: int, sampled: bool = False) -> dict[str, Any]:
    """Count what the words of a policy go with in so many recorded episodes: {dictionary, heard: episodes}.

    Agents that come and go have their words in common; elsewhere each has its own.
    """
    network = getattr(opened.config.algorithm, "network", None)
    if network is None or not kind_of(network).sends_symbols:
        return {}
    episodes = _episodes(opened, count, sampled=sampled)
    apart = opened.task.world is not None and opened.task.team is None
    return {"dictionary": dictionary(episodes, network.vocabulary, apart), "heard": count}


def _recorded(opened: TrainedRun) -> dict[str, Any]:
    """Episodes as they are, and silenced ones from the same starts where the policy speaks."""
    played = _episodes(opened, REPLAYED)
    if played[0].scene is None:
        raise UserError(
            f"{opened.task.name} does not say where things are: give its observations positions, or a scene"
        )
    config = getattr(opened.config.algorithm, "network", None)
    silenced = []
    if played[0].messages is not None and config is not None:
        silenced = _episodes(opened, REPLAYED, interventions.silence())
    kept = _fitting(played, silenced)
    return {
        "replays": {"played": replays.replay(played[:kept]), "silenced": replays.replay(silenced[:kept])},
        **heard(opened, HEARD),
    }


def _fitting(*groups: list[Episode]) -> int:
    """How many episodes of each group go into half of a page, by the size of the first."""
    size = sum(len(json.dumps(replays.replay(group[:1]))) for group in groups)
    return int(np.clip(MOST_BYTES // 2 // size, 1, REPLAYED))


def _episodes(
    opened: TrainedRun, count: int, intervention: Intervention | None = None, sampled: bool = False
) -> list[Episode]:
    """Record play from the starts of the closing evaluation, greedy unless it is `sampled`."""
    happens = opened.trainer.intervention if intervention is None else intervention
    play = partial(record_many, opened.env, opened.policy(0, sampled), opened.trainer.memory)
    look = look_of(opened.task, opened.config.env)
    return play(opened.trainer.evaluation_params, stream_key("report"), count, happens, look)
