"""What a run survives: kills while it writes, full and read-only disks, damage, a clock that jumps back."""

import contextlib
import json
import os
import resource
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from conftest import TinyRun, content

from gacrl import play
from gacrl.errors import UserError
from gacrl.experiments.paper import tables as paper_tables
from gacrl.training import build, checkpoint, session
from gacrl.training.recorder import RunFolder
from gacrl.training.watching import Watcher
from gacrl.training.writer import Writer

pytestmark = [pytest.mark.usefixtures("one_trainer"), pytest.mark.xdist_group("runs")]

TIMES = ("steps_per_second", "compile_seconds", "wall_seconds")


@pytest.fixture(scope="module", autouse=True)
def nothing_drawn() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(session.episodes, "cut", lambda *_: [])
        patch.setattr(session.reel, "gif", lambda *_, **__: None)
        patch.setattr(paper_tables, "table_2", lambda *_: [])
        patch.setattr(paper_tables, "table_3", lambda *_: [])
        yield


@pytest.fixture
def copy(tiny_run: TinyRun, tmp_path: Path) -> Path:
    """The tiny run, 450 steps, to be spoilt."""
    return Path(shutil.copytree(tiny_run.folder, tmp_path / "copy"))


def rows(folder: Path) -> list[dict[str, Any]]:
    """Every line of the metrics, without the times that no two runs share."""
    lines = (folder / "metrics.jsonl").read_text().splitlines()
    return [{name: value for name, value in json.loads(line).items() if name not in TIMES} for line in lines]


def assert_same_end(folder: Path, other: Path) -> None:
    assert rows(folder) == rows(other)
    newest = [max(path.glob("checkpoints/step-*")) / "state.safetensors" for path in (folder, other)]
    assert newest[0].read_bytes() == newest[1].read_bytes()
    summaries = [json.loads((path / "summary.json").read_text()) for path in (folder, other)]
    assert summaries[0]["final"] == summaries[1]["final"]


# Kills.

WRITER = """
import json, os, random, signal, sys, time
from pathlib import Path
import numpy as np
from gacrl.training import checkpoint
from gacrl.training.recorder import RunFolder

folder, kills, chance = RunFolder(Path(sys.argv[1])), int(sys.argv[2]), random.Random(0)
folder.checkpoints.mkdir(parents=True)
folder.metrics_file.touch()

def tensors(step):
    return checkpoint.serialise({"numbers": np.random.default_rng(step).normal(size=50_000)})

def write_on(done):
    with folder.locked():  # of the process before, which died with it
        assert folder.forget_metrics_after(done) == done
        while True:
            done += 1
            folder.append_metrics([{"env_steps": done}])
            checkpoint.save(folder.checkpoints, tensors(done), done, "", {"rows": done})

begun = time.perf_counter()
checkpoint.save(folder.checkpoints, tensors(0), 0, "", {})
pace = time.perf_counter() - begun
torn = done = 0
for number in range(10 * kills):
    if number >= kills and min(done, torn) >= 5:  # on a busy machine it takes more of them
        break
    child = os.fork()
    if child == 0:
        write_on(done)
    time.sleep(chance.uniform(0, 4 * pace * max(1.0, number / kills)))
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    torn += any(folder.checkpoints.glob(".unfinished*"))
    before = done
    found, damaged = checkpoint.newest(folder.checkpoints)
    assert not damaged
    assert (found.folder / "state.safetensors").read_bytes() == tensors(found.env_steps)
    done = found.env_steps
    steps = [row["env_steps"] for row in folder.metrics()]
    assert before <= done <= len(steps) <= done + 1, (before, done, steps)
    assert steps == list(range(1, len(steps) + 1)), "none missing, none twice"
print(json.dumps({"done": done, "torn": torn}))
"""


def test_nothing_is_lost_however_often_a_writer_is_killed(tmp_path: Path):
    """kill -9 at fifty random moments of a process that does nothing but write."""
    words = [sys.executable, "-c", WRITER, str(tmp_path / "run"), "50"]
    done = subprocess.run(words, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout.splitlines()[-1])
    assert found["done"] >= 5, "it goes on between the kills"
    assert found["torn"] >= 5, "and some of them hit a checkpoint half written"


def test_a_stop_by_the_system_ends_in_a_checkpoint(
    copy: Path, tiny_run: TinyRun, said: Callable[..., tuple[int, str]], monkeypatch: pytest.MonkeyPatch
):
    """SIGTERM in the middle of a chunk: exit 143. (SIGINT: test_resume.py.)"""
    real = RunFolder.append_metrics

    def terminated(self: RunFolder, rows: list[dict[str, Any]]) -> None:
        signal.raise_signal(signal.SIGTERM)
        real(self, rows)

    with monkeypatch.context() as patch:
        patch.setattr(RunFolder, "append_metrics", terminated)
        assert said("resume", copy, "--extend", 120) == (143, "")
    assert checkpoint.newest(copy / "checkpoints")[0].env_steps == 510
    assert said("resume", copy) == (0, "")
    assert [row["env_steps"] for row in rows(copy)][::2] == [*range(60, 450, 60), 450, 510, 570]


# The background.


def test_training_goes_on_while_a_checkpoint_is_written():
    writing, disk, written = threading.Event(), threading.Event(), []

    def slow(number: int) -> None:
        writing.set()
        assert disk.wait(60)
        written.append(number)

    with Writer() as writer:
        writer.submit(lambda: slow(1))
        assert writing.wait(60)
        assert written == [], "nobody waits for the disk"
        disk.set()
        writer.submit(lambda: slow(2))
        assert written[:1] == [1], "but for the write before"
    assert written == [1, 2], "and at the end"


def fail() -> None:
    raise OSError(28, "No space left on device")


def test_an_error_of_the_background_comes_to_the_front():
    with pytest.raises(OSError, match="No space"), Writer() as writer:
        writer.submit(fail)
    with Writer() as writer:
        writer.submit(fail)
        with pytest.raises(OSError, match="No space"):
            writer.submit(lambda: None)
        writer.submit(lambda: None)
    with pytest.raises(KeyboardInterrupt), Writer() as writer:
        writer.submit(fail)
        raise KeyboardInterrupt


# Disks.


def test_a_disk_without_room_loses_nothing(copy: Path, said: Callable[..., tuple[int, str]]):
    """A true limit on the size of files, which binds any user: the checkpoint does not fit, and then does."""
    before, limits = content(copy), resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, limits[1]))
    try:
        code, sentence = said("resume", copy, "--extend", 60)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert code == 2
    assert sentence.startswith(f"gacrl: cannot write to {copy}: File too large; make room there")
    assert sentence.count("\n") == 1
    after = content(copy)
    assert {name: after[name] for name in before if name.startswith("checkpoints")} == {
        name: data for name, data in before.items() if name.startswith("checkpoints")
    }
    assert after["metrics.jsonl"].startswith(before["metrics.jsonl"])
    assert not any(copy.glob("checkpoints/.unfinished*")), "a full disk gets its room back"
    assert said("resume", copy) == (0, "")
    assert [row["env_steps"] for row in rows(copy)][::2] == [*range(60, 450, 60), 450, 510]


@contextlib.contextmanager
def nobody() -> Iterator[None]:
    """As a user whom permissions bind: root is not."""
    if os.geteuid():
        yield
        return
    os.seteuid(65534)
    try:
        yield
    finally:
        os.seteuid(0)


def test_a_folder_that_may_not_be_written(tiny_run: TinyRun, said: Callable[..., tuple[int, str]]):
    with tempfile.TemporaryDirectory() as made:
        folder = Path(shutil.copytree(tiny_run.folder, Path(made) / "run"))
        (folder / ".lock").unlink(missing_ok=True)
        for path in (Path(made), *folder.rglob("*"), folder):
            path.chmod(0o555 if path.is_dir() else 0o444)
        before = content(folder)
        with nobody():
            code, sentence = said("resume", folder, "--extend", 60)
            started, why = said("train", *tiny_run.words, "--out", Path(made) / "new")
        assert (code, sentence) == (2, f"gacrl: cannot use {folder}/.lock: Permission denied\n")
        assert started == 2
        assert (
            why == f"gacrl: cannot write the run folder {made}/new: Permission denied; choose another with --out\n"
        )
        assert content(folder) == before
        for path in (Path(made), folder, *folder.rglob("*")):
            path.chmod(0o755)


# Damage.


@pytest.mark.parametrize("damage", ["flipped", "cut off"])
def test_a_damaged_checkpoint_costs_a_chunk_and_no_bit(
    damage: str,
    copy: Path,
    tiny_run: TinyRun,
    said: Callable[..., tuple[int, str]],
    monkeypatch: pytest.MonkeyPatch,
):
    """The one before it is taken, and says so; beside it a lock that somebody left, and a clock that jumps back."""
    newest = copy / "checkpoints/step-000000000450"
    data = bytearray((newest / "state.safetensors").read_bytes())
    data[len(data) // 2] ^= 1
    (newest / "state.safetensors").write_bytes(data if damage == "flipped" else data[: len(data) // 2])
    (copy / "summary.json").unlink()
    (copy / ".lock").write_text("999999999\n")
    past = iter(range(2_000_000_000, 0, -3600))
    monkeypatch.setattr(time, "time", lambda: float(next(past)))
    for k, path in enumerate(sorted(copy.rglob("*"))):
        os.utime(path, (4_000_000_000 - 86_400 * k,) * 2)

    code, sentence = said("resume", copy)
    assert code == 0
    assert sentence == (
        f"gacrl: checkpoint {newest} is damaged (state.safetensors does not match its checksum); "
        "taking the one before it\n"
    )
    assert_same_end(copy, tiny_run.folder)
    assert (copy / "checkpoints/.damaged-step-000000000450").is_dir(), "it is out of the way, and not thrown away"
    assert said("resume", copy) == (0, "")


def test_a_damaged_best_policy_is_out_of_the_way_and_not_thrown_away(
    copy: Path, said: Callable[..., tuple[int, str]]
):
    (best,) = (copy / "checkpoints").glob("best-*")
    tensors = (best / "state.safetensors").read_bytes()
    (best / "manifest.json").unlink()
    shutil.rmtree(copy / "checkpoints/step-000000000450")
    code, sentence = said("resume", copy)
    aside = best.with_name(f".damaged-{best.name}")
    assert (code, sentence) == (
        0,
        f"gacrl: the best policy so far was damaged and is {aside} now: the best from here on is kept\n",
    )
    assert (aside / "state.safetensors").read_bytes() == tensors
    assert [path.name for path in (copy / "checkpoints").glob("best-*")] == ["best-000000000450"]


@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        ("episodes", "is a file, and stands where a folder belongs: move it away"),
        ("checkpoints", "is a file, and stands where a folder belongs: move it away"),
        ("summary.json", "is a folder, and stands where a file belongs: move it away"),
        ("episodes.gif", "is a link, and a run is written in its own folder: move it away"),
    ],
)
def test_what_is_in_the_way_is_told_before_anything_is_trained(
    copy: Path, said: Callable[..., tuple[int, str]], name: str, sentence: str
):
    shutil.rmtree(copy / "checkpoints/step-000000000450")
    if (copy / name).is_dir():
        shutil.rmtree(copy / name)
        (copy / name).touch()
    elif name.endswith("gif"):
        (copy / name).unlink(missing_ok=True)
        (copy / name).symlink_to(copy.parent / "elsewhere.gif")
    else:
        (copy / name).unlink()
        (copy / name).mkdir()
    before = content(copy)
    assert said("resume", copy) == (2, f"gacrl: {copy / name} {sentence}\n")
    assert content(copy) == before


def test_a_link_in_the_place_of_an_unfinished_file_leads_nobody_out(
    copy: Path, said: Callable[..., tuple[int, str]], tmp_path: Path
):
    outside = tmp_path / "outside.txt"
    outside.write_text("years of work")
    for name in ("metrics.jsonl", "summary.json", "config.json"):
        (copy / f".{name}.unfinished").symlink_to(outside)
    assert said("resume", copy, "--extend", 30) == (0, "")
    assert outside.read_text() == "years of work"
    assert not any(path.is_symlink() for path in copy.iterdir())


def test_evaluations_that_are_gone_are_told(copy: Path, said: Callable[..., tuple[int, str]]):
    lines = (copy / "metrics.jsonl").read_text().splitlines(keepends=True)
    (copy / "metrics.jsonl").write_text("".join(lines[4:]))
    code, sentence = said("resume", copy)
    assert code == 0
    assert sentence.startswith(f"gacrl: {copy / 'metrics.jsonl'} has 12 of the 16 lines that were written up to")

    shutil.rmtree(copy / "checkpoints")
    before = content(copy)
    code, sentence = said("resume", copy)
    assert (code, content(copy)) == (2, before)
    assert (
        sentence
        == f"gacrl: {copy / 'checkpoints'} has lost its checkpoints: train the run again into a new folder\n"
    )


def test_a_watcher_is_told_of_damage(copy: Path):
    """Also from Python, where nothing is printed."""
    (copy / "checkpoints/step-000000000450/manifest.json").write_text("[" * 100_000)
    told: list[str] = []
    session.resume(copy, watcher=Watcher(warn=told.append))
    assert len(told) == 1
    assert "is damaged (maximum recursion depth exceeded" in told[0]
    with pytest.raises(UserError, match="is missing"):
        checkpoint.newest(copy / "nowhere")


# The network.


def test_nothing_is_fetched(copy: Path, said: Callable[..., tuple[int, str]], monkeypatch: pytest.MonkeyPatch):
    """Training, its closing evaluation, and playing, without a network. (A process from its first line: test_resume.py.)"""

    def offline(*address: Any) -> None:
        raise AssertionError(f"the network is asked for {address}")

    for name in ("connect", "connect_ex", "sendto"):
        monkeypatch.setattr(socket.socket, name, offline)
    for name in ("getaddrinfo", "gethostbyname", "create_connection"):
        monkeypatch.setattr(socket, name, offline)
    assert said("resume", copy, "--extend", 60) == (0, "")
    assert said("evaluate", copy, "--episodes", 8) == (0, "")


# The best.


def test_the_best_policy_is_the_one_that_was_evaluated(copy: Path):
    """Its parameters are those of the step that it names, and `RUN@best` has them."""
    (best,) = (copy / "checkpoints").glob("best-*")
    returns: dict[int, list[float]] = {}
    for row in rows(copy):
        returns.setdefault(row["env_steps"], []).append(row["greedy"]["return_agent_mean"])
    means = {steps: float(np.mean(values)) for steps, values in returns.items()}
    found, _ = checkpoint.newest(copy / "checkpoints", checkpoint.BEST)
    assert found.folder == best
    assert found.env_steps == max(means, key=lambda steps: means[steps])
    assert found.counters == {"return_agent_mean": means[found.env_steps]}
    assert best.joinpath("state.safetensors").stat().st_size < 0.5 * max(
        path.stat().st_size for path in copy.glob("checkpoints/step-*/state.safetensors")
    ), "no replay and no optimiser"

    config = RunFolder(copy).config()
    trainer = build.make_trainer(config)
    learners = session.load_learners(found, trainer)
    played = trainer.evaluate(learners, False, "monitor", config.evaluation.num_episodes)
    np.testing.assert_array_equal(
        np.float32([values.mean() for values in jax.device_get(played["return_agent_mean"])]),
        np.float32(returns[found.env_steps]),
    )
    opened = play.open_run(f"{copy}@1@best")
    assert opened.env_steps == found.env_steps
    for here, there in zip(
        jax.tree.leaves(opened.learners.network), jax.tree.leaves(learners.network), strict=True
    ):
        np.testing.assert_array_equal(here[0], np.asarray(there)[1])
