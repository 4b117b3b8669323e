"""The commands that play a policy: evaluate and render."""

import contextlib
import json
from collections.abc import Callable
from dataclasses import fields
from typing import TYPE_CHECKING, Any

from gacrl import tasks
from gacrl.cli.output import warn
from gacrl.cli.words import Words
from gacrl.errors import UserError

if TYPE_CHECKING:
    from gacrl.cli.arguments import Evaluate, Messages, Render
    from gacrl.experiments.scoring import Recorded
    from gacrl.types import Intervention


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
                called.enter_context(parsing.called(flag, f"--env.{name.replace('_', '-')}"))
            flags = [word for name, value in asked_for.values() for word in (f"--env.{name}", str(value))]
            return parsing.changed(settings, [*rest, *flags], command, type(asked))

    return change


def _intervention(asked: "Messages") -> "Intervention | None":
    """What the flags do to messages."""
    from gacrl.cli import parsing
    from gacrl.messages import interventions

    words = asked.words()
    name = words.partition(" ")[0]
    with parsing.called(f"--{name} must", f"{name} must"):
        return interventions.parse(words)


def evaluate(words: Words) -> int:
    """Measure a policy on fixed episodes."""
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


def render(words: Words) -> int:
    """Draw episodes of a policy into a file."""
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

        with parsing.called("--beside", "the intervention"):
            other, also = record(silence() if happens is None else happens)
        beside = Beside(other.episodes, f"{also}: {asked.run}")
    film.write(shown.episodes, out, asked.size, title, shown.task.words, beside)
    notes = "".join(f"; {note}" for note in (told, f"beside them {also}" if also else "") if note)
    print(f"{asked.out}: {asked.episodes} episode{'s' * (asked.episodes > 1)} of {asked.run}{notes}")
    return 0
