"""The command line: parse, then call one function each.

Nothing heavy is imported before a command is known: `gacrl --help` answers at once.
"""

import contextlib
import gc
import json
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from gacrl import tasks
from gacrl.cli import output, playing, stopwatch, studies, training
from gacrl.cli.compare import compare
from gacrl.cli.export import export
from gacrl.cli.view import view
from gacrl.cli.words import Words
from gacrl.config import files as configuration
from gacrl.config import presets
from gacrl.config.checks import unknown
from gacrl.errors import UserError, full_memory, missing_device, reason
from gacrl.report.screen import folded, terminal_width

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

_GARBAGE = (50_000, 20, 50)
"""How seldom Python looks for cycles: while programs were traced, that was a twelfth of a short training's time."""


def main(words: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code: 0, 2 for a user's mistake, 130 after Ctrl-C (143 after SIGTERM).

    words: those of the process where none are given, whose output streams are then made fit for everything.
    """
    stopwatch.begin(with_process=words is None)
    if words is None:
        output.prepare()
        gc.set_threshold(*_GARBAGE)
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
    if words[0] not in COMMANDS:
        raise UserError(unknown("command", words[0], list(COMMANDS), "see `gacrl --help`"))
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
        return COMMANDS[command](rest)
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
        return COMMANDS[command](rest)


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


COMMANDS: dict[str, Callable[[Any], int]] = {
    "train": training.train,
    "resume": training.resume,
    "evaluate": playing.evaluate,
    "render": playing.render,
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
