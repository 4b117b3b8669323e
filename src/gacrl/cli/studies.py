"""The commands that train many runs: reproduce, ablate, talk, sweep."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from gacrl.cli.stopping import stopping
from gacrl.cli.words import Words
from gacrl.config import files as configuration
from gacrl.config import presets
from gacrl.errors import UserError

if TYPE_CHECKING:
    from gacrl.cli.arguments import Sweep
    from gacrl.experiments.ablate import Ablation
    from gacrl.experiments.paper.reproduce import Reproduction
    from gacrl.experiments.search import Search
    from gacrl.experiments.study import Watch
    from gacrl.experiments.talk import Talk
    from gacrl.experiments.talking.study import Study as TalkOfAll

Study = TypeVar("Study", "Ablation", "Reproduction", "Search", "Talk", "TalkOfAll")


def reproduce(words: list[str]) -> int:
    """Repeat the paper's experiment."""
    from gacrl.cli import arguments, parsing

    asked = parsing.parse(arguments.Reproduce, words, "reproduce")
    from gacrl.training.devices import prepare_jax

    prepare_jax(max(asked.seeds, 1))
    from gacrl.experiments.paper import reproduce

    def study(watch: "Watch") -> "Reproduction | None":
        return reproduce.reproduce(asked.out, asked.seeds, asked.episodes, asked.extended, watch)

    return _studied(study, asked.out, asked.json)


def _studied(
    study: Callable[["Watch"], Study | None], out: Path, as_json: bool, show: Callable[[Study], None] | None = None
) -> int:
    """Make a study of many runs under the eyes of the terminal; Ctrl-C ends as in training.

    show: prints what was found.
    """
    from gacrl.cli.terminal import RunsWatcher
    from gacrl.experiments.study import Watch

    with RunsWatcher() as terminal, stopping(terminal):
        done = study(Watch(terminal.planned, terminal.watcher, terminal.finished, terminal.say))
    if done is None:
        print(f"stopped; the same command goes on with what is missing in {out}")
        return terminal.exit_code
    if show is not None:
        show(done)
    print(f"report     {done.report}")
    if as_json:
        print(json.dumps(done.to_dict()))
    return 0


def ablate(words: Words) -> int:
    """Take GACRL's parts away one by one."""
    from gacrl.cli import arguments, parsing

    asked = parsing.parse(arguments.Ablate, words, "ablate")
    from gacrl.training.devices import prepare_jax

    prepare_jax(max(asked.seeds, 1))
    from gacrl.experiments import ablate, parts

    def study(watch: "Watch") -> "Ablation | None":
        preset = presets.preset(asked.preset or parts.usual_preset(words.task))
        config = replace(preset, seed=asked.seed)
        config = config if words.task is None else configuration.on_task(config, words.task)
        return ablate.ablate(config, asked.out, asked.seeds, asked.env_steps, asked.part, asked.updates, watch)

    return _studied(study, asked.out, asked.json)


def talk(words: Words) -> int:
    """Answer whether a task needs talk, and whether the agents use it; without a task, for all of ours."""
    from gacrl.cli import arguments, parsing

    if words.task is None:
        return _talk_of_all(words)
    asked, rest = parsing.parse_known(arguments.Talk, words, "talk")
    study_alone = {
        "--tasks": asked.tasks,
        "--kinds": asked.kinds,
        "--scale": asked.scale != 1.0,
        "--trials": asked.trials != 1,
    }
    for flag, given in study_alone.items():
        if given:
            raise UserError(f"{flag} is for the study of all tasks: leave --env out, or {flag}")
    config = configuration.on_task(replace(presets.preset(asked.preset), seed=asked.seed), words.task)
    config = replace(config, env=parsing.changed(config.env, rest, "talk", arguments.Talk))
    from gacrl.training.devices import prepare_jax

    prepare_jax(max(asked.seeds, 1))
    from gacrl.experiments import talk
    from gacrl.experiments.talking.kinds import CLOSING_EPISODES

    config = replace(config, evaluation=replace(config.evaluation, final_episodes=CLOSING_EPISODES))
    out = asked.out or Path("runs") / f"talk-{words.task}"
    env_steps = talk.ENV_STEPS if asked.env_steps is None else asked.env_steps

    def study(watch: "Watch") -> "Talk | None":
        return talk.talk(config, out, asked.seeds, env_steps, watch, asked.known)

    return _studied(study, out, asked.json, _print_answer)


def _talk_of_all(words: Words) -> int:
    """The study of all tasks that need talk."""
    from gacrl.cli import arguments, parsing

    setting = next((word.partition("=")[0] for word in words if word.startswith("--env.")), None)
    if setting is not None:
        raise UserError(f"{setting} is a setting of one task: name that with --env, or leave {setting} out")
    asked = parsing.parse(arguments.Talk, words, "talk")
    for flag, given, mend in (("--env-steps", asked.env_steps, ", or say --scale"), ("--known", asked.known, "")):
        if given is not None:
            raise UserError(f"{flag} is for one task: name it with --env{mend}")
    config = replace(presets.preset(asked.preset), seed=asked.seed)
    from gacrl.training.devices import prepare_jax

    prepare_jax(max(asked.seeds, 1))
    from gacrl.experiments.talking import study

    out = asked.out or Path("runs") / "talk"

    def work(watch: "Watch") -> "TalkOfAll | None":
        use = [Path(file) for file in words.named.get("--use", ())]
        return study.study(
            config, out, asked.seeds, asked.scale, asked.trials, asked.tasks, asked.kinds, watch, use
        )

    return _studied(work, out, asked.json, _print_scores)


def _print_scores(done: "TalkOfAll") -> None:
    """Print the scores of all tasks and kinds."""
    from gacrl.cli.terminal import console
    from gacrl.experiments.talking import report
    from gacrl.report.tables import print_table

    title = "scores: 0 as the best silent policy, 1 as the best one that is told everything"
    print_table(console(), ("", *done.cases), report.scores(done.cases), title)


def _print_answer(done: "Talk") -> None:
    """Print what every learner earns, and the answer."""
    from gacrl.cli.terminal import console
    from gacrl.experiments import talk
    from gacrl.report.screen import say
    from gacrl.report.tables import print_table

    screen = console()
    title = f"random agents earn {done.answer.random:.2f}"
    for label, measured in done.measured.items():
        rows = [[name, *talk.with_every_seed(values)] for name, values in measured.items()]
        print_table(screen, ("", label, "every seed"), rows, title)
        title = ""
    say(screen, done.sentence)


def sweep(words: Words) -> int:
    """Search settings."""
    from gacrl.cli import arguments, parsing

    asked = parsing.parse(arguments.Sweep, words, "sweep")
    out = asked.out or Path("runs") / Path(asked.spec).stem
    if asked.spec != "paper-grid":
        return _search(asked, out, words.task)
    if words.task is not None:
        raise UserError("paper-grid is the paper's, on its own task: leave --env out")
    if asked.ray is not None:
        raise UserError("paper-grid is one compiled program and needs no cluster: leave --ray out")
    seeds = 2 if asked.seeds is None else asked.seeds
    from gacrl.training.devices import prepare_jax

    prepare_jax(27 * max(seeds, 1))
    from gacrl.experiments.paper import grid as sweep

    grid = sweep.paper_grid(seeds, 500 if asked.episodes is None else asked.episodes)
    done = sweep.sweep(grid, out, say=lambda line: print(line, flush=True))
    print(f"report     {done.report}")
    if asked.json:
        print(json.dumps(done.to_dict()))
    return 0


def _search(asked: "Sweep", out: Path, task: str | None) -> int:
    """A search that a file describes, here or on a cluster."""
    if asked.seeds is not None or asked.episodes is not None:
        raise UserError(f"--seeds and --episodes are for paper-grid: say seeds and env_steps in {asked.spec}")
    if asked.trial_cpus <= 0 or asked.trial_gpus < 0:
        raise UserError("--trial-cpus must be above 0, and --trial-gpus not below it")
    from gacrl.experiments import search
    from gacrl.training.devices import prepare_jax

    spec = search.load(Path(asked.spec), task)
    prepare_jax(spec.config.num_seeds)

    def study(watch: "Watch") -> "search.Search | None":
        if asked.ray is None:
            return search.search(spec, out, watch)
        from gacrl.experiments.ray_search import ray_search

        return ray_search(spec, out, asked.ray, asked.trial_cpus, asked.trial_gpus, watch)

    return _studied(study, out, asked.json)
