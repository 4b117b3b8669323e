"""What the study of talk reads from finished cells: scores between silence and being told, curves, caught messages."""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from gacrl import tasks
from gacrl.algorithms.actions import choices
from gacrl.config import files as configuration
from gacrl.config.run import RunConfig
from gacrl.evaluation import references
from gacrl.evaluation.statistics import Estimate, estimate, mean, probability_of_improvement
from gacrl.experiments import results, scoring
from gacrl.experiments.results import Finals, Values, reading, why_diverged
from gacrl.experiments.study import Planned
from gacrl.experiments.talking.kinds import NONE, SILENT_KINDS, TOLD, num_parameters
from gacrl.messages import interventions
from gacrl.messages.bits import bits_sent
from gacrl.networks.agent import matched
from gacrl.replacing import replace_json
from gacrl.tasks.task import MATTERS, Case, Task

CAUGHT: Mapping[str, str] = {"silenced": "silence", "scrambled": "scramble", "a step late": "delay 1"}
"""What happens to messages, and the intervention that does it."""
REACHED = 0.9
_CAUGHT_FILE = "caught.json"


class Best(NamedTuple):
    """The best policy of those that say nothing, or of those that are told everything."""

    who: str
    value: float
    """Mean over seeds, of the task's headline."""


@dataclass(frozen=True)
class Ended:
    """A learner of a case, as its seeds ended."""

    config: RunConfig
    parameters: int
    bits: float | None
    """That an agent sends in a step; None where it sends nothing."""
    final: Finals
    """Greedy, last parameters; empty for a run that diverged."""
    caught: Mapping[str, Finals]
    """The same by what happened to the messages; empty where there are none."""
    evaluated_at: tuple[int, ...]
    along: Mapping[str, Values]
    """Of the headline and of what is to be reached, along training [S, P]."""
    diverged: str | None = None

    def steps_to(self, metric: str) -> list[int | None]:
        """Return each seed's environment steps at the first of two evaluations in a row from .9 on; None: never."""
        found: list[int | None] = []
        for values in self.along.get(metric, np.zeros((0, 0))):
            there = values >= REACHED
            pairs = np.flatnonzero(there[:-1] & there[1:])
            found.append(self.evaluated_at[pairs[0]] if len(pairs) else None)
        return found


@dataclass(frozen=True)
class Played:
    """A case of the study, as far as its learners have come."""

    name: str
    task: Task
    case: Case
    scripted: Mapping[str, Mapping[str, float]]
    """Of random, and of the silent and the told policy where the task has them: each metric's mean."""
    learners: Mapping[str, Ended]

    @property
    def floor(self) -> Best:
        """The best silent policy, scripted or trained; random where there is none."""
        return self._best(self.task.silent, SILENT_KINDS) or Best(
            "random", self.scripted["random"][self.task.headline]
        )

    @property
    def ceiling(self) -> Best | None:
        """The best policy that is told everything, scripted or trained."""
        return self._best(self.task.told, (TOLD,))

    def _best(self, script: str, trained: tuple[str, ...]) -> Best | None:
        headline = self.task.headline
        known = {f"scripted {script}": self.scripted[script][headline]} if script in self.scripted else {}
        known |= {
            kind: float(self.learners[kind].final[headline].mean())
            for kind in trained
            if kind in self.learners and self.learners[kind].final
        }
        if not known:
            return None
        sign = self.task.metric(headline).sign
        who = max(known, key=lambda name: sign * known[name])
        return Best(who, known[who])

    def scores(self, values: Values) -> Values | None:
        """Scale the headline [S]: 0 is the floor, 1 the ceiling. None where being told is not worth enough."""
        headline = self.task.headline
        floor, ceiling, random = self.floor, self.ceiling, self.scripted["random"][headline]
        if ceiling is None:
            return None
        worth = self.task.metric(headline).sign * (ceiling.value - floor.value)
        if worth <= MATTERS * abs(floor.value - random):
            return None
        return (values - floor.value) / (ceiling.value - floor.value)

    def score(self, final: Finals) -> Estimate | None:
        """Return the mean score with its interval over seeds; None where there is none."""
        scores = self.scores(final[self.task.headline]) if final else None
        return None if scores is None else estimate(scores, mean)

    def better_than_silence(self, kind: str) -> Estimate | None:
        """Return P(a seed does better than one of the better silent learner); None where one of both is missing."""
        headline = self.task.headline
        sign = self.task.metric(headline).sign
        silent = [sign * self.learners[name].final[headline] for name in SILENT_KINDS if self._ended(name)]
        if not silent or not self._ended(kind):
            return None
        best = max(silent, key=lambda values: float(values.mean()))
        return probability_of_improvement(sign * self.learners[kind].final[headline], best)

    def _ended(self, kind: str) -> bool:
        return kind in self.learners and bool(self.learners[kind].final)

    def to_dict(self) -> dict[str, Any]:
        """Return it as plain data: what others need to compare without running it."""
        return {
            "task": self.task.name,
            "config": configuration.to_dict(next(iter(self.learners.values())).config),
            "reached": self.case.reached,
            "scripted": {who: dict(metrics) for who, metrics in self.scripted.items()},
            "floor": self.floor._asdict(),
            "ceiling": self.ceiling and self.ceiling._asdict(),
            "kinds": {kind: self._learner(kind, ended) for kind, ended in self.learners.items()},
        }

    def _learner(self, kind: str, ended: Ended) -> dict[str, Any]:
        score, better = self.score(ended.final), self.better_than_silence(kind)
        return {
            "algorithm": ended.config.algorithm.name,
            "communication": ended.config.algorithm.network.communication,
            "parameters": ended.parameters,
            "seeds": list(ended.config.seeds),
            "env_steps": ended.config.training.env_steps,
            "diverged": ended.diverged,
            "bits": ended.bits,
            "final": _listed(ended.final),
            "caught": {how: _listed(final) for how, final in ended.caught.items()},
            "curve": {"env_steps": list(ended.evaluated_at), **_listed(ended.along)},
            "score": score and list(score),
            "better_than_silence": better and list(better),
            "steps_to_.9": ended.steps_to(self.case.reached),
        }


def _listed(values: Mapping[str, Values]) -> dict[str, Any]:
    return {name: np.round(found, 4).tolist() for name, found in values.items()}


def catch(run: Planned, say: Callable[[str], None]) -> None:
    """Play a finished learner once more for each thing that happens to its messages, and keep that in its folder."""
    file = run.folder / _CAUGHT_FILE
    if file.is_file() or why_diverged(run.folder) is not None or _bits(run.config) is None:
        return
    say(f"{run.name}: playing with silenced, scrambled and late messages")
    episodes = run.config.evaluation.final_episodes
    found = {how: play(run.folder, episodes, words) for how, words in CAUGHT.items()}
    replace_json(file, {how: _plain(final) for how, final in found.items()}, indent=None)


def play(run: Path, episodes: int, intervention: str = "") -> dict[str, Values]:
    """Return every metric of each seed [S], greedy, with its messages as sent or caught."""
    played = scoring.play(str(run), episodes, intervention=interventions.parse(intervention))
    return {metric: np.asarray(values.mean(1), float) for metric, values in played.items()}


def _plain(final: Finals) -> dict[str, list[float]]:
    return {metric: values.tolist() for metric, values in final.items()}


def played(name: str, task: str, case: Case, runs: Mapping[str, Planned]) -> Played:
    """Read what the finished learners of a case came to. runs: by kind."""
    found = tasks.find(task)
    config = next(iter(runs.values())).config
    scripted = [who for who in ("random", found.silent, found.told) if who in references.playable(found)]
    episodes, env = config.evaluation.final_episodes, runs[NONE].config.env if NONE in runs else config.env
    return Played(
        name=name,
        task=found,
        case=case,
        scripted={who: references.play_scripted(who, task, env, episodes) for who in scripted},
        learners={kind: _ended(run, found, case) for kind, run in runs.items()},
    )


def _ended(run: Planned, task: Task, case: Case) -> Ended:
    parameters, bits, because = num_parameters(run.config), _bits(run.config), why_diverged(run.folder)
    if because is not None:
        return Ended(run.config, parameters, bits, {}, {}, (), {}, because)
    with reading(run.folder):
        found = results.read(run.folder, run.config)
        return Ended(
            config=run.config,
            parameters=parameters,
            bits=bits,
            final=found.final(),
            caught=_read_caught(run.folder),
            evaluated_at=found.evaluated_at,
            along={metric: found.along("greedy", metric) for metric in (task.headline, case.reached)},
        )


def _read_caught(folder: Path) -> dict[str, Finals]:
    """Return what `catch` kept; nothing where nothing can be caught."""
    file = folder / _CAUGHT_FILE
    if not file.is_file():
        return {}
    kept = json.loads(file.read_text(encoding="utf-8"))
    return {how: {metric: np.array(values) for metric, values in final.items()} for how, final in kept.items()}


def _bits(config: RunConfig) -> float | None:
    """Return the bits that an agent sends in a step; None for who says nothing that could be caught on its way."""
    network = config.algorithm.network
    if network.communication in (NONE, TOLD):
        return None
    env = tasks.find(config.task).make(config.env)
    return bits_sent(env, matched(env, network, choices(env).size))
