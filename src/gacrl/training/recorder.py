"""The run folder: what is where, written so that nothing that was there before is lost."""

import json
import os
import re
import shlex
from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from gacrl import tasks
from gacrl.config import files as configuration
from gacrl.config.presets import label
from gacrl.config.run import RunConfig
from gacrl.errors import ConfigError, UserError, reason
from gacrl.replacing import replace_json, replace_text
from gacrl.versions import version, versions

SHOWN_EPISODES = 4
"""Episodes that a run keeps, and shows in its GIF."""


class RunFolder:
    """One run: `config.json`, `origin.json`, `metrics.jsonl`, `summary.json` or `diverged.json`, `checkpoints/` and
    `episodes/`."""

    def __init__(self, path: Path):
        path = path.absolute()  # wherever the process goes later
        self.path = path
        self.config_file = path / "config.json"
        self.origin_file = path / "origin.json"
        self.metrics_file = path / "metrics.jsonl"
        self.summary_file = path / "summary.json"
        self.diverged_file = path / "diverged.json"
        self.checkpoints = path / "checkpoints"
        self.episodes = path / "episodes"
        self.gif = path / "episodes.gif"

    @classmethod
    def create(cls, path: Path | None, config: RunConfig, begun_from: str | None = None) -> "RunFolder":
        """Make a new run folder. Without a path: the next free number under `runs/`.

        begun_from: the run whose policy this one starts with. Raises UserError where the path exists already, or cannot
        be written.
        """
        configuration.from_dict(configuration.to_dict(config))  # refuses now what could not be loaded again
        try:
            if path is None:
                path = _next_free(Path("runs"), label(config))
            elif path.exists() and (not path.is_dir() or any(path.iterdir())):
                mend = f", or continue it with `{resuming(path)}`" if _is_run(path) else ""
                raise UserError(f"{path} exists and is not overwritten: choose another --out{mend}")
            else:
                path.mkdir(parents=True, exist_ok=True)
            folder = cls(path)
            folder.checkpoints.mkdir()
            folder.episodes.mkdir()
            replace_json(folder.origin_file, _origin(config, begun_from))
            replace_text(folder.config_file, configuration.dumps(config))
            folder.metrics_file.touch()
        except OSError as error:
            raise UserError(
                f"cannot write the run folder {path or 'under runs'}: {reason(error)}; choose another with --out"
            ) from error
        return folder

    @classmethod
    def open(cls, path: Path) -> "RunFolder":
        """Open an existing run folder. Raises UserError where there is none."""
        if not path.exists():
            raise UserError(f"there is no run {path}: `gacrl train` makes one and prints where it is")
        if not _is_run(path):
            raise UserError(f"{path} is not a run folder: it has no config.json")
        return cls(path)

    def require_room(self) -> None:
        """Raise UserError where a file stands in the place of a folder, a folder in that of a file, or a link."""
        for path in (self.checkpoints, self.episodes, self.metrics_file, self.summary_file, self.gif):
            is_folder = path in (self.checkpoints, self.episodes)
            if path.is_symlink():
                raise UserError(f"{path} is a link, and a run is written in its own folder: move it away")
            if path.exists() and path.is_dir() != is_folder:
                found, wanted = ("file", "folder") if is_folder else ("folder", "file")
                raise UserError(f"{path} is a {found}, and stands where a {wanted} belongs: move it away")

    def config(self) -> RunConfig:
        """Read the settings that the run was started with. Raises UserError, also for a task that is not at hand."""
        try:
            return configuration.load(self.config_file, RunConfig())  # a setting that came later is at its default
        except ConfigError as error:
            name = self._task_that_is_missing()
            if name is not None:
                again = (
                    f"name it again, --env {name}" if ":" in name else "name its file again, --env FILE.py:NAME"
                )
                raise UserError(
                    f"{self.path} is of the task {name}, which is not at hand: {again}, in Python env="
                ) from error
            raise UserError(str(error)) from error

    def _task_that_is_missing(self) -> str | None:
        """The task of this run, with its file where that is known; None where it is at hand, or nobody knows it."""
        try:
            name = json.loads(self.config_file.read_text(encoding="utf-8"))["env"]["name"]
        except (OSError, ValueError, KeyError, TypeError, RecursionError):
            return None
        if not isinstance(name, str) or name in tasks.names():
            return None
        source = self._made().get("source")
        return f"{name!r} of {source}" if source else repr(name)

    def _told(self) -> dict[str, Any]:
        """What is known of how the run was made; nothing of a run of version 0.1.0."""
        try:
            told = json.loads(self.origin_file.read_text(encoding="utf-8"))
        except (OSError, ValueError, RecursionError):
            return {}
        return told if isinstance(told, dict) else {}

    def _made(self) -> dict[str, Any]:
        """What is known of the task that the run was made in."""
        made = self._told().get("task")
        return made if isinstance(made, dict) else {}

    def begun_from(self) -> str | None:
        """Return the run that this one started from; None where it started from nothing, or does not say."""
        return self._told().get("from")

    def warn_of_changed_task(self, warn: Callable[[str], None]) -> None:
        """Say that a task from outside is no longer what it was when the run was made. It goes on all the same."""
        made, own = self._made(), tasks.brought(self.config().task)
        if own is not None and made and made.get("sha256") != own.digest:
            source = own.source or own.task.name
            warn(f"{source} has changed since {self.path} was made: the task is played as it is now")

    def settings(self) -> dict[str, Any]:
        """Return the same as they stand in the file: a version that knows more settings does not add to them."""
        self.config()  # refuses what is no configuration
        return json.loads(self.config_file.read_text(encoding="utf-8"))

    @contextmanager
    def locked(self) -> Generator[None]:
        """Hold the folder for one writing process; the system frees the lock of one that died."""
        lock = FileLock(self.path / ".lock")
        try:
            lock.acquire(timeout=0)
        except Timeout as error:
            raise UserError(f"{self.path} is in use by another gacrl process: wait for it, or stop it") from error
        try:
            yield
        finally:
            lock.release()

    @contextmanager
    def writing(self, task: str) -> Generator[None]:
        """Raise UserError, with how to resume the run of this task, where one of its files cannot be written.

        Nothing but writing belongs into it: an OSError of somebody else's code is not about this folder.
        """
        try:
            yield
        except OSError as error:
            raise UserError(
                f"cannot write to {self.path}: {reason(error)}; make room there or allow writing, "
                f"then `{self.resumed_by(task)}` goes on from the last checkpoint"
            ) from error

    def resumed_by(self, task: str) -> str:
        """Return the command that resumes this run of a task."""
        return resuming(self.path, task)

    def append_metrics(self, rows: list[dict[str, Any]]) -> None:
        """Add one line per row to `metrics.jsonl` and see it to the disk."""
        with self.metrics_file.open("a", encoding="utf-8") as file:
            file.writelines(json.dumps(row) + "\n" for row in rows)
            file.flush()
            os.fsync(file.fileno())

    def metrics(self) -> list[dict[str, Any]]:
        """Return every row that was written; a last line that a crash cut off is left out.

        Raises UserError for a damaged line before the last, by its number.
        """
        lines = self.metrics_file.read_bytes().splitlines()
        rows: list[dict[str, Any]] = []
        for number, line in enumerate(lines, start=1):
            try:
                row = json.loads(line)
                if not isinstance(row, dict) or type(row.get("env_steps")) is not int:
                    raise ValueError("it is not an object with env_steps")
                rows.append(row)  # pyright: ignore[reportUnknownArgumentType]
            except (ValueError, RecursionError) as error:
                if number < len(lines):
                    raise UserError(f"line {number} of {self.metrics_file} is damaged: {error}") from error
        return rows

    def forget_metrics_after(self, env_steps: int) -> int:
        """Drop the rows past a checkpoint, which the resumed run writes again; returns how many stay."""
        rows = self.metrics() if self.metrics_file.exists() else []
        rows = [row for row in rows if row["env_steps"] <= env_steps]
        replace_text(self.metrics_file, "".join(json.dumps(row) + "\n" for row in rows))
        return len(rows)

    def extend(self, env_steps: int) -> None:
        """Set the planned environment steps anew; every other setting stays as it stands in the file."""
        settings = self.settings()
        settings["training"] = {**settings.get("training", {}), "env_steps": env_steps}
        replace_json(self.config_file, settings)

    def write_summary(self, summary: dict[str, Any]) -> None:
        """Replace `summary.json`."""
        replace_json(self.summary_file, summary)

    def write_diverged(self, because: str) -> None:
        """Say in `diverged.json` that the run ended so."""
        replace_json(self.diverged_file, {"because": because}, indent=None)

    def why_diverged(self) -> str | None:
        """Return why the run diverged; None where it did not. Raises UserError for a damaged file."""
        if not self.diverged_file.is_file():
            return None
        try:
            return str(json.loads(self.diverged_file.read_text(encoding="utf-8"))["because"])
        except (OSError, KeyError, TypeError, ValueError, RecursionError) as error:
            raise UserError(
                f"{self.diverged_file} is damaged: remove it, and `gacrl resume {self.path}` finds out again"
            ) from error


def resuming(path: Path, task: str = tasks.DEFAULT) -> str:
    """Return the command that goes on with a run, to copy: whatever its folder is called."""
    brought = "" if tasks.brought(task) is None else tasks.flag(task)  # the run's settings name one of ours
    return f"gacrl resume {shlex.quote(str(path))}{brought}"


def _origin(config: RunConfig, begun_from: str | None) -> dict[str, Any]:
    """What made a run: the versions, a task's source where it is not ours, and the run that it starts from."""
    own = tasks.brought(config.task)
    task = {"name": config.task}
    if own is not None:
        task |= {"source": own.source and own.source.name, "sha256": own.digest}
    return {"gacrl": version(), "versions": versions(), "task": task, "from": begun_from}


def _is_run(path: Path) -> bool:
    return (path / "config.json").is_file()


def _next_free(parent: Path, name: str) -> Path:
    """Make and return `parent/name-K`, K one more than any there is."""
    parent.mkdir(parents=True, exist_ok=True)
    while True:
        taken = [re.fullmatch(rf"{re.escape(name)}-(\d+)", entry.name) for entry in parent.iterdir()]
        number = max((int(match[1]) for match in taken if match), default=0) + 1
        try:
            (parent / f"{name}-{number}").mkdir()
        except FileExistsError:
            continue  # another process was quicker
        return parent / f"{name}-{number}"
