"""Every part of GACRL off in turn: what it is worth, at equal steps and equally many parameters.

Each part is a run folder of its own, so that a stopped ablation goes on with what is missing.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gacrl import tasks
from gacrl.algorithms.actions import choices
from gacrl.config import files as configuration
from gacrl.config.algorithms import GacrlConfig
from gacrl.config.checks import unknown
from gacrl.config.run import RunConfig
from gacrl.errors import UserError
from gacrl.evaluation.statistics import (
    Curve,
    Estimate,
    detectable,
    estimate,
    probability_of_improvement,
    sample_efficiency,
    with_interval,
)
from gacrl.experiments.study import (
    Planned,
    Watch,
    claim_folder,
    reading,
    refuse_other_settings,
    train_missing,
    why_diverged,
)
from gacrl.networks.agent import acting_parameters, matched
from gacrl.report import figures
from gacrl.report.page import Page
from gacrl.training.recorder import RunFolder

FULL, YOKED = "all parts", "yoked-exploration"
METRICS = ("coverage_final_0.1", "coverage_final_0.2", "return_agent_mean", "collisions")
SCORE = "coverage_final_0.1"
"""What a part's worth is judged by."""
EVALUATIONS = 45
"""Along a training; also the number of levels that a yoked one replays."""
EPISODES = 8
"""Of each, for the curves: the closing one is what counts, and has the preset's."""


@dataclass(frozen=True)
class Part:
    """What is taken away, and how."""

    says: str
    changes: Mapping[str, Any]


def _network(**changes: Any) -> Mapping[str, Any]:
    return {"algorithm": {"network": changes}}


def _algorithm(**changes: Any) -> Mapping[str, Any]:
    return {"algorithm": changes}


PARTS: Mapping[str, Part] = MappingProxyType(
    {
        "no-graph": Part("layers over the observation vector in place of the entity graph", _network(torso="mlp")),
        "no-messages": Part("zero rounds of messages", _network(communication="none")),
        "soft-messages": Part("symbols softened, a continuous message", _network(communication="soft")),
        "no-latent": Part("symbols made of the agent's vector, without a code", _network(latent="none")),
        "plain-code": Part("a deterministic code", _network(latent="deterministic")),
        "no-central-critic": Part("values summed, as VDN does", _algorithm(critic="sum")),
        "linear-exploration": Part("ε and τ fall with time alone", _algorithm(exploration="linear")),
        "fixed-exploration": Part("ε and τ stay at their end", _algorithm(exploration="fixed")),
        YOKED: Part("the levels of 'all parts' replayed, mean over its seeds", _algorithm(exploration="yoked")),
        "no-symmetry": Part("what is replayed is not turned", _algorithm(augment=False)),
        "plain-play": Part(
            "played in the world as it is, not by the mean over its turns", _algorithm(symmetric_play=False)
        ),
        "no-coverage-bonus": Part("MPE2's reward alone", {"env": {"reward": "mpe2"}}),
        "one-step": Part("targets of one reward", _algorithm(n_step=1)),
        "no-average": Part("played with the parameters that learn", _algorithm(averaged=False)),
    }
)
"""By what is left, as `gacrl ablate --part` names it."""


@dataclass(frozen=True)
class Outcome:
    """One of the runs, as its seeds ended."""

    name: str
    parameters: int
    """Of the acting network."""
    final: Mapping[str, NDArray[np.float64]]
    """Per metric of the closing greedy evaluation [S]; empty for a run that diverged."""
    evaluated_at: tuple[int, ...]
    along: NDArray[np.float64]
    """The score along training [S, P]."""
    epsilon: NDArray[np.float64]
    """Mean share of random actions in each stretch [S, P]."""
    diverged: str | None = None


@dataclass(frozen=True)
class Ablation:
    """A finished ablation."""

    out: Path
    report: Path
    outcomes: tuple[Outcome, ...]

    def to_dict(self) -> dict[str, Any]:
        return {"out": str(self.out), "report": str(self.report), **_data(self.outcomes)}


def ablate(
    config: RunConfig,
    out: Path,
    seeds: int = 5,
    env_steps: int | None = None,
    parts: Sequence[str] = (),
    updates: int | None = None,
    watch: Watch | None = None,
) -> Ablation | None:
    """Train what is missing under `out`, write `report.html`, `report.md` and `summary.json` there.

    parts: names in PARTS; none: all. updates: gradient steps after each rollout; none: half of the configured ones,
    with which `gacrl-112k` covers as much (docs/results.md) in little more than half the time. Returns None where
    the watcher's stop ended it early. Raises UserError for fewer than two seeds, a part there is not, settings that are
    not GACRL's, or a folder that holds something else.
    """
    watch = watch or Watch()
    if seeds < 2:
        raise UserError(f"--seeds must be at least 2, not {seeds}: with one there is no interval over seeds")
    if not isinstance(config.algorithm, GacrlConfig):
        raise UserError(f"--preset {config.preset} has no parts to take away: name a GACRL preset")
    for name in parts:
        if name not in PARTS:
            raise UserError(unknown("part", name, list(PARTS)))
    steps = config.training.env_steps if env_steps is None else env_steps
    configured = config.algorithm.updates
    updates = max(configured // 2, 1) if updates is None else updates
    config = replace(
        config,
        algorithm=replace(config.algorithm, updates=updates),
        num_seeds=seeds,
        training=replace(config.training, env_steps=steps),
        evaluation=replace(config.evaluation, interval=max(steps // EVALUATIONS, 1), num_episodes=EPISODES),
    )
    runs = plan(config, out, list(dict.fromkeys(parts)) or list(PARTS))
    asked = {"config": configuration.to_dict(config)}
    claim_folder(out, "ablate.json", asked, "ablation", lambda held: "another ablation: choose another --out")
    refuse_other_settings([run for run in runs if run.name != YOKED])  # its settings come from a run
    watch.planned([run.name for run in runs])
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
    outcomes = tuple(_outcome(run) for run in runs)
    done = Ablation(out, _report(out, config, configured, outcomes), outcomes)
    (out / "summary.json").write_text(json.dumps(_data(outcomes), indent=2) + "\n", encoding="utf-8")
    return done


def plan(config: RunConfig, out: Path, parts: Sequence[str]) -> list[Planned]:
    """The run with all parts, and one without each; the yoked one lacks the levels, which the first will give."""
    wanted = _num_parameters(config)
    runs = [Planned(FULL, config, out / "all-parts")]
    for name in parts:
        changes = dict(PARTS[name].changes)
        if "network" in changes.get("algorithm", {}):
            network = {**changes["algorithm"]["network"], "parameters": wanted}
            changes["algorithm"] = {**changes["algorithm"], "network": network}
        if name == YOKED:
            changes["algorithm"] = {**changes["algorithm"], "yoked_coverage": [0.0]}
        runs.append(Planned(name, configuration.from_dict(changes, config), out / name))
    return runs


def _yoked(run: Planned, full: Planned) -> Planned:
    """With the coverage that the full runs' exploration followed, the mean over seeds; read back from its ε."""
    algorithm = full.config.algorithm
    assert isinstance(algorithm, GacrlConfig)
    span = algorithm.epsilon - algorithm.epsilon_end
    missing = np.clip((_outcome(full).epsilon - algorithm.epsilon_end) / (span or 1.0), 0.0, 1.0)
    coverage = 1.0 - np.sqrt(missing.mean(0))
    changes = _algorithm(yoked_coverage=[round(float(value), 4) for value in coverage])
    return replace(run, config=configuration.from_dict(changes, run.config))


def _num_parameters(config: RunConfig) -> int:
    env = tasks.make(config.env)
    network = config.algorithm.network  # pyright: ignore[reportAttributeAccessIssue] GACRL's, checked
    actions = choices(env).size
    return acting_parameters(env, matched(env, network, actions), actions)


def _outcome(run: Planned) -> Outcome:
    """Read a finished run."""
    nothing = np.zeros((0, 0))
    because = why_diverged(run.folder)
    if because is not None:
        return Outcome(run.name, _num_parameters(run.config), {}, (), nothing, nothing, because)
    with reading(run.folder):
        return _read_outcome(run)


def _read_outcome(run: Planned) -> Outcome:
    folder = RunFolder.open(run.folder)
    summary = json.loads(folder.summary_file.read_text(encoding="utf-8"))
    rows = folder.metrics()
    steps = tuple(sorted({row["env_steps"] for row in rows}))
    by_seed = [[row for row in rows if row["seed"] == seed] for seed in run.config.seeds]
    return Outcome(
        name=run.name,
        parameters=_num_parameters(run.config),
        final={metric: np.array(summary["final"]["greedy"][metric]["values"]) for metric in METRICS},
        evaluated_at=steps,
        along=np.array([[row["greedy"][SCORE] for row in seed] for seed in by_seed]),
        epsilon=np.array([[row["update"]["epsilon"] for row in seed] for seed in by_seed]),
    )


def _data(outcomes: Sequence[Outcome]) -> dict[str, Any]:
    full = outcomes[0]
    return {
        "runs": [
            {
                "name": outcome.name,
                "parameters": outcome.parameters,
                "diverged": outcome.diverged,
                "final": {metric: values.tolist() for metric, values in outcome.final.items()},
                "intervals": {metric: list(estimate(values)) for metric, values in outcome.final.items()},
                "probability_that_the_part_helps": _worth(full, outcome),
                "env_steps": list(outcome.evaluated_at),
                "along": outcome.along.tolist(),
                "epsilon": outcome.epsilon.tolist(),
            }
            for outcome in outcomes
        ]
    }


def _worth(full: Outcome, without: Outcome) -> Estimate | None:
    """P(a seed with all parts scores higher than one without this), and its interval."""
    if without is full or not full.final or not without.final:
        return None
    return probability_of_improvement(full.final[SCORE], without.final[SCORE])


def _report(out: Path, config: RunConfig, configured: int, outcomes: Sequence[Outcome]) -> Path:
    """configured: gradient steps after each rollout, as they were before the ablation chose its own."""
    page = Page("What each part of GACRL is worth")
    page.text(
        f"{config.preset}, {config.training.env_steps:,} environment steps in episodes of {config.env.max_cycles}, "
        f"{_updates(config)} gradient steps after every {config.steps_per_update} (the preset has "
        f"{configured}), {config.num_seeds} seeds from {config.seed}; closing "
        f"evaluation: {config.evaluation.final_episodes} fixed episodes, greedy, last parameters, MPE2's own reward. "
        "Interquartile mean over seeds and its 95 % stratified-bootstrap interval. Where a part of the "
        "acting network is off, the rest is wider, so that it has about as many parameters; the central critic, which "
        "does not act, is left out of that count."
    )
    rows: list[list[str]] = []
    for outcome in outcomes:
        says = PARTS[outcome.name].says if outcome.name in PARTS else "nothing taken away"
        if outcome.diverged is not None:
            cells = [f"diverged: {outcome.diverged}", *[""] * (len(METRICS) + 1)]
        else:
            worth = _worth(outcomes[0], outcome)
            cells = [with_interval(estimate(values)) for values in outcome.final.values()]
            if worth is None:
                cells += ["", ""]
            else:
                cells += [with_interval(worth, ".2f"), _detectable(outcomes[0], outcome)]
        rows.append([outcome.name, says, f"{outcome.parameters:,}", *cells])
    page.table(("", "what it is", "parameters", *METRICS, "P(the part helps)", "detectable"), rows)
    page.text(
        f"P(the part helps): the probability that a seed with all parts ends with a higher {SCORE} than one without "
        "it. It is claimed where it is .95 or more and its interval lies above .5; fewer than 10 seeds indicate. "
        f"Detectable: the smallest difference of mean {SCORE} that so many seeds would show in 80 % of all repetitions."
    )
    ended = [outcome for outcome in outcomes if outcome.diverged is None]
    page.figure(
        figures.dots(
            {outcome.name: outcome.final[SCORE] for outcome in ended},
            {outcome.name: estimate(outcome.final[SCORE]) for outcome in ended},
            SCORE,
        ),
        "Every seed is a dot, below them the interquartile mean and its 95 % interval.",
        "parts",
    )
    page.heading("Along training")
    page.figure(
        figures.curves(
            {o.name: _series(o, sample_efficiency(o.along)) for o in ended}, "environment steps", SCORE
        ),
        f"{SCORE} of {config.evaluation.num_episodes} greedy episodes: interquartile mean, 95 % interval.",
        "curves",
    )
    exploring = [o for o in ended if o.name == FULL or "exploration" in o.name]
    page.heading("Exploration")
    page.text(
        "How much is explored against what greedy play covers, in the same stretch of training: with the feedback "
        "the level falls when the coverage rises, and not before."
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
            {o.name: _against_coverage(o) for o in exploring}, f"{SCORE}, greedy, mean over seeds", "ε"
        ),
        "The level of exploration against coverage: mean over seeds at each evaluation, ordered by coverage.",
        "level-against-coverage",
    )
    page.heading("How this was made")
    page.code(_command(config, outcomes))
    return page.write(out, "report")


def _detectable(full: Outcome, without: Outcome) -> str:
    return f"{detectable(full.final[SCORE], without.final[SCORE]):.3f}"


def _updates(config: RunConfig) -> int:
    assert isinstance(config.algorithm, GacrlConfig)
    return config.algorithm.updates


def _series(outcome: Outcome, curve: Curve) -> figures.Series:
    return outcome.evaluated_at, curve.point, curve.low, curve.high, None


def _against_coverage(outcome: Outcome) -> figures.Series:
    coverage, level = outcome.along.mean(0), outcome.epsilon.mean(0)
    order = np.argsort(coverage, kind="stable")
    return coverage[order], level[order], None, None, None


def _command(config: RunConfig, outcomes: Sequence[Outcome]) -> str:
    words = ["gacrl ablate", f"--preset {config.preset}", f"--seeds {config.num_seeds}", f"--seed {config.seed}"]
    words += [f"--env-steps {config.training.env_steps}", f"--updates {_updates(config)}"]
    if len(outcomes) <= len(PARTS):
        words += [f"--part {outcome.name}" for outcome in outcomes[1:]]
    return " ".join(words)
