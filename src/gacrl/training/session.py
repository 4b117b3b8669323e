"""A run from its settings to its summary: what the command line and `gacrl.train` both call."""

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, nullcontext
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, SupportsIndex

import jax
import jax.numpy as jnp

from gacrl import reel, tasks
from gacrl.config import files as configuration
from gacrl.config.checks import whole
from gacrl.config.presets import label
from gacrl.config.run import RunConfig
from gacrl.errors import Faulty, UserError
from gacrl.evaluation import episodes
from gacrl.evaluation.evaluate import stream_key
from gacrl.evaluation.references import evaluate_scripted
from gacrl.evaluation.summary import normalised, over_seeds
from gacrl.training import checkpoint
from gacrl.training.ahead import Ahead, prepare
from gacrl.training.ahead import closing as closing_programs
from gacrl.training.build import (
    evaluated_settings,
    learner_shapes,
    make_trainer,
    member_shapes,
    plan,
    stacked_shapes,
)
from gacrl.training.devices import anyone, gathered, leads, one_seed, same_everywhere, shard_seeds
from gacrl.training.divergence import Diverged
from gacrl.training.keeper import ROWS, Keeper
from gacrl.training.loop import Clock, Progress, train
from gacrl.training.recorder import SHOWN_EPISODES, RunFolder
from gacrl.training.trainer import AbstractTrainer, Trainer, TrainState
from gacrl.training.watching import Watcher
from gacrl.training.writer import Writer
from gacrl.types import Learner
from gacrl.versions import versions


@dataclass(frozen=True)
class Ended:
    """A run that has come to an end, planned or not."""

    folder: Path
    config: RunConfig
    env_steps: int
    summary: dict[str, Any] | None
    """The content of `summary.json`; None where the run was stopped before its end. Empty in processes that do not
    write."""


class Parent(NamedTuple):
    """A trained run whose policy another training starts with."""

    name: str
    found: checkpoint.Checkpoint
    num_seeds: int
    """Seeds in the checkpoint."""
    member: int | None
    """The one that all start with; None: each with its own, in turn."""


def start(
    config: RunConfig, out: Path | None = None, watcher: Watcher | None = None, parent: Parent | None = None
) -> Ended:
    """Train from the beginning, into a new run folder; with the parameters of a parent, where one is given.

    Raises UserError for a parent whose network does not fit.
    """
    out = None if out is None else out.absolute()
    watcher, trainer = watcher or Watcher(), make_trainer(config)
    planned = plan(trainer, config)
    begun = None if parent is None else begin_with(trainer, config, parent)
    name = None if parent is None else parent.name
    folder = RunFolder.create(out, config, name) if leads() else RunFolder(out or Path("runs"))
    with folder.locked() if leads() else nullcontext(), Ahead() as ahead, closing(trainer):
        watcher.planned(folder, config, planned)
        return _run(ahead, folder, config, trainer, None, watcher, configuration.fingerprint(config), begun)


def begin_with(trainer: AbstractTrainer, config: RunConfig, parent: Parent) -> TrainState:
    """Make a fresh training state, stacked, with what the parent has learned."""
    state, algorithm = trainer.init_stacked(config.seeds), trainer.algorithm
    like = jax.tree.map(
        lambda leaf: jax.ShapeDtypeStruct((parent.num_seeds, *leaf.shape), leaf.dtype),
        algorithm.learned(member_shapes(trainer).learner),
    )
    try:
        learned = checkpoint.load(parent.found, like, prefix=".learner")
    except UserError as error:
        why = str(error).partition(": ")[2].partition(";")[0]
        raise UserError(
            f"{parent.name} has another network than this run ({why}): train with the preset, the network and the "
            "observations that it was trained with"
        ) from error
    members = [k % parent.num_seeds if parent.member is None else parent.member for k in range(config.num_seeds)]
    chosen = jax.tree.map(lambda leaf: leaf[jnp.array(members)], learned)
    kept = {name: part for name, part in chosen._asdict().items() if jax.tree.leaves(part)}
    return state._replace(learner=state.learner._replace(**kept))


def resume(path: Path, extend: SupportsIndex | None = None, watcher: Watcher | None = None) -> Ended:
    """Go on where a run stopped; with `extend`, up to that many environment steps beyond its end.

    Raises UserError where it cannot go on, ConfigError for an extension that is no whole number above 0.
    """
    watcher = watcher or Watcher()
    extend = None if extend is None else whole(extend, "extend", 1)
    folder = RunFolder.open(path)
    with folder.locked() if leads() else nullcontext(), Ahead() as ahead, ExitStack() as opened:
        folder.require_room()
        config = folder.config()
        folder.warn_of_changed_task(watcher.warn)
        found = newest_checkpoint(folder, watcher.warn)
        if not same_everywhere(-1 if found is None else found.env_steps):
            raise UserError(f"the processes see different checkpoints in {folder.path}: put it where all share it")
        if extend is not None:
            steps = config.training.env_steps + extend
            config = replace(config, training=replace(config.training, env_steps=steps))
        trainer = opened.enter_context(closing(make_trainer(config)))
        planned = plan(trainer, config)
        if leads():
            checkpoint.set_aside_damaged(folder.checkpoints)
            for aside in checkpoint.set_aside_damaged(folder.checkpoints, checkpoint.BEST):
                watcher.warn(
                    f"the best policy so far was damaged and is {aside} now: the best from here on is kept"
                )
        if extend is not None and leads():
            folder.extend(config.training.env_steps)
        watcher.planned(folder, config, planned)
        fingerprint = configuration.fingerprint(folder.settings())
        return _run(ahead, folder, config, trainer, found, watcher, fingerprint)


def newest_checkpoint(folder: RunFolder, warn: Callable[[str], None]) -> checkpoint.Checkpoint | None:
    """Return where a run can go on: at its newest intact checkpoint; None where it has not come to one yet.

    Raises UserError for checkpoints that are all damaged or gone, or of other settings.
    """
    if not any(folder.checkpoints.glob(f"{checkpoint.STEP}*")):
        rows = folder.metrics() if folder.metrics_file.exists() else []
        if len({row["env_steps"] for row in rows}) > 1:  # an evaluation may be ahead of its checkpoint
            raise UserError(
                f"{folder.checkpoints} has lost its checkpoints: train the run again into a new folder"
            )
        return None
    found, warnings = checkpoint.newest(folder.checkpoints)
    for warning in warnings:
        warn(warning)
    if found.fingerprint != configuration.fingerprint(folder.settings()):
        raise UserError(
            f"{found.folder} was trained with other settings than {folder.config_file} now says: "
            "put the file back as it was, or train into a new folder"
        )
    return found


def restore(trainer: AbstractTrainer, config: RunConfig, found: checkpoint.Checkpoint | None) -> TrainState:
    """Restore the training state of a checkpoint, laid out on the devices; a fresh one without."""
    if found is None:
        return trainer.init(config.seeds)
    shapes = stacked_shapes(trainer)
    replay = trainer.algorithm.replay(shapes.learner)
    return shard_seeds(checkpoint.load(found, shapes, replay=replay), trainer.mesh)


def _run(
    ahead: Ahead,
    folder: RunFolder,
    config: RunConfig,
    trainer: AbstractTrainer,
    found: checkpoint.Checkpoint | None,
    watcher: Watcher,
    fingerprint: str,
    begun: TrainState | None = None,
) -> Ended:
    """begun: the state to begin with, stacked, where it is not a fresh one."""
    env_steps, clock = (0, Clock()) if found is None else (found.env_steps, _clock(found))
    watcher.compiling()
    begin = time.perf_counter()
    programs = prepare(ahead, trainer, config, fresh=found is None and begun is None)
    ending = partial(_prepare_ending, ahead, trainer, config)
    if isinstance(trainer, Trainer):  # what lives in Python plays one thing at a time
        ending = ahead.run(ending).result
    state = restore(trainer, config, found) if begun is None else shard_seeds(begun, trainer.mesh)
    clock = replace(clock, compiling=clock.compiling + time.perf_counter() - begin)
    with folder.writing(config.task):
        if leads():
            folder.diverged_file.unlink(missing_ok=True)
        rows = folder.forget_metrics_after(env_steps) if leads() else 0
    if leads() and found is not None and rows != found.counters.get(ROWS, rows):
        watcher.warn(
            f"{folder.metrics_file} has {rows} of the {found.counters[ROWS]} lines that were written up to "
            f"environment step {env_steps}: the others are lost, what follows is not"
        )
    with Writer() as writer:
        task = tasks.find(config.task)
        keep = Keeper(folder, config.num_seeds, trainer.algorithm, task, fingerprint, writer, rows)
        if begun is not None and leads():
            keep.begin(gathered(state))
        chunks = train(trainer, config, state, env_steps, clock, programs)
        for progress in _explained(chunks, folder, config.task, env_steps):
            env_steps, state, clock = progress.env_steps, progress.state, progress.clock
            if leads():
                writer.wait()  # one evaluation at most is ahead of its checkpoint
                with folder.writing(config.task):
                    folder.append_metrics(list(progress.rows))
                keep(progress)
            watcher.progress(progress)
            if anyone(watcher.stop()) and not progress.done:
                return Ended(folder.path, config, env_steps, None)
    watcher.finishing()
    summary = _finish(folder, config, trainer, state, env_steps, clock, ending())
    watcher.finished(summary)
    return Ended(folder.path, config, env_steps, summary)


def _explained(chunks: Iterator[Progress], folder: RunFolder, task: str, env_steps: int) -> Iterator[Progress]:
    """Pass on the chunks of a training; where it cannot go on, add to the sentence how to resume it.

    What the caller does between two chunks, its watcher among it, raises its own errors past this.
    """
    try:
        for progress in chunks:
            env_steps = progress.env_steps
            yield progress
    except Diverged as error:
        if leads():
            folder.write_diverged(str(error).partition(";")[0])
        raise Diverged(
            f"{error}, or see the first bad update with `{folder.resumed_by(task)} --diagnose`, which begins "
            f"at {'the start' if env_steps == 0 else f'the last good checkpoint, of environment step {env_steps}'}"
        ) from error
    except Faulty as error:
        raise Faulty(
            f"{error}, then go on with `{folder.resumed_by(task)}` from environment step {env_steps}"
        ) from error


def _clock(found: checkpoint.Checkpoint) -> Clock:
    """The clock as it stood at a checkpoint."""
    known = asdict(Clock())
    return Clock(**{name: value for name, value in found.counters.items() if name in known})  # pyright: ignore[reportArgumentType]


class _Ending(NamedTuple):
    """What closes a run and does not wait for its policy."""

    record: Callable[[Learner], list[episodes.Episode]]
    """Episodes of a seed's learner to look at."""
    references: dict[str, dict[str, float]]
    """The metrics of policies that learn nothing, where this process writes them."""


def _prepare_ending(ahead: Ahead, trainer: AbstractTrainer, config: RunConfig) -> _Ending:
    """Compile what closes a run, and play the policies that learn nothing."""
    if isinstance(trainer, Trainer):
        *_, program = [ahead.compiled(lower) for lower in closing_programs(trainer, config)]
        record = partial(_record, program)
    else:
        record = partial(_record_on_host, trainer)
    if ahead.left or not leads():
        return _Ending(record, {})
    settings, count = evaluated_settings(config), config.evaluation.final_episodes
    return _Ending(record, evaluate_scripted(config.task, settings, count))


def _finish(
    folder: RunFolder,
    config: RunConfig,
    trainer: AbstractTrainer,
    state: TrainState,
    env_steps: int,
    clock: Clock,
    ending: _Ending,
) -> dict[str, Any]:
    """The closing evaluation, some episodes to look at, and last the summary, which makes the run a finished one."""
    begun, num_episodes = time.perf_counter(), config.evaluation.final_episodes
    task, settings = tasks.find(config.task), evaluated_settings(config)
    final = {
        kind: jax.device_get(gathered(trainer.evaluate(state.learner, kind == "sampled", "report", num_episodes)))
        for kind in ("greedy", "sampled")
    }
    learner = one_seed(gathered(state.learner), 0)
    if not leads():
        return {}
    facts, members = task.facts(settings, trainer.table.names), len(config.seeds)
    _show(folder, config, ending.record(learner))
    summary = {
        "preset": config.preset,
        "task": facts,
        "seeds": list(config.seeds),
        "env_steps": env_steps,
        "final": {
            kind: normalised(
                over_seeds({name: v.mean(1)[:members] for name, v in values.items()}), ending.references, facts
            )
            for kind, values in final.items()
        },
        "references": ending.references,
        "episodes": num_episodes,
        "horizon": int(trainer.evaluation_env.max_cycles),
        "steps_per_second": clock.steps_per_second,
        "compile_seconds": clock.compiling,
        "wall_seconds": clock.wall + time.perf_counter() - begun,
        "versions": versions(),
    }
    with folder.writing(config.task):
        folder.write_summary(summary)
    return summary


def _record(program: Callable[[Learner], episodes.Played], learner: Learner) -> list[episodes.Episode]:
    return episodes.cut(program(learner))


def _record_on_host(trainer: AbstractTrainer, learner: Learner) -> list[episodes.Episode]:
    """The same episodes, of an environment that lives in Python."""
    policy, key = trainer.algorithm.policy(learner, False), stream_key("report")
    env, params = trainer.evaluation_env, trainer.evaluation_params
    return episodes.record_many(env, policy, trainer.memory, params, key, SHOWN_EPISODES, trainer.intervention)


def _show(folder: RunFolder, config: RunConfig, shown: list[episodes.Episode]) -> None:
    """Keep episodes of the first seed to look at, and as a GIF where there is something to see."""
    task = tasks.find(config.task)
    with folder.writing(config.task):
        folder.episodes.mkdir(exist_ok=True)
        for number, episode in enumerate(shown):
            episode.save(folder.episodes / f"{number}.npz")
        if shown and shown[0].visible:
            title = f"{label(config)}, seed {config.seed}"
            reel.gif(shown, folder.gif, title=title, words=task.words)


def load_learners(found: checkpoint.Checkpoint, trainer: AbstractTrainer) -> Learner:
    """Load the learners of a checkpoint, stacked and laid out for the trainer: to act with, not to learn on."""
    shapes = trainer.algorithm.acting(learner_shapes(trainer))
    learners = checkpoint.load(found, shapes, prefix=".learner")
    return shard_seeds(learners, trainer.mesh)
