"""Trackers get what `metrics.jsonl` gets; one that fails, hangs or is slow is named once, and training waits for none."""

import csv
import json
import shutil
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import pytest
from conftest import TinyRun

from gacrl.errors import UserError
from gacrl.training.build import Plan
from gacrl.training.loop import Clock, Progress
from gacrl.training.recorder import RunFolder
from gacrl.training.trackers import TRACKERS, Tracker, chosen
from gacrl.training.trackers.following import tracked
from gacrl.training.trackers.sink import Sink
from gacrl.training.trainer import TrainState

pytestmark = [pytest.mark.usefixtures("unchecked"), pytest.mark.xdist_group("runs")]

PLAN = Plan(1, 1, 1, (), 3, 15, ())
STATE = TrainState(*[()] * len(TrainState._fields))  # pyright: ignore[reportArgumentType] no tracker looks at it


class Played(NamedTuple):
    folder: RunFolder
    rows: list[dict[str, Any]]
    seconds: float
    """That training waited for its trackers, without the end."""
    warned: list[str]


@pytest.fixture
def replayed(tiny_run: TinyRun, tmp_path: Path) -> Callable[..., Played]:
    """Tells trackers of a run that was trained: two seeds, eight evaluations, the summary and the GIF."""
    shutil.copytree(tiny_run.folder, tmp_path / "run")

    def play(*names: str, patience: float = 20.0, first: int = 0) -> Played:
        folder = RunFolder.open(tmp_path / "run")
        rows, warned = folder.metrics(), list[str]()
        steps = sorted({row["env_steps"] for row in rows})
        with tracked(names, warned.append, patience) as watcher:
            begun = time.perf_counter()
            watcher.planned(folder, folder.config(), PLAN)
            for step in steps[first:]:
                told = tuple(row for row in rows if row["env_steps"] == step)
                watcher.progress(Progress(step, steps[-1], Clock(), told, STATE, {}, STATE, 0.0))
            watcher.finished(json.loads(folder.summary_file.read_text()))
            seconds = time.perf_counter() - begun
        return Played(folder, rows, seconds, warned)

    return play


def test_csv_has_every_row_once_also_after_a_resumption(replayed: Callable[..., Played]):
    replayed("csv")
    played = replayed("csv", first=3)
    with (played.folder.path / "progress.csv").open(newline="") as file:
        table = list(csv.DictReader(file))
    assert [(int(row["seed"]), int(row["env_steps"])) for row in table] == [
        (row["seed"], row["env_steps"]) for row in played.rows
    ]
    assert [float(row["greedy.return_agent_mean"]) for row in table] == [
        row["greedy"]["return_agent_mean"] for row in played.rows
    ]
    assert not played.warned


def means(rows: list[dict[str, Any]]) -> list[float]:
    steps = sorted({row["env_steps"] for row in rows})
    of = [[row["greedy"]["return_agent_mean"] for row in rows if row["env_steps"] == step] for step in steps]
    return [sum(values) / len(values) for values in of]


def test_tensorboard_reads_the_curves_and_the_picture(replayed: Callable[..., Played]):
    pytest.importorskip("tensorboard", reason="pip install 'gacrl[track]'")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    played = replayed("tensorboard", "csv")
    found = EventAccumulator(str(played.folder.path / "tensorboard"), {"images": 0, "scalars": 0})
    found.Reload()

    def curve(tag: str) -> list[float]:
        return [float(event.value) for event in found.Scalars(tag)]

    assert curve("greedy/return_agent_mean") == pytest.approx(means(played.rows))
    assert curve("seed-5/greedy/return_agent_mean") == pytest.approx(
        [row["greedy"]["return_agent_mean"] for row in played.rows if row["seed"] == 5]
    )
    assert len(curve("final/greedy/return_agent_mean")) == 1
    (picture,) = found.Images("episodes")
    assert picture.encoded_image_string == played.folder.gif.read_bytes()
    assert not played.warned


def test_trackio_keeps_the_curves(
    replayed: Callable[..., Played], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    pytest.importorskip("trackio", reason="pip install 'gacrl[track]'")
    monkeypatch.setattr("trackio.utils.TRACKIO_DIR", tmp_path / "trackio")
    monkeypatch.setattr("trackio.sqlite_storage.TRACKIO_DIR", tmp_path / "trackio")
    played = replayed("trackio")
    from trackio.sqlite_storage import SQLiteStorage

    rows = SQLiteStorage.get_logs("gacrl", "run")
    told = [row["greedy/return_agent_mean"] for row in rows if "greedy/return_agent_mean" in row]
    assert told == pytest.approx(means(played.rows))
    assert any("episodes" in row for row in rows)
    assert not played.warned


def test_wandb_writes_offline(replayed: Callable[..., Played], monkeypatch: pytest.MonkeyPatch):
    pytest.importorskip("wandb", reason="pip install 'gacrl[track]'")
    monkeypatch.delenv("WANDB_MODE", raising=False)
    played = replayed("wandb")
    (kept,) = played.folder.path.glob("wandb/offline-run-*/run-*.wandb")
    assert b"greedy/return_agent_mean" in kept.read_bytes()
    assert list(played.folder.path.glob("wandb/offline-run-*/files/media/videos/*.gif"))
    assert not played.warned


@pytest.fixture
def odd(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., threading.Event]]:
    """Brings a tracker that does something when it is told of an evaluation; the event releases one that waits."""
    release = threading.Event()

    def bring(name: str, do: Callable[[], object], begin: Callable[[], object] = lambda: None) -> threading.Event:
        module: Any = ModuleType(f"odd_{name}")

        def start(*given: Any) -> Sink:
            begin()
            return Sink(lambda rows: do() and None, lambda *_: None, lambda *_: None, lambda: None)

        module.begin = start
        monkeypatch.setitem(sys.modules, module.__name__, module)
        monkeypatch.setattr(
            "gacrl.training.trackers.following.TRACKERS",
            {**TRACKERS, **added, name: added.setdefault(name, Tracker(module.__name__, None, ""))},
        )
        return release

    added: dict[str, Tracker] = {}
    yield bring
    release.set()


def test_one_that_fails_is_named_once_and_the_others_go_on(replayed: Callable[..., Played], odd: Any):
    def fail() -> None:
        raise OSError("no space\nleft on device")

    odd("broken", fail)
    odd("absent", lambda: None, begin=lambda: {}["network"])
    played = replayed("broken", "csv", "absent")
    assert sorted(played.warned) == [
        "the tracker absent failed and is left out from here on ('network'); the training goes on without it",
        "the tracker broken failed and is left out from here on (no space left on device); "
        "the training goes on without it",
    ]
    assert len((played.folder.path / "progress.csv").read_text().splitlines()) == 1 + len(played.rows)


@pytest.mark.parametrize(
    ("waiting", "said"),
    [(256, "hangs, and is not waited for"), (2, "is too slow: what it has no room for is left out")],
)
def test_one_that_hangs_is_named_once_and_not_waited_for(
    waiting: int, said: str, replayed: Callable[..., Played], odd: Any, monkeypatch: pytest.MonkeyPatch
):
    release = odd("stuck", lambda: release.wait(60))
    monkeypatch.setattr("gacrl.training.trackers.following.WAITING", waiting)
    begun = time.perf_counter()
    played = replayed("stuck", "csv", patience=0.5)
    assert played.seconds < 0.5, "training waits for nobody"
    assert time.perf_counter() - begun < 5
    told = [sentence for sentence in played.warned if "stuck" in sentence]
    assert told == [f"the tracker stuck {said}; the training goes on without it"]
    assert (played.folder.path / "progress.csv").is_file()


def test_what_is_missing_is_said_before_anything_is_trained(
    said: Callable[..., tuple[int, str]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    assert chosen(" csv,,csv ") == ("csv",)
    assert chosen(()) == ()
    monkeypatch.setattr("gacrl.extras.find_spec", lambda name: None)
    for names, sentence in (
        ("tensorbord", "unknown tracker 'tensorbord': did you mean 'tensorboard'?"),
        ("csv,trackio", "trackio must be installed for this: pip install 'gacrl[track]'"),
    ):
        assert said("train", "--out", tmp_path / "run", "--track", names) == (2, f"gacrl: {sentence}\n")
    assert not list(tmp_path.iterdir())
    with pytest.raises(UserError, match="wandb must be installed"):
        chosen(["wandb"])
