"""Does a task need talk, and do the agents use it? Silent, talking and told learners at equal steps and sizes.

Each learner is a run folder of its own, so that a stopped study resumes with what is missing. The talking learner is
then played with its messages silenced, scrambled and delayed: only that shows whether anybody listens.
"""

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

from gacrl import tasks
from gacrl.config import files as configuration
from gacrl.config.run import RunConfig
from gacrl.errors import UserError
from gacrl.evaluation.statistics import (
    Difference,
    Estimate,
    difference,
    estimate,
    mean,
    probability_of_improvement,
    with_interval,
)
from gacrl.experiments import scoring
from gacrl.experiments.provenance import Versions, code_of, doubts, made_by
from gacrl.experiments.results import Finals, Values, why_diverged
from gacrl.experiments.study import (
    Planned,
    Watch,
    claim_folder,
    refuse_other_settings,
    train_missing,
)
from gacrl.experiments.talking.cells import CAUGHT, play
from gacrl.experiments.talking.kinds import KIND_OF, hears_by, num_parameters, talker
from gacrl.experiments.talking.known import Known, read
from gacrl.replacing import replace_json
from gacrl.report import figures
from gacrl.report.page import Page
from gacrl.tasks.task import HEADLINE, MATTERS, Task

SILENT, TALKING, TOLD = LEARNERS = ("silent", "talking", "told")
_HEARD: Mapping[str, str] = MappingProxyType(
    {
        SILENT: "nobody hears anybody",
        TALKING: "agents send symbols",
        TOLD: "agents hear what their neighbours see",
    }
)
SENT, SCRAMBLED = "as sent", "scrambled"
PLAYED: Mapping[str, str] = MappingProxyType({SENT: "", **CAUGHT})
"""What happens to the talking learner's messages, and the intervention that does it."""
ENV_STEPS = 40_000
EVALUATIONS = 8


class Answer(NamedTuple):
    """Whether a task needs talk, and whether the agents use it; in returns, over seeds."""

    worth: Difference
    """Told less silent."""
    used: Estimate
    """The talking learner, as sent less scrambled across episodes, seed by seed."""
    random: float
    needs: bool
    """The lower bound of `worth` is above 5 % of what silent agents gain over random ones."""
    uses: bool
    """The lower bound of `used` is above 5 % of what told agents gain over silent ones."""


@dataclass(frozen=True)
class Talk:
    """A finished study of one task."""

    out: Path
    report: Path
    config: RunConfig
    parameters: Mapping[str, int]
    """Of each learner's acting network."""
    returns: Finals
    """Of each learner, greedy, last parameters: a number for each seed [S]."""
    played: Finals
    """Of the talking learner by what happens to its messages [S]."""
    answer: Answer
    further: Mapping[str, Finals] = field(default_factory=dict)
    """The other metrics of the task's tables, by their labels: of each learner and of what is played, as `measured`."""
    made_by: Sequence[Versions] = ()
    """The versions that trained the learners."""
    known: Known | None = None
    """The silent and the told learner, if they were trained before."""

    @property
    def measured(self) -> dict[str, dict[str, Values]]:
        """Every metric of the tables by its label: of the learners, then of the talking one with other messages [S]."""
        caught = {f"{TALKING}, {how}": values for how, values in self.played.items() if how != SENT}
        further = {label: dict(values) for label, values in self.further.items()}
        return {"return per agent": {**self.returns, **caught}, **further}

    @property
    def improvement(self) -> Estimate:
        """P(a talking seed earns more than a silent one)."""
        return probability_of_improvement(self.returns[TALKING], self.returns[SILENT])

    @property
    def task(self) -> Task:
        """What was learned."""
        return tasks.find(self.config.task)

    @property
    def sentence(self) -> str:
        """The answer in words, with intervals."""
        worth, used = self.answer.worth, self.answer.used
        gained = with_interval(worth, ".2f")
        if not self.answer.needs:
            return (
                f"{self.task.name} needs no talk that {len(self.returns[TOLD])} seeds can show: agents that are told "
                f"what others see earn {gained} more than silent ones. Scrambling their words costs talking agents "
                f"{with_interval(used, '.2f')}."
            )
        share = f", {100 * used.point / worth.point:.0f} % of that"
        verdict = "use it" if self.answer.uses else "do not use it"
        return (
            f"{self.task.name} needs talk: agents that are told what others see earn {gained} more than silent ones. "
            f"These agents {verdict}: scrambling their words costs them {with_interval(used, '.2f')}{share}."
        )

    def to_dict(self) -> dict[str, Any]:
        """Return all of it as plain data."""
        answer = self.answer
        return {
            "out": str(self.out),
            "report": str(self.report),
            "task": self.task.name,
            "config": configuration.to_dict(self.config),
            "parameters": dict(self.parameters),
            "returns": {name: values.tolist() for name, values in self.returns.items()},
            "played": {name: values.tolist() for name, values in self.played.items()},
            "further": {
                label: {name: values.tolist() for name, values in measured.items()}
                for label, measured in self.further.items()
            },
            "improvement": list(self.improvement),
            "worth": list(answer.worth[:3]),
            "used": list(answer.used),
            "random": answer.random,
            "known": "" if self.known is None else self.known.says,
            "needs_talk": answer.needs,
            "uses_talk": answer.uses,
            "sentence": self.sentence,
            "versions": list(self.made_by),
        }


def talk(
    config: RunConfig,
    out: Path,
    seeds: int = 3,
    env_steps: int = ENV_STEPS,
    watch: Watch | None = None,
    known: Path | None = None,
) -> Talk | None:
    """Train what is missing under `out`, play it, and write `report.html`, `report.md` and `summary.json` there.

    config: of the talking learner. seeds: of each. env_steps: of each seed. known: a file of silent and told learners,
    which then are not trained. Returns None where the watcher's stop ended it early. Raises UserError for fewer than
    two seeds, a single agent, words that are actions, a preset whose agents cannot talk, a file without those learners,
    or a folder that holds something else.
    """
    watch = watch or Watch()
    if seeds < 2:
        raise UserError(f"--seeds must be at least 2, not {seeds}: with one there is no interval over seeds")
    config = talker(config, seeds, env_steps, env_steps // EVALUATIONS)
    before = None if known is None else read(known, config)
    runs = [run for run in plan(config, out) if before is None or run.name not in before.finals]
    asked = {"config": configuration.to_dict(config)}
    claim_folder(out, "talk.json", asked, "study of talk", lambda held: "another study: choose another --out")
    refuse_other_settings(runs)
    watch.planned({run.name: _HEARD[run.name] for run in runs})
    if not train_missing(runs, watch):
        return None
    watch.say("playing with silenced, scrambled and late messages")
    done = _read(out, runs, before)
    page = _report(done)
    done = replace(done, report=page.write(out, "report"))
    replace_json(out / "summary.json", done.to_dict())
    return done


def plan(config: RunConfig, out: Path) -> list[Planned]:
    """Plan the three learners. The silent and the told one are as large as the talking one."""
    parameters = num_parameters(config)
    return [Planned(name, hears_by(KIND_OF[name], config, parameters), out / name) for name in LEARNERS]


def answer(returns: Finals, played: Finals, random: float) -> Answer:
    """Judge the returns [S] of the learners, of the talking one by what happens to its messages, and of random."""
    worth = difference(returns[TOLD], returns[SILENT], mean)
    used = estimate(played[SENT] - played[SCRAMBLED], mean)
    learned = float(returns[SILENT].mean()) - random
    needs = worth.low > MATTERS * max(learned, 0.0)
    return Answer(worth, used, random, needs, used.low > MATTERS * max(worth.point, 0.0))


def _read(out: Path, runs: Sequence[Planned], known: Known | None) -> Talk:
    """Play the finished learners; those that are known were played before."""
    for run in runs:
        because = why_diverged(run.folder)
        if because is not None:
            raise UserError(f"there is no answer: the {run.name} learner {because}")
    [(config, talking)] = [(run.config, run.folder) for run in runs if run.name == TALKING]
    episodes = config.evaluation.final_episodes
    found = {run.name: play(run.folder, episodes) for run in runs} | dict(known.finals if known else {})
    greedy = {name: found[name] for name in LEARNERS}
    caught = {name: play(talking, episodes, how) if how else greedy[TALKING] for name, how in PLAYED.items()}
    every = {**greedy, **{f"{TALKING}, {name}": values for name, values in caught.items() if name != SENT}}
    shared = [metric for metric in greedy[TALKING] if all(metric in values for values in greedy.values())]
    shown = tasks.find(config.task).shown(shared)
    further = {
        label: {name: values[metric] for name, values in every.items()}
        for metric, label in shown.items()
        if metric != HEADLINE
    }
    returns = {name: values[HEADLINE] for name, values in greedy.items()}
    played = {name: values[HEADLINE] for name, values in caught.items()}
    unscripted = scoring.play("random", episodes, lambda _: config.env, task=config.task)
    random = float(unscripted[HEADLINE].mean())
    parameters = {run.name: num_parameters(run.config) for run in runs} | dict(known.parameters if known else {})
    judged = answer(returns, played, random)
    made = made_by(run.folder for run in runs)
    return Talk(out, out / "report.html", config, parameters, returns, played, judged, further, made, known)


def _report(done: Talk) -> Page:
    page = Page(f"Does {done.task.name} need talk?")
    page.text(done.sentence)
    for sentence in doubts(done.made_by):
        page.text(sentence)
    _tables(page, done)
    label, earned = next(iter(done.measured.items()))
    page.figure(
        figures.dots(
            earned,
            {name: estimate(values, mean) for name, values in earned.items()},
            label,
            {"random": done.answer.random},
        ),
        "Every seed is a dot, below them the mean and its 95 % interval.",
        "returns",
    )
    page.heading("How this is judged")
    page.text(
        f"A task needs talk where the lower end of the interval of told − silent is above {100 * MATTERS:g} % of what "
        "silent agents gain over random ones. Agents use talk where the lower end of the interval of as sent − "
        f"scrambled is above {100 * MATTERS:g} % of told − silent."
    )
    page.code(_command(done.config, done.known))
    page.text(code_of(done.made_by))
    return page


def _tables(page: Page, done: Talk) -> None:
    """What the learners came to, what their messages were worth, and the other metrics."""
    config = done.config
    page.table(
        ("learner", "what agents hear", "parameters", "return per agent", "every seed"),
        [
            [name, _HEARD[name], f"{done.parameters[name]:,}", *with_every_seed(values)]
            for name, values in done.returns.items()
        ],
        f"{config.preset} on {done.task.name}: {config.training.env_steps:,} environment steps a seed, "
        f"{config.num_seeds} seeds from {config.seed}. Return of {config.evaluation.final_episodes} fixed episodes, "
        f"greedy, last parameters; mean over seeds and its 95 % bootstrap interval. Random agents: "
        f"{done.answer.random:.2f}."
        + (f" Silent and told agents are those of {done.known.says}." if done.known else ""),
    )
    page.table(
        ("messages", "return per agent", "every seed"),
        [[name, *with_every_seed(values)] for name, values in done.played.items()],
        "The same talking agents, by what happens to their messages. Scrambled: every agent is heard with its words "
        "from another episode.",
    )
    page.text(
        f"A talking seed earns more than a silent one with probability {with_interval(done.improvement, '.2f')}."
    )
    for label, measured in done.further.items():
        page.table(
            ("", label, "every seed"),
            [[name, *with_every_seed(values)] for name, values in measured.items()],
            "The same episodes.",
        )


def _command(config: RunConfig, known: Known | None = None) -> str:
    """Write what repeats the study: the flags, and the settings of the task that are not as usual."""
    usual = configuration.on_task(configuration.preset(config.preset), config.task).env
    words = [
        f"gacrl talk{tasks.flag(config.task, as_given=True) or f' --env {config.task}'}",
        f"--preset {config.preset}",
        f"--seeds {config.num_seeds}",
    ]
    words += [f"--seed {config.seed}", f"--env-steps {config.training.env_steps}"]
    for name, value in vars(config.env).items():
        flag = name.replace("_", "-")
        if isinstance(value, bool) and value != getattr(usual, name):
            words.append(f"--env.{flag}" if value else f"--env.no-{flag}")
        elif value != getattr(usual, name):
            words.append(f"--env.{flag} {value}")
    words += [] if known is None else [f"--known {shlex.quote(str(known.file))}"]
    return " ".join(words)


def with_every_seed(values: Values) -> list[str]:
    """Write the mean of seeds with its interval, and every seed."""
    return [with_interval(estimate(values, mean), ".2f"), " ".join(f"{value:.2f}" for value in values)]
