"""What the runs of a reproduction showed, as plain arrays: all that verdicts, tables and figures are made from.

S seeds, K stretches of training (the episodes between two lines of the log), E episodes of a scripted policy.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Int

from gacrl.config.run import RunConfig
from gacrl.experiments.paper.tables import SCRIPTED, reference_episodes
from gacrl.experiments.study import reading, why_diverged
from gacrl.training.recorder import RunFolder

Play = Literal["training", "sampled", "greedy"]
"""The end of training, exploration and all; the closing evaluation sampled as in training; and greedy."""
Metrics = Mapping[str, Float[np.ndarray, "..."]]

COLUMNS: Mapping[str, str] = MappingProxyType(
    {"paper": "the paper's reward", "mpe2": "MPE2's reward", "extended": "equal switches"}
)
"""What the algorithms are trained on: the paper's reward and curriculum, MPE2's reward, or MPE2's task in earnest."""
FINAL_EPISODES = 50
"""What the paper's final metrics cover, and what a random policy is averaged over beside them."""


class MissingRun(LookupError):
    """What is asked for needs a run that diverged; says which."""


@dataclass(frozen=True, eq=False)
class Series:
    """One algorithm's training, and the evaluation that closed it."""

    config: RunConfig
    episodes: Int[np.ndarray, " K"]
    """Finished at the end of each stretch."""
    counted: Int[np.ndarray, " K"]
    """Finished in each stretch."""
    mean: Metrics
    """[S, K] over a stretch's episodes; `sd` is their standard deviation, `last` the stretch's last episode."""
    sd: Metrics
    last: Metrics
    tasks: tuple[Mapping[str, float], ...]
    """The difficulty at the end of each stretch."""
    final: Mapping[str, Metrics]
    """[S] of the closing evaluation, greedy and sampled."""
    scripted: Mapping[str, Mapping[str, float]]
    """What the scripted policies reach on the closing evaluation's starts."""
    seconds: float
    """Of all seeds together, evaluations and compilation included."""

    @property
    def closing(self) -> tuple[Metrics, Metrics, int]:
        """Mean and standard deviation [S] over the last stretches that hold `FINAL_EPISODES`, and how many."""
        enough = np.cumsum(self.counted[::-1]) >= FINAL_EPISODES
        take = (int(enough.argmax()) if enough.any() else len(enough) - 1) + 1
        weight = self.counted[-take:] / self.counted[-take:].sum()
        mean = {name: values[:, -take:] @ weight for name, values in self.mean.items()}
        sd = {
            name: np.sqrt(
                np.maximum(
                    (self.sd[name][:, -take:] ** 2 + values[:, -take:] ** 2) @ weight - mean[name] ** 2, 0.0
                )
            )
            for name, values in self.mean.items()
        }
        return mean, sd, int(self.counted[-take:].sum())


@dataclass(frozen=True, eq=False)
class Reference:
    """Episodes [E] of a scripted policy: at the difficulty of each stretch of GACRL's, and as evaluated."""

    stretches: tuple[Metrics, ...]
    final: Metrics


@dataclass(frozen=True, eq=False)
class Evidence:
    """Everything, under (column, who): trained algorithms in `series`, scripted policies in `references`."""

    series: Mapping[tuple[str, str], Series]
    references: Mapping[tuple[str, str], Reference]
    diverged: Mapping[tuple[str, str], str] = field(default_factory=dict[tuple[str, str], str])
    """What ended the training of those that are not in `series`."""

    def trained(self, column: str, who: str) -> Series:
        """An algorithm's series. Raises MissingRun for one that diverged.

        The column `mixed` has GACRL on the paper's reward and everyone else on MPE2's.
        """
        column = ("paper" if who == "GACRL" else "mpe2") if column == "mixed" else column
        if (column, who) in self.diverged:
            raise MissingRun(f"{who} diverged on {COLUMNS[column]}: {self.diverged[column, who]}")
        return self.series[column, who]

    def reference(self, column: str, who: str) -> Reference:
        """A scripted policy in a column's task."""
        return self.references["paper" if column == "mixed" else column, who]

    def values(self, weights: Mapping[str, float], who: str, play: Play, column: str) -> Float[np.ndarray, " S"]:
        """A measure (a weighted sum of metrics) at the end: one number a seed.

        A scripted policy has no seeds: its numbers are means over blocks of `FINAL_EPISODES` episodes.
        """
        if who not in SCRIPTED:
            series = self.trained(column, who)
            return measured(weights, series.closing[0] if play == "training" else series.final[play])
        reference = self.reference(column, who)
        return blocks(measured(weights, reference.stretches[-1] if play == "training" else reference.final))


def measured(weights: Mapping[str, float], metrics: Metrics) -> Float[np.ndarray, "..."]:
    """The weighted sum of the metrics."""
    return np.sum([weight * metrics[name] for name, weight in weights.items()], axis=0)


def blocks(episodes: Float[np.ndarray, " E"], size: int = FINAL_EPISODES) -> Float[np.ndarray, " blocks"]:
    """Means of blocks of episodes; at least two blocks, however few episodes there are."""
    count = max(len(episodes) // size, 2)
    size = min(size, len(episodes) // count)
    return episodes[: count * size].reshape(count, size).mean(1)


def read_series(path: Path) -> Series:
    """A finished run folder. Raises UserError for a damaged one."""
    with reading(path):
        return _read_series(path)


def _read_series(path: Path) -> Series:
    folder = RunFolder.open(path)
    config, rows = folder.config(), folder.metrics()
    summary = json.loads(folder.summary_file.read_text(encoding="utf-8"))
    by_seed = [[row for row in rows if row["seed"] == seed] for seed in config.seeds]
    ended = np.array([[row["train"]["episodes"] for row in seen] for seen in by_seed])
    kept = np.flatnonzero(ended.min(0) > 0)
    names = list(rows[0]["train"]["mean"])

    def stacked(what: str) -> dict[str, np.ndarray]:
        return {
            name: np.array([[seen[k]["train"][what][name] for k in kept] for seen in by_seed]) for name in names
        }

    return Series(
        config=config,
        episodes=np.array([by_seed[0][k]["episodes_done"] for k in kept]),
        counted=ended[0][kept],
        mean=stacked("mean"),
        sd=stacked("sd"),
        last=stacked("last_episode"),
        tasks=tuple(by_seed[0][k]["task"] for k in kept),
        final={kind: _final(summary["final"][kind]) for kind in ("greedy", "sampled")},
        scripted=summary["references"],
        seconds=float(summary["wall_seconds"]),
    )


def _final(metrics: Mapping[str, Any]) -> dict[str, np.ndarray]:
    return {name: np.array(entry["values"]) for name, entry in metrics.items() if not name.startswith("score_")}


def gather(folders: Mapping[tuple[str, str], Path]) -> Evidence:
    """The evidence of run folders that are finished or diverged, and of scripted policies in the same tasks."""
    reasons = {key: why_diverged(path) for key, path in folders.items()}
    diverged = {key: because for key, because in reasons.items() if because is not None}
    series = {key: read_series(path) for key, path in folders.items() if key not in diverged}
    references: dict[tuple[str, str], Reference] = {}
    for column in ("paper", "mpe2"):
        followed = next(found for (at, _), found in series.items() if at == column)  # GACRL's, where it is there
        references |= {(column, name): _play(name, followed) for name in SCRIPTED}
    return Evidence(series, references, diverged)


def _play(name: str, followed: Series) -> Reference:
    """A scripted policy beside a series; a difficulty that stays the same is played once."""
    config = replace(
        followed.config, env=replace(followed.config.env, reward="paper")
    )  # one program for all columns
    played: dict[tuple[float, float], dict[str, np.ndarray]] = {}

    def at(task: Mapping[str, float]) -> dict[str, np.ndarray]:
        key = (task["local_ratio"], task["coverage_threshold"])
        if key not in played:
            episodes = reference_episodes(name, config, task)
            played[key] = {metric: np.asarray(values, float) for metric, values in episodes.items()}
        return played[key]

    env = config.env
    configured = {"local_ratio": env.local_ratio, "coverage_threshold": env.coverage_threshold}
    return Reference(tuple(at(task) for task in followed.tasks), at(configured))
