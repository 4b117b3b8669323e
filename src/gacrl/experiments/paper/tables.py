"""Table II and the GACRL row of Table III, the paper's numbers beside ours and beside scripted policies.

The columns mean what docs/algorithm.md says they must. Coverage stands there twice, within θ of the moment
(which fits Table II) and within 0.1 (which fits Table III), since no single definition fits both.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib import resources
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gacrl import tasks
from gacrl.config.run import RunConfig
from gacrl.evaluation.evaluate import stream_key
from gacrl.evaluation.references import scripted_program

SCRIPTED = ("random", "noop", "oracle")
"""Who plays the same task beside the paper and us."""
COLUMNS = {
    "reward_shaped": "Sh. Reward",
    "reward_raw": "Raw Rew.",
    "coverage_mean_theta": "Cov. θ",
    "coverage_mean_0.1": "Cov. 0.1",
    "distance_agent_landmark": "Min Dist",
    "near_agents": "Coll.",
}
MEANING = (
    "Sh. Reward and Raw Rew.: the paper's shaped reward and MPE2's own, a step; Cov.: share of landmarks with an agent "
    "within θ, or 0.1; Min Dist: from an agent to its nearest landmark; Coll.: share of agents with another within 0.2"
)
"""Of the columns, in words."""
REFERENCE_EPISODES = 320
"""Episodes of each scripted policy for a row."""


@dataclass(frozen=True)
class Row:
    """One line of a table: a mean and, where it is one of many episodes, their standard deviation."""

    episode: int
    who: str
    mean: Mapping[str, float]
    sd: Mapping[str, float] | None = None


@cache
def printed() -> dict[str, Any]:
    """Return the paper's own numbers."""
    return json.loads(
        resources.files("gacrl.experiments.paper").joinpath("paper.json").read_text(encoding="utf-8")
    )


def apply_to(config: RunConfig) -> bool:
    """Return whether a run is the paper's algorithm on the paper's reward."""
    return config.algorithm.name == "gacrl_paper" and getattr(config.env, "reward", None) == "paper"


def table_2(config: RunConfig, metrics: list[dict[str, Any]]) -> list[Row]:
    """Return the selected episodes: the paper's row, each seed's very episode, and what scripted policies get.

    metrics: the rows of `metrics.jsonl`. Episodes at which this run did not log are left out.
    """
    rows: list[Row] = []
    logged = _by_episode(metrics)
    for episode, numbers in printed()["table_2"]["rows"].items():
        members = logged.get(int(episode), [])
        if members:
            rows.append(Row(int(episode), "paper", _paper_columns("table_2", numbers)))
            rows += [Row(int(episode), f"ours, seed {m['seed']}", m["train"]["last_episode"]) for m in members]
            rows += _references(config, int(episode), members[0]["task"])
    return rows


def table_3(config: RunConfig, metrics: list[dict[str, Any]]) -> list[Row]:
    """Return the stretch of training that ended last: mean ± standard deviation over its episodes."""
    logged = _by_episode(metrics)
    if not logged:
        return []
    last = max(logged)
    mean_and_sd = printed()["table_3"]["rows"]["GACRL"]
    rows = [
        Row(
            last,
            "paper",
            _paper_columns("table_3", [mean for mean, _ in mean_and_sd]),
            _paper_columns("table_3", [sd for _, sd in mean_and_sd]),
        )
    ]
    rows += [Row(last, f"ours, seed {m['seed']}", m["train"]["mean"], m["train"]["sd"]) for m in logged[last]]
    return rows + _references(config, last, logged[last][0]["task"])


def _by_episode(metrics: list[dict[str, Any]]) -> dict[int, list[dict[str, Any]]]:
    """The rows under the count of episodes that their seed had finished, for those that finished any."""
    by_episode: dict[int, list[dict[str, Any]]] = {}
    for row in metrics:
        if row["train"]["episodes"]:
            by_episode.setdefault(row["episodes_done"], []).append(row)
    return by_episode


def _paper_columns(table: str, numbers: list[float]) -> dict[str, float]:
    """A printed row under our names; its coverage goes to the definition that fits that table."""
    coverage = "coverage_mean_theta" if table == "table_2" else "coverage_mean_0.1"
    names = [coverage if name == "coverage" else name for name in printed()[table]["columns"]]
    return dict(zip(names, numbers, strict=True))


def _references(config: RunConfig, episode: int, task: Mapping[str, float]) -> list[Row]:
    """What random, noop and oracle get at the difficulty of that episode, over many episodes."""
    rows: list[Row] = []
    for name in SCRIPTED:
        metrics = reference_episodes(name, config, task)
        mean = {metric: float(values.mean()) for metric, values in metrics.items()}
        sd = {metric: float(values.std()) for metric, values in metrics.items()}
        rows.append(Row(episode, name, mean, sd))
    return rows


def reference_episodes(name: str, config: RunConfig, task: Mapping[str, float]) -> dict[str, np.ndarray]:
    """Return every metric of the episodes [E] of a scripted policy, at the difficulty of a row of `metrics.jsonl`."""
    return _play_scripted(name, config, task["local_ratio"], task["coverage_threshold"])


def _play_scripted(name: str, config: RunConfig, local_ratio: float, threshold: float) -> dict[str, np.ndarray]:
    task = tasks.find(config.task)
    params = task.numbers(config.env, task.make(config.env))._replace(
        local_ratio=jnp.asarray(local_ratio), coverage_threshold=jnp.asarray(threshold)
    )
    program = scripted_program(name, config.task, config.env, REFERENCE_EPISODES)
    return jax.device_get(program(params, stream_key("report")))
