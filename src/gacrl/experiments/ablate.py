"""Every part of GACRL off in turn: what it is worth, at equal steps and equally many parameters.

Each part is a run folder of its own, so that a stopped ablation goes on with what is missing.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, SupportsIndex

import numpy as np

from gacrl import tasks
from gacrl.config import files as configuration
from gacrl.config.algorithms import GacrlConfig
from gacrl.config.checks import unknown, whole
from gacrl.config.run import RunConfig
from gacrl.errors import UserError
from gacrl.evaluation.statistics import (
    Curve,
    estimate,
    sample_efficiency,
    with_interval,
)
from gacrl.experiments import results
from gacrl.experiments.parts import NO_MESSAGES, YOKED, parts_of
from gacrl.experiments.provenance import Versions, code_of, doubts, made_by
from gacrl.experiments.results import Finals, Values, reading, why_diverged
from gacrl.experiments.study import (
    Planned,
    Watch,
    claim_folder,
    refuse_other_settings,
    train_missing,
)
from gacrl.experiments.talking.kinds import num_parameters
from gacrl.experiments.worth import CLAIMED_FROM, remarkable, worths
from gacrl.replacing import replace_json
from gacrl.report import figures
from gacrl.report.page import Page
from gacrl.tasks.task import Task

FULL = "all parts"
EVALUATIONS = 45
"""Along a training; also the number of levels that a yoked one replays."""
EPISODES = 8
"""Of each, for the curves: the closing one is what counts, and has the preset's."""


@dataclass(frozen=True)
class Outcome:
    """One of the runs, as its seeds ended."""

    name: str
    parameters: int
    """Of the acting network."""
    final: Finals
    """Per metric of the closing greedy evaluation [S]; empty for a run that diverged."""
    evaluated_at: tuple[int, ...]
    along: Values
    """The task's headline along training [S, P]."""
    epsilon: Values
    """Mean share of random actions in each stretch [S, P]."""
    diverged: str | None = None


@dataclass(frozen=True)
class Ablation:
    """A finished ablation."""

    out: Path
    report: Path
    task: Task
    outcomes: tuple[Outcome, ...]
    made_by: Sequence[Versions]
    """The versions that trained the runs."""

    def to_dict(self) -> dict[str, Any]:
        return {"out": str(self.out), "report": str(self.report), **self.results()}

    def results(self) -> dict[str, Any]:
        """Return every seed's values, what is said of each part, and the versions that trained the runs."""
        return {**_data(self.task, self.outcomes), "versions": list(self.made_by)}


def ablate(
    config: RunConfig,
    out: Path,
    seeds: SupportsIndex = 5,
    env_steps: SupportsIndex | None = None,
    parts: Sequence[str] = (),
    updates: SupportsIndex | None = None,
    watch: Watch | None = None,
) -> Ablation | None:
    """Train what is missing under `out`, write `report.html`, `report.md` and `summary.json` there.

    parts: names in `parts_of`; none: all. updates: gradient steps after each rollout; none: all of the configured ones
    on tasks that need talk, elsewhere half, with which `gacrl-112k` covers as much (docs/results.md) in little more
    than half the time. Returns None where the watcher's stop ended it early. Raises UserError for fewer than two seeds,
    a part there is not, settings that are not GACRL's, or a folder that holds something else.
    """
    watch, seeds, out = watch or Watch(), whole(seeds, "seeds"), out.absolute()
    if seeds < 2:
        raise UserError(f"--seeds must be at least 2, not {seeds}: with one there is no interval over seeds")
    if not isinstance(config.algorithm, GacrlConfig):
        raise UserError(f"--preset {config.preset} has no parts to take away: name a GACRL preset")
    known = parts_of(config)
    for name in parts:
        if name not in known:
            raise UserError(unknown("part", name, list(known)))
    steps = config.training.env_steps if env_steps is None else whole(env_steps, "env_steps")
    configured = config.algorithm.updates
    usual = configured if tasks.find(config.task).needs_talk else max(configured // 2, 1)
    updates = usual if updates is None else whole(updates, "updates")
    config = replace(
        config,
        algorithm=replace(config.algorithm, updates=updates),
        num_seeds=seeds,
        training=replace(config.training, env_steps=steps),
        evaluation=replace(config.evaluation, interval=max(steps // EVALUATIONS, 1), num_episodes=EPISODES),
    )
    runs = plan(config, out, list(dict.fromkeys(parts)) or list(known))
    asked = {"config": configuration.to_dict(config)}
    claim_folder(out, "ablate.json", asked, "ablation", lambda held: "another ablation: choose another --out")
    refuse_other_settings([run for run in runs if run.name != YOKED])  # its settings come from a run
    watch.planned({run.name: parts_of(config)[run.name].says if run.name != FULL else "" for run in runs})
    if not train_missing(runs[:1], watch):
        return None
    because = why_diverged(runs[0].folder)
    if because is not None:
        raise UserError(f"there is nothing to compare with: with all parts, {because}")
    runs = [_yoked(run, runs[0]) if run.name == YOKED else run for run in runs]
    refuse_other_settings(runs)
    if not train_missing(runs[1:], watch):
        return None
    watch.say("writing the report")
    task, outcomes = tasks.find(config.task), tuple(_outcome(run) for run in runs)
    made = made_by(run.folder for run in runs)
    done = Ablation(out, _report(out, config, configured, outcomes, made), task, outcomes, made)
    replace_json(out / "summary.json", done.results())
    return done


def plan(config: RunConfig, out: Path, parts: Sequence[str]) -> list[Planned]:
    """Return the run with all parts, and one without each; the yoked one lacks the levels, which the first will
    give.
    """
    wanted, known = num_parameters(config), parts_of(config)
    runs = [Planned(FULL, config, out / "all-parts")]
    for name in parts:
        changes = dict(known[name].changes)
        config_of_part = configuration.with_critic(config, "central") if name == NO_MESSAGES else config
        if "network" in changes.get("algorithm", {}):
            network = {**changes["algorithm"]["network"], "parameters": wanted}
            changes["algorithm"] = {**changes["algorithm"], "network": network}
        if name == YOKED:
            changes["algorithm"] = {**changes["algorithm"], "yoked_progress": [0.0]}
        runs.append(Planned(name, configuration.from_dict(changes, config_of_part), out / name))
    return runs


def _yoked(run: Planned, full: Planned) -> Planned:
    """With the progress that the full runs' exploration followed, the mean over seeds; read back from its ε."""
    algorithm = full.config.algorithm
    assert isinstance(algorithm, GacrlConfig)
    span = algorithm.epsilon - algorithm.epsilon_end
    missing = np.clip((_outcome(full).epsilon - algorithm.epsilon_end) / (span or 1.0), 0.0, 1.0)
    progress = 1.0 - np.sqrt(missing.mean(0))
    changes = {"algorithm": {"yoked_progress": [round(float(value), 4) for value in progress]}}
    return replace(run, config=configuration.from_dict(changes, run.config))


def _outcome(run: Planned) -> Outcome:
    """Read a finished run."""
    nothing = np.zeros((0, 0))
    because = why_diverged(run.folder)
    if because is not None:
        return Outcome(run.name, num_parameters(run.config), {}, (), nothing, nothing, because)
    with reading(run.folder):
        found = results.read(run.folder, run.config)
        return Outcome(
            name=run.name,
            parameters=num_parameters(run.config),
            final=found.final(),
            evaluated_at=found.evaluated_at,
            along=found.along("greedy", tasks.find(run.config.task).headline),
            epsilon=found.along("update", "epsilon"),
        )


def _data(task: Task, outcomes: Sequence[Outcome]) -> dict[str, Any]:
    full = outcomes[0]
    runs: list[dict[str, Any]] = []
    for outcome in outcomes:
        found = {} if outcome is full else worths(task, full.final, outcome.final)
        runs.append(
            {
                "name": outcome.name,
                "parameters": outcome.parameters,
                "diverged": outcome.diverged,
                "final": {metric: values.tolist() for metric, values in outcome.final.items()},
                "intervals": {metric: list(estimate(values)) for metric, values in outcome.final.items()},
                "probability_that_the_part_helps": {m: list(worth.probability) for m, worth in found.items()}
                or None,
                "with_it_less_without": {m: list(worth.difference[:3]) for m, worth in found.items()} or None,
                "said": {m: worth.said for m, worth in remarkable(found).items()},
                "env_steps": list(outcome.evaluated_at),
                "along": outcome.along.tolist(),
                "epsilon": outcome.epsilon.tolist(),
            }
        )
    return {"runs": runs}


def _report(
    out: Path, config: RunConfig, configured: int, outcomes: Sequence[Outcome], made: Sequence[Versions]
) -> Path:
    """configured: gradient steps after each rollout, as they were before the ablation chose its own."""
    page, task = Page("What each part of GACRL is worth"), tasks.find(config.task)
    horizon = task.make(config.env).max_cycles
    page.text(
        f"{config.preset} on {task.name}, {config.training.env_steps:,} environment steps in episodes of {horizon}, "
        f"{_updates(config)} gradient steps after every {config.steps_per_update} (the preset has "
        f"{configured}), {config.num_seeds} seeds from {config.seed}; closing "
        f"evaluation: {config.evaluation.final_episodes} fixed episodes, greedy, last parameters, the task's own "
        "return. Interquartile mean over seeds and its 95 % stratified-bootstrap interval. Where a part of the "
        "acting network is off, the rest is wider, so that it has about as many parameters; the central critic, which "
        "does not act, is left out of that count."
    )
    for sentence in doubts(made):
        page.text(sentence)
    _results(page, task, config, outcomes)
    _what_parts_are_worth(page, task, outcomes)
    ended = [outcome for outcome in outcomes if outcome.diverged is None]
    axis = task.metric(task.headline).axis
    page.figure(
        figures.dots(
            {outcome.name: outcome.final[task.headline] for outcome in ended},
            {outcome.name: estimate(outcome.final[task.headline]) for outcome in ended},
            axis,
        ),
        "Every seed is a dot, below them the interquartile mean and its 95 % interval.",
        "parts",
    )
    page.heading("Along training")
    page.figure(
        figures.curves(
            {o.name: _series(o, sample_efficiency(o.along)) for o in ended},
            "environment steps",
            axis,
        ),
        f"{task.headline} of {config.evaluation.num_episodes} greedy episodes: interquartile mean, 95 % interval.",
        "curves",
    )
    _exploration(page, task, ended)
    page.heading("How this was made")
    page.code(_command(config, outcomes))
    page.text(code_of(made))
    return page.write(out, "report")


def _exploration(page: Page, task: Task, ended: Sequence[Outcome]) -> None:
    """How much was explored, along training and against what greedy play reached."""
    exploring = [o for o in ended if o.name == FULL or "exploration" in o.name]
    page.heading("Exploration")
    page.text(
        "How much is explored against what greedy play reaches, in the same stretch of training: with the feedback "
        "the level falls when that rises, and not before."
    )
    page.figure(
        figures.curves(
            {o.name: _series(o, sample_efficiency(o.epsilon)) for o in exploring},
            "environment steps",
            "ε, mean over the stretch",
        ),
        "The level of exploration along training.",
        "levels",
    )
    page.figure(
        figures.curves(
            {o.name: _against_headline(o) for o in exploring}, f"{task.headline}, greedy, mean over seeds", "ε"
        ),
        f"The level of exploration against {task.headline}: mean over seeds at each evaluation, ordered by the latter.",
        "level-against-headline",
    )


def _results(page: Page, task: Task, config: RunConfig, outcomes: Sequence[Outcome]) -> None:
    """Add what each of the runs reached."""
    shown = task.shown(list(outcomes[0].final))
    rows: list[list[str]] = []
    known = parts_of(config)
    for outcome in outcomes:
        says = known[outcome.name].says if outcome.name in known else "nothing taken away"
        if outcome.diverged is not None:
            cells = [f"diverged: {outcome.diverged}", *[""] * (len(shown) - 1)]
        else:
            cells = [with_interval(estimate(outcome.final[metric])) for metric in shown]
        rows.append([outcome.name, says, f"{outcome.parameters:,}", *cells])
    page.table(("", "what it is", "parameters", *shown), rows)


def _what_parts_are_worth(page: Page, task: Task, outcomes: Sequence[Outcome]) -> None:
    """Add what may be said of each part in any metric, and the probabilities in those of the tables."""
    full = outcomes[0]
    shown = task.shown(list(full.final))
    found = {o.name: worths(task, full.final, o.final) for o in outcomes[1:] if o.diverged is None}
    page.heading("What each part does")
    rows = [
        [name, worth.said, metric, with_interval(worth.difference), with_interval(worth.probability, ".2f")]
        for name, by_metric in found.items()
        for metric, worth in remarkable(by_metric).items()
    ]
    if rows:
        page.table(("part", "it", "in", "with it less without", "probability that it helps"), rows)
    page.text(
        f"All {len(full.final)} metrics of the task are judged, for better and for worse. A part helps where a seed "
        "with it ends better than one without in .95 or more of all pairs and the interval lies above .5; where it is "
        f"the other way round, it costs. That is claimed from {CLAIMED_FROM} seeds on; with fewer it says what may be. "
        "Of so many comparisons a few come out by chance."
        + ("" if rows else " Here nothing may be said of any part.")
    )
    page.heading("The probability that a part helps")
    rows = []
    for name, by_metric in found.items():
        cells = [with_interval(by_metric[metric].probability, ".2f") for metric in shown]
        rows.append([name, *cells, f"{by_metric[task.headline].difference.detectable:.3f}"])
    page.table(("without", *shown, f"detectable {task.headline}"), rows)
    page.text(
        "The probability that a seed with all parts ends with a better value than one without this one. Detectable: "
        f"the smallest difference of mean {task.headline} that so many seeds would show in 80 % of all repetitions."
    )


def _updates(config: RunConfig) -> int:
    assert isinstance(config.algorithm, GacrlConfig)
    return config.algorithm.updates


def _series(outcome: Outcome, curve: Curve) -> figures.Series:
    return outcome.evaluated_at, curve.point, curve.low, curve.high, None


def _against_headline(outcome: Outcome) -> figures.Series:
    reached, level = outcome.along.mean(0), outcome.epsilon.mean(0)
    order = np.argsort(reached, kind="stable")
    return reached[order], level[order], None, None, None


def _command(config: RunConfig, outcomes: Sequence[Outcome]) -> str:
    words = ["gacrl ablate", f"--preset {config.preset}", f"--seeds {config.num_seeds}", f"--seed {config.seed}"]
    words += [f"--env-steps {config.training.env_steps}", f"--updates {_updates(config)}"]
    words += [flag] if (flag := tasks.flag(config.task, as_given=True).strip()) else []
    if len(outcomes) <= len(parts_of(config)):
        words += [f"--part {outcome.name}" for outcome in outcomes[1:]]
    return " ".join(words)
