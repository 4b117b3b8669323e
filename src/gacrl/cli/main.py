"""The command line: parse, then call one function each.

Nothing heavy is imported before a command is known: `gacrl --help` answers at once.
"""

import contextlib
import json
import os
import sys
from collections.abc import Callable, Generator, Sequence
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gacrl import tasks
from gacrl.cli import output, stopwatch, studies
from gacrl.cli.compare import compare
from gacrl.cli.export import export
from gacrl.cli.output import warn
from gacrl.cli.stopping import stopping
from gacrl.cli.view import shown, view
from gacrl.cli.words import Words
from gacrl.config import files as configuration
from gacrl.config import presets
from gacrl.config.checks import unknown
from gacrl.config.run import RunConfig
from gacrl.errors import UserError, full_memory, missing_device, reason
from gacrl.report.screen import folded, terminal_width

if TYPE_CHECKING:
    from gacrl.cli.arguments import Evaluate, Messages, Render, Resume, Train
    from gacrl.experiments.scoring import Recorded
    from gacrl.training.session import Ended
    from gacrl.training.watching import Watcher
    from gacrl.types import Intervention

OVERVIEW = """\
gacrl: learning to coordinate by communicating over a graph

usage: gacrl COMMAND [OPTIONS]

  train      train a preset or your own settings into a new run folder
  resume     go on exactly where a run stopped, or past its end
  evaluate   measure a run, random, noop or oracle, here or in the real MPE2
  render     watch a run, random, noop or oracle: a GIF, MP4 or strip of pictures
  view       watch a run live in the browser, and meddle: silence, speak, drag, add agents
  export     take a run elsewhere: weights, a program, a page to play with, its numbers
  compare    runs side by side: intervals over seeds, differences, what else differs
  reproduce  the paper's experiment: every table, figure and claim, theirs beside ours
  ablate     every part of GACRL off in turn: what each is worth
  talk       does a task need talk, and do the agents use it
  sweep      search settings, here or on a Ray cluster; the paper's grid, and what chance makes of it
  tasks      what can be trained on; of your own: --env FILE.py:NAME or pettingzoo:MODULE
  presets    what can be trained by name
  config     print a preset's settings as a file to change and load
  doctor     does this machine work, and do the algorithms learn what they must

`gacrl COMMAND --help` explains a command, with examples. Some to begin with:

  gacrl train
  gacrl evaluate runs/gacrl-1 --backend mpe2
  gacrl render oracle --out oracle.gif
"""


def main(words: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code: 0, 2 for a user's mistake, 130 after Ctrl-C (143 after SIGTERM).

    words: those of the process where none are given, whose output streams are then made fit for everything.
    """
    stopwatch.begin(with_process=words is None)
    if words is None:
        output.prepare()
    words = list(map(_at_home, sys.argv[1:] if words is None else words))
    try:
        try:
            return _answer(words)
        finally:
            output.finish()
    except UserError as error:
        print(f"gacrl: {error}", file=sys.stderr)
        return 2
    except OSError as error:
        what = f"cannot use {error.filename}" if error.filename else "cannot read or write"
        print(f"gacrl: {what}: {reason(error)}", file=sys.stderr)
        return 2
    except (MemoryError, RuntimeError) as error:  # JAX's own is one; its class would have to be imported
        missing = missing_device(error)
        if missing is not None:
            print(f"gacrl: {missing}: unset JAX_PLATFORMS, or name one that is there", file=sys.stderr)
            return 2
        said = full_memory(error)
        if said is None:
            raise
        print(
            f"gacrl: the device's memory is full ({said}): take fewer seeds, environments, episodes or agents, or end "
            "what else is using it",
            file=sys.stderr,
        )
        return 2
    except KeyboardInterrupt:
        print("gacrl: interrupted", file=sys.stderr)
        return 130


def _answer(words: list[str]) -> int:
    """Run a command, or say which there are."""
    if not words or words[0] in ("-h", "--help", "help"):
        print(folded(OVERVIEW, terminal_width()))
        return 0
    if words[0] == "--version":
        from gacrl.versions import version

        print(f"gacrl {version()}")
        return 0
    if words[0] not in _COMMANDS:
        raise UserError(unknown("command", words[0], list(_COMMANDS), "see `gacrl --help`"))
    return _run(words[0], words[1:])


def _at_home(word: str) -> str:
    """The word with the home folder in place of its tilde, which shells leave in `--out=~/runs`."""
    flag, equals, value = word.partition("=")
    if flag.startswith("--") and equals:
        return f"{flag}={os.path.expanduser(value)}"  # noqa: PTH111 a Path would change what is no path
    return os.path.expanduser(word)  # noqa: PTH111


def _run(command: str, words: list[str]) -> int:
    """Run a command, with the task and the files that come from outside at hand.

    What code of theirs raises is told with its file and line.
    """
    rest, named = Words(), {"--env": [], "--use": []}
    following = iter(words)
    for word in following:
        flag, equals, value = word.partition("=")
        if flag not in named:
            rest.append(word)
            continue
        value = value if equals else next(following, "")
        if not value or value.startswith("--"):
            raise UserError(f"{flag} needs a value: see `gacrl {command} --help`")
        named[flag].append(value)
    if not any(named.values()):
        return _COMMANDS[command](rest)
    if command not in _ON_TASK:
        raise UserError(f"`gacrl {command}` takes no {'--env' if named['--env'] else '--use'}")
    rest.named = named
    with contextlib.ExitStack() as blame:
        for file in named["--use"]:
            from gacrl.tasks import own

            blame.enter_context(own.blamed(Path(file)))
            own.run_file(Path(file))
        for name in named["--env"]:
            rest.task = _bring(name, blame)
        return _COMMANDS[command](rest)


def _bring(name: str, blame: contextlib.ExitStack) -> str:
    """Have the task at hand that --env names, and return its name."""
    if ":" not in name:
        tasks.default_settings(name)
        return name
    from gacrl.tasks import own

    task, _ = own.bring(name)
    known = tasks.brought(task)
    blame.enter_context(own.blamed(known.source if known else None))
    return task


def _train(words: Words) -> int:
    from gacrl.cli import arguments, parsing

    base = arguments.Settings.of(_base_settings(words))
    asked = parsing.parse(arguments.Train, words, "train", default=arguments.Train(base))
    config = asked.settings.plain()
    if asked.env_steps is not None and asked.episodes is not None:
        raise UserError("--env-steps and --episodes say the same thing: give one of them")
    env_steps = asked.env_steps if asked.episodes is None else asked.episodes * _horizon(config)
    if env_steps is not None:
        flag, asked_for = ("--env-steps", env_steps) if asked.episodes is None else ("--episodes", asked.episodes)
        if asked_for < 1:
            raise UserError(f"{flag} must be at least 1, not {asked_for}")
        with _called(flag, "training.env_steps"):
            config = replace(config, training=replace(config.training, env_steps=env_steps))

    def start(watcher: "Watcher") -> "Ended":
        from gacrl import play
        from gacrl.training import session

        parent = None if asked.begin_from is None else play.parent(asked.begin_from, watcher.warn)
        return session.start(config, asked.out, watcher, parent)

    return _watched(start, asked, config, words)


@contextlib.contextmanager
def _called(flag: str, setting: str) -> Generator[None]:
    """Call a setting that is out of range by the flag that set it."""
    try:
        yield
    except UserError as error:
        raise UserError(str(error).replace(setting, flag)) from error


def _horizon(config: RunConfig) -> int:
    """Steps of an episode."""
    steps = getattr(config.env, "max_cycles", None)
    return tasks.find(config.task).make(config.env).max_cycles if steps is None else steps


def _resume(words: Words) -> int:
    from gacrl.cli import arguments, parsing

    asked = parsing.parse(arguments.Resume, words, "resume")
    if asked.extend is not None and asked.extend < 1:
        raise UserError(f"--extend must be at least 1 environment step, not {asked.extend}")
    if asked.diagnose:
        return _diagnose(asked)
    from gacrl.training import recorder

    config = recorder.RunFolder.open(asked.run).config()
    if asked.extend is not None:
        env_steps = config.training.env_steps + asked.extend
        config = replace(config, training=replace(config.training, env_steps=env_steps))

    def resume(watcher: "Watcher") -> "Ended":
        from gacrl.training import session

        return session.resume(asked.run, asked.extend, watcher)

    return _watched(resume, asked, config, words)


def _diagnose(asked: "Resume") -> int:
    if asked.extend is not None:
        raise UserError("--diagnose writes nothing: leave --extend out")
    if asked.cluster.distributed:
        raise UserError("--diagnose is done by one process: leave --distributed out")
    from gacrl.training import devices, recorder

    devices.prepare_jax(recorder.RunFolder.open(asked.run).config().num_seeds)
    from gacrl.cli.terminal import TerminalWatcher, print_diagnosis
    from gacrl.training import diagnosis

    with TerminalWatcher() as terminal:
        found = diagnosis.diagnose(asked.run, terminal.watcher())
    print_diagnosis(found)
    if asked.json:
        print(json.dumps(asdict(found)))
    return 0


def _watched(
    work: Callable[["Watcher"], "Ended"], asked: "Train | Resume", config: RunConfig, words: Words
) -> int:
    """Train under the eyes of the terminal; Ctrl-C ends after the chunk under way, a second one at once."""
    cluster = asked.cluster
    cluster.check()
    from gacrl.training import trackers

    track = trackers.chosen(asked.track)
    from gacrl.cli.terminal import TerminalWatcher
    from gacrl.training import devices, distributed
    from gacrl.training.trackers.following import tracked

    place = distributed.ALONE
    if cluster.distributed:
        place = distributed.find_place(cluster.coordinator, cluster.num_processes, cluster.process_id)
    devices.prepare_jax(-(-config.num_seeds // place.count))
    with (
        TerminalWatcher(quiet=place.process > 0) as terminal,
        stopping(terminal),
        distributed.joined(place, configuration.dumps(config), cluster.wait, terminal.watcher()) as watcher,
        tracked(() if terminal.quiet else track, watcher.warn) as tracking,
        shown(asked.page, words, terminal) as page,
    ):
        run = work(watcher + tracking + page)
    terminal.report(run)
    if asked.json and not terminal.quiet:
        print(json.dumps({"folder": str(run.folder), "env_steps": run.env_steps, "summary": run.summary}))
    return 0 if run.summary is not None else terminal.exit_code


def _base_settings(words: Words) -> RunConfig:
    """The settings under the flags: the preset's, then those of --config; both change what --help shows."""
    named: dict[str, str] = {}
    for word, following in zip(words, [*words[1:], ""], strict=False):
        flag, _, value = word.partition("=")
        if flag in ("--preset", "--config"):
            named[flag] = value or following
            if not named[flag] or named[flag].startswith("--"):
                raise UserError(f"{flag} needs a value: see `gacrl train --help`")
    base = presets.preset(named["--preset"]) if "--preset" in named else None
    if "--config" in named:
        file = Path(named["--config"])
        loaded = configuration.load(file, base)
        if base is not None:
            _require_same(file, loaded, base)
        base = loaded
    base = presets.preset() if base is None else base
    return base if words.task is None else configuration.on_task(base, words.task)


def _require_same(file: Path, loaded: RunConfig, preset: RunConfig) -> None:
    """Raises UserError where a file of settings is of another preset or algorithm than the preset that is named."""
    mend = f"leave --preset {preset.preset} out"
    if loaded.preset != preset.preset:
        raise UserError(f"{file} is of the preset {loaded.preset}: {mend}, or take `preset` out of the file")
    if loaded.algorithm.name != preset.algorithm.name:
        raise UserError(
            f"{file} sets the algorithm {loaded.algorithm.name}, and the preset {preset.preset} trains "
            f"{preset.algorithm.name}: {mend}"
        )


def _changes(asked: "Evaluate | Render", rest: list[str], command: str) -> Callable[[Any], Any]:
    """What the flags change about the task that is played."""
    from gacrl.cli import parsing

    short = {"--horizon": ("max_cycles", asked.horizon), "--num-agents": ("num_agents", asked.num_agents)}
    asked_for = {flag: (name, value) for flag, (name, value) in short.items() if value is not None}

    def change(settings: Any) -> Any:
        for flag, (name, _) in asked_for.items():
            if name not in {field.name for field in fields(settings)}:
                raise UserError(f"the task has no setting {name}: leave {flag} out")
        with contextlib.ExitStack() as called:
            for flag, (name, _) in asked_for.items():
                called.enter_context(_called(flag, f"--env.{name.replace('_', '-')}"))
            flags = [word for name, value in asked_for.values() for word in (f"--env.{name}", str(value))]
            return parsing.changed(settings, [*rest, *flags], command, type(asked))

    return change


def _intervention(asked: "Messages") -> "Intervention | None":
    """What the flags do to messages."""
    from gacrl.messages import interventions

    words = asked.words()
    name = words.partition(" ")[0]
    with _called(f"--{name} must", f"{name} must"):
        return interventions.parse(words)


def _evaluate(words: Words) -> int:
    from gacrl.cli import arguments, parsing

    asked, rest = parsing.parse_known(arguments.Evaluate, words, "evaluate")
    if asked.episodes < 1:
        raise UserError(f"--episodes must be at least 1, not {asked.episodes}")
    from gacrl.training.devices import prepare_jax

    prepare_jax()
    from gacrl.cli.terminal import print_evaluation
    from gacrl.experiments import scoring

    scores = scoring.score_run(
        asked.run,
        episodes=asked.episodes,
        change=_changes(asked, rest, "evaluate"),
        backend=asked.backend,
        warn=warn,
        task=words.task or tasks.DEFAULT,
        intervention=_intervention(asked.messages),
        utter=asked.utter,
    )
    print_evaluation(scores)
    if asked.json:
        from gacrl.versions import versions

        print(json.dumps({**scores, "versions": versions()}))
    return 0


def _render(words: Words) -> int:
    from gacrl.cli import arguments, parsing

    asked, rest = parsing.parse_known(arguments.Render, words, "render")
    if not 1 <= asked.episodes <= 100:
        raise UserError(f"--episodes must be between 1 and 100, not {asked.episodes}")
    if not 120 <= asked.size <= 4096:
        raise UserError(f"--size must be between 120 and 4096 pixels, not {asked.size}")
    if asked.out.exists() and not asked.overwrite:
        raise UserError(f"{asked.out} exists: choose another --out, or say --overwrite")
    if not asked.out.parent.is_dir():
        raise UserError(f"there is no folder {asked.out.parent} to write {asked.out.name} into")
    from gacrl.training.devices import prepare_jax

    prepare_jax()
    from gacrl import film
    from gacrl.experiments import scoring

    out = asked.out.absolute()  # a task may change the folder of the process
    film.require_format(out)
    change, task = _changes(asked, rest, "render"), words.task or tasks.DEFAULT
    film.require_rows(out, asked.episodes, asked.beside)
    happens = _intervention(asked.messages)

    def record(intervention: "Intervention | None") -> tuple["Recorded", str]:
        shown = scoring.record_run(asked.run, asked.episodes, change, asked.sampled, warn, task, intervention)
        return shown, "" if shown.intervention is None else shown.intervention.told

    shown, told = record(None if asked.beside else happens)
    if not shown.episodes[0].visible:
        raise UserError(
            f"{shown.task.name} does not say where things are: give its observations positions, or a scene"
        )
    title, beside, also = f"{told}: {asked.run}" if told else asked.run, None, ""
    if asked.beside:
        from gacrl.messages.interventions import silence
        from gacrl.reel import Beside

        with _called("--beside", "the intervention"):
            other, also = record(silence() if happens is None else happens)
        beside = Beside(other.episodes, f"{also}: {asked.run}")
    film.write(shown.episodes, out, asked.size, title, shown.task.words, beside)
    notes = "".join(f"; {note}" for note in (told, f"beside them {also}" if also else "") if note)
    print(f"{asked.out}: {asked.episodes} episode{'s' * (asked.episodes > 1)} of {asked.run}{notes}")
    return 0


def _presets(words: list[str]) -> int:
    from gacrl.cli import arguments, parsing

    asked = parsing.parse(arguments.Presets, words, "presets")
    for name, (description, _) in presets.PRESETS.items():
        default = " (the default)" if name == presets.DEFAULT_PRESET else ""
        print(folded(f"{name:12}  {description}{default}", terminal_width()))
    if asked.json:
        print(json.dumps({name: description for name, (description, _) in presets.PRESETS.items()}))
    return 0


def _tasks(words: list[str]) -> int:
    from gacrl.cli import arguments, parsing

    asked = parsing.parse(arguments.Tasks, words, "tasks")
    from gacrl.experiments import anchors

    rows = [anchors.row(name) for name in tasks.names()]
    for row in rows:
        print(folded(anchors.sentence(row), terminal_width()))
    if asked.json:
        print(json.dumps({row["task"]: row for row in rows}))
    return 0


def _config(words: Words) -> int:
    from gacrl.cli import arguments, parsing

    asked = parsing.parse(arguments.Config, words, "config")
    config = presets.preset(asked.preset)
    config = config if words.task is None else configuration.on_task(config, words.task)
    print(configuration.dumps(config), end="")
    return 0


def _doctor(words: list[str]) -> int:
    from gacrl.cli import arguments, parsing

    asked = parsing.parse(arguments.Doctor, words, "doctor")
    from gacrl.training.devices import prepare_jax

    prepare_jax()
    from gacrl.cli.terminal import print_examination
    from gacrl.doctor import checks

    findings = print_examination(checks())
    if asked.json:
        print(json.dumps({it.what: {"good": it.good, "detail": it.detail} for it in findings}))
    bad = [finding.what for finding in findings if not finding.good]
    if bad:
        raise UserError(f"this machine does not do what it must: {', '.join(bad)}")
    return 0


_COMMANDS: dict[str, Callable[[Any], int]] = {
    "train": _train,
    "resume": _resume,
    "evaluate": _evaluate,
    "render": _render,
    "view": view,
    "export": export,
    "compare": compare,
    "reproduce": studies.reproduce,
    "ablate": studies.ablate,
    "talk": studies.talk,
    "sweep": studies.sweep,
    "tasks": _tasks,
    "presets": _presets,
    "config": _config,
    "doctor": _doctor,
}
_ON_TASK = (
    *("train", "resume", "evaluate", "render", "view", "export", "compare"),
    *("ablate", "talk", "sweep", "tasks", "config"),
)
"""Commands that take a task from outside."""
