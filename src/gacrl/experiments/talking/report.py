"""The page of the study of talk: scores of all tasks and kinds, then a task at a time."""

from collections.abc import Mapping, Sequence

import numpy as np

from gacrl.config.run import RunConfig
from gacrl.evaluation.statistics import estimate, mean, sample_efficiency, with_interval
from gacrl.experiments.provenance import Versions, code_of, doubts
from gacrl.experiments.talking.cells import CAUGHT, REACHED, Ended, Finals, Played
from gacrl.experiments.talking.kinds import SYMBOLS, kinds
from gacrl.report import figures
from gacrl.report.page import Page


def page(
    cases: Mapping[str, Played],
    config: RunConfig,
    seeds: int,
    trials: int,
    command: str,
    versions: Sequence[Versions],
) -> Page:
    """Make the page of what is there. config: the settings that the learners start from. trials: of each."""
    made = Page("Which tasks need talk, and which talk do they need?")
    made.text(
        f"The learner of {config.preset} with every kind of communication, and other learners with symbols, at about "
        f"as many parameters; {seeds} seeds from {config.seed}. Greedy, last parameters, fixed episodes. A score is 0 "
        "at the best silent policy, scripted or trained, and 1 at the best one that is told everything; in brackets "
        "the 95 % bootstrap interval over seeds, with both ends of the scale as they are."
    )
    made.text(
        f"Every learner took the best of {trials} learning rates, found on two seeds of their own from 1000."
        if trials > 1
        else "Settings that the preset brings were found for symbols. No other kind of communication was tuned."
    )
    for sentence in doubts(versions):
        made.text(sentence)
    made.table(("", *cases), scores(cases), "Scores.")
    names = kinds_in(cases)
    if cases:
        grid = np.array([[_point(case, case.learners.get(kind)) for case in cases.values()] for kind in names])
        drawn = figures.heat(grid[None], ("", [""]), ("", names), ("", list(cases)), "score")
        made.figure(
            drawn, "Mean score over seeds: 0 as the best silent policy, 1 as one that is told all.", "scores"
        )
    for case in cases.values():
        _case(made, case)
    made.heading("How this was made")
    made.text(
        f"Steps to {REACHED:g}: the first of two evaluations in a row from there on, along training, of the seeds that "
        "came so far. Silenced: nobody hears anybody. Scrambled: every agent is heard with its words from another "
        "episode. Bits are those that an agent sends in a step of greedy play; a number counts 32."
    )
    made.code(command)
    made.text(code_of(versions))
    return made


def scores(cases: Mapping[str, Played]) -> list[list[str]]:
    """Write a row for each learner: its name, and its score in each case."""
    return [
        [kind, *(_score(case, case.learners.get(kind)) for case in cases.values())] for kind in kinds_in(cases)
    ]


def kinds_in(cases: Mapping[str, Played]) -> list[str]:
    """List the learners that are there, in the order of the study."""
    found = {kind for case in cases.values() for kind in case.learners}
    return [kind for kind in kinds() if kind in found]


def _case(made: Page, case: Played) -> None:
    """Add a task: who learned what, what their messages did, and curves."""
    shown = _shown(case)
    made.heading(case.name)
    made.text(_says(case))
    says = kinds()
    rows = [
        [
            kind,
            says[kind].says,
            f"{ended.config.training.env_steps:,}",
            f"{ended.parameters:,}",
            "" if ended.bits is None else f"{ended.bits:.0f}",
            *_results(case, ended),
            _steps(ended.steps_to(case.case.reached)),
        ]
        for kind, ended in case.learners.items()
    ]
    columns = ("", "what agents hear", "steps", "parameters", "bits", "score", *shown, "every seed")
    made.table((*columns, f"steps to {REACHED:g}"), rows)
    caught = {kind: ended for kind, ended in case.learners.items() if ended.caught}
    if caught:
        made.table(
            ("", "as sent", *CAUGHT),
            [
                [kind, _score(case, e), *(_scored(case, e.caught[how]) for how in CAUGHT)]
                for kind, e in caught.items()
            ],
            "Scores of the same agents, by what happens to their messages.",
        )
    _curves(made, case)


def _curves(made: Page, case: Played) -> None:
    """Add a figure of the learners that took equally many steps."""
    headline, floor, ceiling = case.task.headline, case.floor, case.ceiling
    equally_long = min(ended.config.training.env_steps for ended in case.learners.values())
    curves = {
        kind: (ended.evaluated_at, *_band(ended, headline), None)
        for kind, ended in case.learners.items()
        if ended.final and ended.config.training.env_steps == equally_long
    }
    if not curves:
        return
    lines = {f"floor: {floor.who}": floor.value}
    lines |= {f"ceiling: {ceiling.who}": ceiling.value} if ceiling else {}
    drawn = figures.curves(curves, "environment steps", case.task.metric(headline).axis, lines, begin=0.0)
    made.figure(drawn, f"{headline} along training: mean over seeds and its 95 % interval.", f"case-{case.name}")


def _says(case: Played) -> str:
    """Say where the scale ends, and whether symbols do better than silence."""
    floor, ceiling = case.floor, case.ceiling
    sentence = f"Best silent policy: {floor.who}, {floor.value:.2f}."
    if ceiling is not None:
        sentence += f" Best told one: {ceiling.who}, {ceiling.value:.2f}."
    better = case.better_than_silence(SYMBOLS)
    if better is not None:
        sentence += (
            f" A seed with symbols does better than one of the better silent learner with probability "
            f"{with_interval(better, '.2f')}."
        )
    return sentence


def _results(case: Played, ended: Ended) -> list[str]:
    """Write score, headline and what is to be reached, and every seed of the last."""
    if not ended.final:
        return [f"diverged: {ended.diverged}", *[""] * len(_shown(case)), ""]
    cells = [with_interval(estimate(ended.final[metric], mean), ".2f") for metric in _shown(case)]
    seeds = " ".join(f"{value:.2f}" for value in ended.final[case.case.reached])
    return [_score(case, ended), *cells, seeds]


def _shown(case: Played) -> list[str]:
    """Return the headline and what is to be reached: one, where they are the same."""
    return list(dict.fromkeys((case.task.headline, case.case.reached)))


def _score(case: Played, ended: Ended | None) -> str:
    return "" if ended is None else "diverged" if not ended.final else _scored(case, ended.final)


def _scored(case: Played, final: Finals) -> str:
    found = case.score(final)
    return "–" if found is None else with_interval(found, ".2f")


def _point(case: Played, ended: Ended | None) -> float:
    found = None if ended is None else case.score(ended.final)
    return float("nan") if found is None else found.point


def _band(ended: Ended, metric: str) -> tuple[figures.Numbers, figures.Numbers, figures.Numbers]:
    curve = sample_efficiency(ended.along[metric], mean)
    return curve.point, curve.low, curve.high


def _steps(steps: list[int | None]) -> str:
    """Write the median of the seeds that came so far, and how many they are."""
    came = [step for step in steps if step is not None]
    return f"{np.median(came):,.0f} ({len(came)} of {len(steps)})" if came else f"never ({len(steps)})"
