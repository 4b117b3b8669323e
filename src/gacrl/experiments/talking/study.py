"""`gacrl talk` without a task: every talking task with every kind of communication, each cell a run folder.

A cell that is done is not run again, whichever tasks and kinds are asked for: the report shows all that are there.
"""

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

from gacrl import tasks
from gacrl.config import files as configuration
from gacrl.config.checks import require, unknown
from gacrl.config.run import RunConfig
from gacrl.errors import UserError
from gacrl.experiments.provenance import Versions, made_by
from gacrl.experiments.study import Planned, Watch, claim_folder, refuse_other_settings, train_missing
from gacrl.experiments.talking import kinds as talkers
from gacrl.experiments.talking import report
from gacrl.experiments.talking.cells import Played, catch, played
from gacrl.experiments.talking.trials import FACTORS, tried, tuned
from gacrl.replacing import replace_json
from gacrl.tasks.task import Case
from gacrl.training.recorder import RunFolder

EPISODES = 320
"""Of the evaluations along the way."""


class Asked(NamedTuple):
    """Hold what all learners of a study share: the arguments of `study`."""

    config: RunConfig
    seeds: int
    scale: float
    trials: int
    use: Sequence[Path]


class Cell(NamedTuple):
    """A learner of a case."""

    case: str
    kind: str
    run: Planned


@dataclass(frozen=True)
class Study:
    """A study, as far as it has come."""

    out: Path
    report: Path
    command: str
    cases: Mapping[str, Played]
    made_by: Sequence[Versions]
    """The versions that trained the learners."""

    def to_dict(self) -> dict[str, Any]:
        """Return all of it as plain data."""
        cases = {name: found.to_dict() for name, found in self.cases.items()}
        return {
            "out": str(self.out),
            "report": str(self.report),
            "command": self.command,
            "versions": list(self.made_by),
            "cases": cases,
        }


def all_cases() -> dict[str, tuple[str, Case]]:
    """List the cases of the study by name, each with its task."""
    return {name: (task, case) for task in tasks.names() for name, case in tasks.find(task).cases.items()}


def study(
    config: RunConfig,
    out: Path,
    seeds: int = 3,
    scale: float = 1.0,
    trials: int = 1,
    cases: Sequence[str] = (),
    kinds: Sequence[str] = (),
    watch: Watch | None = None,
    use: Sequence[Path] = (),
) -> Study | None:
    """Train and play what is missing under `out`, and write `report.html`, `report.md` and `summary.json` there.

    config: of the learner, whatever its task is. seeds: of each. scale: of the steps. trials: learning rates that every
    learner may try on seeds of their own; 1: as the presets are. cases, kinds: those to train; none: all. Silent and
    told learners are always among them. use: files that added kinds, for the command in the report. Returns None where
    the watcher's stop ended it early. Raises UserError for fewer than two seeds, a case or kind there is not, a preset
    whose agents cannot talk, or a folder that holds something else.
    """
    watch, out = watch or Watch(), out.absolute()
    if seeds < 2:
        raise UserError(f"--seeds must be at least 2, not {seeds}: with one there is no interval over seeds")
    require(0 < scale <= 100, f"--scale must be above 0 and at most 100, not {scale:g}")
    require(1 <= trials <= len(FACTORS), f"--trials must be between 1 and {len(FACTORS)}, not {trials}")
    wanted = {*_known("task of the study", cases, list(all_cases()))}
    hearing = {*_known("kind of communication", kinds, list(talkers.kinds())), talkers.NONE, talkers.TOLD}
    cells = plan(config, out, seeds, scale)
    chosen = [cell for cell in cells if cell.case in wanted and cell.kind in hearing]
    marker = {"config": configuration.to_dict(replace(config, num_seeds=seeds)), "scale": scale, "trials": trials}
    claim_folder(out, "study.json", marker, "study of talk", lambda held: "another study: choose another --out")
    attempts = {cell.run.name: tried(cell.run, trials) if trials > 1 else [] for cell in chosen}
    if trials == 1:  # else what a learner's rate is to be is not known yet
        refuse_other_settings([cell.run for cell in cells])
    says = {kind: found.says for kind, found in talkers.kinds().items()}
    watch.planned({run.name: says[cell.kind] for cell in chosen for run in (*attempts[cell.run.name], cell.run)})
    for cell in chosen:
        if not _train(cell.run, attempts[cell.run.name], watch):
            return None
    watch.say("writing the report")
    done = _written(Asked(config, seeds, scale, trials, use), out, [cell for cell in cells if cell.run.finished])
    replace_json(out / "summary.json", done.to_dict(), indent=1)
    return done


def _written(asked: Asked, out: Path, ended: Sequence[Cell]) -> Study:
    """Write the report of all finished cells."""
    found = {
        name: played(
            name, *all_cases()[name], {cell.kind: _as_it_was(cell.run) for cell in ended if cell.case == name}
        )
        for name in dict.fromkeys(cell.case for cell in ended)
    }
    command, made = _command(asked, found), made_by(cell.run.folder for cell in ended)
    page = report.page(found, asked.config, asked.seeds, asked.trials, command, made)
    return Study(out, page.write(out, "report"), command, found, made)


def _train(run: Planned, trials: Sequence[Planned], watch: Watch) -> bool:
    """Train a learner, after its trials, and catch its messages; False where the watcher stopped it."""
    refuse_other_settings(trials)
    if not train_missing(trials, watch):
        return False
    run = tuned(run, trials) if trials else run
    refuse_other_settings([run])
    if not train_missing([run], watch):
        return False
    catch(run, watch.say)
    return True


def _as_it_was(run: Planned) -> Planned:
    """Return a finished run with the settings that it was trained with: its trials may have chosen another rate."""
    return replace(run, config=RunFolder.open(run.folder).config())


def plan(config: RunConfig, out: Path, seeds: int, scale: float) -> list[Cell]:
    """Plan every cell that there can be. Raises UserError for a preset whose agents cannot talk."""
    evaluation = replace(config.evaluation, num_episodes=EPISODES, final_episodes=talkers.CLOSING_EPISODES)
    config = replace(config, evaluation=evaluation)
    cells: list[Cell] = []
    for name, (task, case) in all_cases().items():
        shared = talkers.base(configuration.on_task(config, task), case, seeds, scale)
        for kind, learner in talkers.kinds().items():
            settings = learner.settings(shared)
            if settings is not None:
                cells.append(Cell(name, kind, Planned(f"{name}, {kind}", settings, out / name / kind)))
    return cells


def _known(what: str, asked: Sequence[str], known: list[str]) -> list[str]:
    """Return what is asked for, or all. Raises UserError for a name there is not."""
    for name in asked:
        if name not in known:
            raise UserError(unknown(what, name, known))
    return list(asked) or known


def _command(asked: Asked, cases: Mapping[str, Played]) -> str:
    """Write what makes these cells anew."""
    words = [f"gacrl talk --preset {asked.config.preset} --seeds {asked.seeds} --seed {asked.config.seed}"]
    words += [f"--scale {asked.scale:g}"] if asked.scale != 1 else []
    words += [f"--trials {asked.trials}"] if asked.trials > 1 else []
    some_kinds = report.kinds_in(cases)
    words += [f"--tasks {' '.join(cases)}"] if len(cases) < len(all_cases()) else []
    words += [f"--kinds {' '.join(some_kinds)}"] if len(some_kinds) < len(talkers.kinds()) else []
    words += [f"--use {shlex.quote(str(file))}" for file in asked.use]
    return " ".join(words)
