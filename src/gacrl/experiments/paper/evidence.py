"""What the runs of a reproduction showed, as plain arrays: all that verdicts, tables and figures are made from.

S seeds, K stretches of training (the episodes between two lines of the log), E episodes of a scripted policy.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from types import MappingProxyType
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

from gacrl.config.run import RunConfig
from gacrl.experiments import results
from gacrl.experiments.paper import references as scripted
from gacrl.experiments.paper.references import Difficulty, Episodes, difficulty
from gacrl.experiments.paper.tables import SCRIPTED
from gacrl.experiments.provenance import Versions, made_by
from gacrl.experiments.results import reading, why_diverged
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
FIXED_RATIO = "reward_shaped_fixed_ratio"
"""Equation (1) with r_raw at the local ratio 0.5 of the log, instead of that of the moment."""


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
    made_by: Sequence[Versions] = ()
    """The versions that began and ended its training."""

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

    def has(self, column: str, who: str) -> bool:
        """Return whether an algorithm was trained to its end."""
        return (_trained_on(column, who), who) in self.series

    def trained(self, column: str, who: str) -> Series:
        """Return an algorithm's series. Raises MissingRun for one that diverged.

        The column `mixed` has GACRL on the paper's reward and everyone else on MPE2's.
        """
        column = _trained_on(column, who)
        if (column, who) in self.diverged:
            raise MissingRun(f"{who} diverged on {COLUMNS[column]}: {self.diverged[column, who]}")
        return self.series[column, who]

    def reference(self, column: str, who: str) -> Reference:
        """Return a scripted policy in a column's task."""
        return self.references["paper" if column == "mixed" else column, who]

    def values(self, weights: Mapping[str, float], who: str, play: Play, column: str) -> Float[np.ndarray, " S"]:
        """Return a measure (a weighted sum of metrics) at the end: one number a seed.

        A scripted policy has no seeds: its numbers are means over blocks of `FINAL_EPISODES` episodes.
        """
        if who not in SCRIPTED:
            series = self.trained(column, who)
            return measured(weights, series.closing[0] if play == "training" else series.final[play])
        reference = self.reference(column, who)
        return blocks(measured(weights, reference.stretches[-1] if play == "training" else reference.final))


def _trained_on(column: str, who: str) -> str:
    return ("paper" if who == "GACRL" else "mpe2") if column == "mixed" else column


def measured(weights: Mapping[str, float], metrics: Metrics) -> Float[np.ndarray, "..."]:
    """Return the weighted sum of the metrics."""
    return np.sum([weight * metrics[name] for name, weight in weights.items()], axis=0)


def blocks(episodes: Float[np.ndarray, " E"]) -> Float[np.ndarray, " blocks"]:
    """Return means of blocks of episodes; at least two blocks, however few episodes there are."""
    count = max(len(episodes) // FINAL_EPISODES, 2)
    size = min(FINAL_EPISODES, len(episodes) // count)
    return episodes[: count * size].reshape(count, size).mean(1)


def read_series(path: Path) -> Series:
    """Read a finished run folder. Raises UserError for a damaged one."""
    with reading(path):
        return _read_series(path)


def _read_series(path: Path) -> Series:
    config = RunFolder.open(path).config()
    found = results.read(path, config)
    by_seed = found.rows
    ended = np.array([[row["train"]["episodes"] for row in seen] for seen in by_seed])
    kept = np.flatnonzero(ended.min(0) > 0)
    names = list(by_seed[0][0]["train"]["mean"])

    def stacked(what: str) -> dict[str, np.ndarray]:
        return {
            name: np.array([[seen[k]["train"][what][name] for k in kept] for seen in by_seed]) for name in names
        }

    ends = np.array([by_seed[0][k]["task"]["local_ratio"] for k in kept])
    midway = (ends + np.append(config.env.local_ratio, ends[:-1])) / 2
    sd = stacked("sd")
    return Series(
        config=config,
        episodes=np.array([by_seed[0][k]["episodes_done"] for k in kept]),
        counted=ended[0][kept],
        mean=_with_fixed_ratio(stacked("mean"), midway),
        sd={**sd, FIXED_RATIO: sd["reward_shaped"]},
        last=_with_fixed_ratio(stacked("last_episode"), ends),
        tasks=tuple(by_seed[0][k]["task"] for k in kept),
        final={
            kind: _with_fixed_ratio(found.final(kind), config.env.local_ratio) for kind in ("greedy", "sampled")
        },
        scripted=found.summary["references"],
        seconds=float(found.summary["wall_seconds"]),
        made_by=made_by([path]),
    )


def _with_fixed_ratio(metrics: Metrics, ratio: float | np.ndarray) -> Metrics:
    """Add equation (1) with r_raw at the local ratio 0.5.

    r_raw at the ratio r is −r · collisions − (1 − r) · 3 · distance from landmarks, so that at r it is less by
    (1 − 2r)(r_raw + 3 · distance) than what is logged, at 0.5.
    """
    missing = (1.0 - 2.0 * np.asarray(ratio)) * (metrics["reward_raw"] + 3.0 * metrics["distance_landmark_agent"])
    return {**metrics, FIXED_RATIO: metrics["reward_shaped"] + missing}


def gather(
    folders: Mapping[tuple[str, str], Path], out: Path, say: Callable[[str], None] = lambda sentence: None
) -> Evidence:
    """Gather the evidence of run folders that are finished or diverged, and of scripted policies in the same tasks.

    out: the study's folder, which keeps the episodes of the scripted policies.
    """
    reasons = {key: why_diverged(path) for key, path in folders.items()}
    diverged = {key: because for key, because in reasons.items() if because is not None}
    series = {key: read_series(path) for key, path in folders.items() if key not in diverged}
    followed = {
        column: next(found for (at, _), found in series.items() if at == column)  # GACRL's, where it is there
        for column in ("paper", "mpe2")
    }
    config = followed["paper"].config
    configured = (config.env.local_ratio, config.env.coverage_threshold)
    stretches = {column: [difficulty(task) for task in found.tasks] for column, found in followed.items()}
    played = scripted.played(out, config, [configured, *chain(*stretches.values())], say)
    references = {
        (column, who): _beside(played[who], at, configured) for column, at in stretches.items() for who in SCRIPTED
    }
    return Evidence(series, references, diverged)


def _beside(
    episodes: Mapping[Difficulty, Episodes], stretches: list[Difficulty], configured: Difficulty
) -> Reference:
    """A scripted policy at the difficulty of each stretch, and as evaluated."""
    scored = {at: _with_fixed_ratio(metrics, at[0]) for at, metrics in episodes.items()}
    return Reference(tuple(scored[at] for at in stretches), scored[configured])
