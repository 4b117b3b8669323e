"""The commands that train one run: train and resume."""

import json
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING

from gacrl import tasks
from gacrl.cli.stopping import stopping
from gacrl.cli.view import shown
from gacrl.cli.words import Words
from gacrl.config import files as configuration
from gacrl.config import presets
from gacrl.config.run import RunConfig
from gacrl.errors import UserError

if TYPE_CHECKING:
    from gacrl.cli.arguments import Resume, Train
    from gacrl.training.session import Ended
    from gacrl.training.watching import Watcher


def train(words: Words) -> int:
    """Train a preset or settings into a new run folder."""
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
        with parsing.called(flag, "training.env_steps"):
            config = replace(config, training=replace(config.training, env_steps=env_steps))

    def start(watcher: "Watcher") -> "Ended":
        from gacrl import play
        from gacrl.training import session

        parent = None if asked.begin_from is None else play.parent(asked.begin_from, watcher.warn)
        return session.start(config, asked.out, watcher, parent)

    return _watched(start, asked, config, words)


def _horizon(config: RunConfig) -> int:
    """Steps of an episode."""
    steps = getattr(config.env, "max_cycles", None)
    return tasks.find(config.task).make(config.env).max_cycles if steps is None else steps


def resume(words: Words) -> int:
    """Go on with a run, or find out where it diverged."""
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
