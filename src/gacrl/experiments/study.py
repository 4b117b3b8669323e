"""A folder of planned runs: it says what it is for, and a stopped study goes on with the runs that are missing."""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gacrl.config.run import RunConfig
from gacrl.errors import UserError, reason
from gacrl.replacing import replace_json, unfinished
from gacrl.training import session
from gacrl.training.devices import release_memory
from gacrl.training.divergence import Diverged
from gacrl.training.recorder import RunFolder
from gacrl.training.session import Ended
from gacrl.training.watching import Watcher


@dataclass(frozen=True)
class Planned:
    """One run of a study, all seeds."""

    name: str
    config: RunConfig
    folder: Path

    @property
    def finished(self) -> bool:
        """Nothing is left to do: it was trained to its end, or diverged."""
        folder = RunFolder(self.folder)
        return folder.summary_file.is_file() or folder.diverged_file.is_file()


@dataclass(frozen=True)
class Watch:
    """What a study tells whoever looks on: all of it optional."""

    planned: Callable[[Mapping[str, str]], None] = lambda runs: None
    """(names of the runs, and what each of them is)."""
    run: Callable[[str], Watcher] = lambda name: Watcher()
    finished: Callable[[str, str], None] = lambda name, how: None
    """(name, how it ended)."""
    say: Callable[[str], None] = lambda sentence: None


def train_missing(runs: Sequence[Planned], watch: Watch) -> bool:
    """Train what is not finished, each from where it stopped; False where the watcher stopped it."""
    for planned in runs:
        if planned.finished:
            watch.finished(planned.name, "there already")
            continue
        try:
            if _train(planned, watch.run(planned.name)).summary is None:
                return False
            watch.finished(planned.name, "done")
        except Diverged:
            watch.finished(planned.name, "diverged")
        finally:
            release_memory()
    return True


def refuse_other_settings(runs: Sequence[Planned]) -> None:
    """Raise UserError where a run's folder holds a run with other settings than planned."""
    for planned in runs:
        folder = planned.folder
        if (folder / "config.json").is_file() and RunFolder.open(folder).config() != planned.config:
            raise UserError(
                f"{folder} was trained with other settings than this version plans: choose another --out, "
                "or remove that folder to train it again"
            )


def claim_folder(
    out: Path, marker: str, asked: Mapping[str, Any], kind: str, other: Callable[[Mapping[str, Any]], str]
) -> None:
    """Make the folder and say in it, in the file `marker`, what was asked for (plain JSON data).

    kind: what the study is called. other: the sentence about a folder that holds one of its kind with other settings,
    from those. Raises UserError for it, for a folder that holds something else, and for one that cannot be written.
    """
    path = out / marker
    if path.is_file():
        try:
            held: Any = json.loads(path.read_text(encoding="utf-8"))
        except ValueError:
            held = None
        if not isinstance(held, dict):
            raise UserError(f"{path} is damaged: choose another --out")
        if held != json.loads(json.dumps(asked)):  # as it would be read: tuples are lists
            raise UserError(f"{out} holds {other(held)}")  # pyright: ignore[reportUnknownArgumentType]
        return
    if out.exists() and (not out.is_dir() or any(entry != unfinished(path) for entry in out.iterdir())):
        raise UserError(f"{out} exists and holds no {kind}: choose another --out")
    try:
        out.mkdir(parents=True, exist_ok=True)
        replace_json(path, asked)
    except OSError as error:
        raise UserError(f"cannot write into {out}: {reason(error)}; choose another --out") from error


def _train(planned: Planned, watcher: Watcher) -> Ended:
    if (planned.folder / "config.json").is_file():
        return session.resume(planned.folder, watcher=watcher)
    _forget_half_made(planned.folder)
    return session.start(planned.config, planned.folder, watcher)


def _forget_half_made(folder: Path) -> None:
    """Remove the empty folders of a run that was killed before it had settings."""
    if folder.is_dir():
        for inner in folder.iterdir():
            if inner.is_dir() and not any(inner.iterdir()):
                inner.rmdir()
            elif inner.name.startswith(".config.json"):
                inner.unlink()
