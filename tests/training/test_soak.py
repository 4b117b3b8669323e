"""Training that is killed, gone on with and killed again, for as long as it is asked to; and one process that never ends.

`make soak` takes 30 minutes for each; GACRL_SOAK_MINUTES says another time. For every change, test_resume.py kills a
command once, and test_faults.py what writes, again and again.
"""

import contextlib
import io
import json
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import pytest

from gacrl.cli.main import main
from gacrl.config import files as configuration
from gacrl.config import presets
from gacrl.config.run import EvaluationConfig, RunConfig, TrainingConfig

pytestmark = pytest.mark.xdist_group("soak")

SECONDS = 60 * float(os.environ.get("GACRL_SOAK_MINUTES", "30"))
KILLS = int(os.environ.get("GACRL_SOAK_KILLS", "50"))
MEMORY = 3 * 2**30
"""Bytes of data that a training process may ask for."""
TIMES = ("steps_per_second", "compile_seconds", "wall_seconds")


def config(env_steps: int) -> RunConfig:
    """IPPO on a few numbers, an evaluation every 16 steps: most of a process goes into starting, all else into writing."""
    tuned = presets.preset("ippo")
    return replace(
        tuned,
        algorithm=replace(tuned.algorithm, network=replace(tuned.algorithm.network, width=8), update_epochs=2),
        env=replace(tuned.env, max_cycles=5),
        training=TrainingConfig(env_steps=env_steps, num_envs=2, num_steps=4),
        evaluation=EvaluationConfig(interval=16, num_episodes=2, final_episodes=2),
    )


def gacrl(*words: object) -> int:
    with contextlib.redirect_stdout(io.StringIO()):
        return main([str(word) for word in words])


def rows(folder: Path) -> list[dict[str, Any]]:
    """Every whole line of the metrics, without the times that no two runs share."""
    path = folder / "metrics.jsonl"
    lines = path.read_text().split("\n")[:-1] if path.exists() else []
    return [{name: value for name, value in json.loads(line).items() if name not in TIMES} for line in lines]


def newest_tensors(folder: Path) -> bytes:
    return max((folder / "checkpoints").glob("step-*")).joinpath("state.safetensors").read_bytes()


@dataclass
class Seen:
    """What the killed processes were like."""

    kills: int = 0
    while_writing: int = 0
    before_a_checkpoint: int = 0
    finished: int = 0
    memory: list[int] = field(default_factory=list)
    """MiB resident of every process that had begun to train, when it was killed."""
    files: list[int] = field(default_factory=list)


@pytest.fixture
def start(quick_start: dict[str, str], tmp_path: Path) -> Iterator[Any]:
    children: list[subprocess.Popen[bytes]] = []
    errors = (tmp_path / "errors").open("ab")

    def run(*words: object) -> subprocess.Popen[bytes]:
        child = subprocess.Popen(
            [sys.executable, "-m", "gacrl", *map(str, words)],
            env=quick_start,
            stdout=subprocess.DEVNULL,
            stderr=errors,
        )
        resource.prlimit(child.pid, resource.RLIMIT_DATA, (MEMORY, MEMORY))
        children.append(child)
        return child

    yield run
    for child in children:
        child.kill()
        child.wait()
    errors.close()


def wait_to_kill(child: subprocess.Popen[bytes], folder: Path, chance: random.Random, begun_with: int) -> None:
    """Until a random moment, counted from the first line that the process writes; every third time, until it writes."""
    metrics, writing = folder / "metrics.jsonl", chance.random() < 1 / 3
    if chance.random() < 0.1:  # somewhere in its start
        time.sleep(chance.uniform(0, 5))
        return
    while child.poll() is None and len(rows(folder)) <= begun_with:
        time.sleep(0.001)
    end = time.monotonic() + chance.uniform(0, 0.3)
    while child.poll() is None and (time.monotonic() < end or writing):
        if writing and any((folder / "checkpoints").glob(".unfinished*")):
            return
        time.sleep(0.0005)
    assert metrics.exists()


def look(child: subprocess.Popen[bytes], seen: Seen) -> None:
    process = Path(f"/proc/{child.pid}")
    with contextlib.suppress(OSError, StopIteration):
        status = (process / "status").read_text().splitlines()
        resident = next(int(line.split()[1]) for line in status if line.startswith("VmHWM"))
        files = len(list((process / "fd").iterdir()))
        seen.memory.append(resident // 1024)
        seen.files.append(files)


def kill_again_and_again(start: Any, tmp_path: Path, kills: int, seconds: float) -> Seen:
    """At random moments, also while a checkpoint is written: every run ends with the bits of one that never was."""
    settings = tmp_path / "settings.json"
    settings.write_text(configuration.dumps(config(env_steps=640)))
    whole, chance, seen = tmp_path / "whole", random.Random(0), Seen()
    assert gacrl("train", "--config", settings, "--out", whole) == 0
    expected, end = rows(whole), time.monotonic() + seconds
    final = {name: json.loads((whole / "summary.json").read_text())[name] for name in ("final", "references")}

    folder, number = tmp_path / "run-0", 0
    while time.monotonic() < end or seen.kills < kills or not seen.finished:
        resumable = (folder / "config.json").exists()
        words = ("resume", folder) if resumable else ("train", "--config", settings, "--out", folder)
        begun_with = len(rows(folder))
        child = start(*words)
        wait_to_kill(child, folder, chance, begun_with)
        look(child, seen)
        if child.poll() is None:
            child.send_signal(signal.SIGKILL)
            child.wait()
            seen.kills += 1
            seen.while_writing += any(folder.glob("checkpoints/.unfinished*"))
            seen.before_a_checkpoint += not any(folder.glob("checkpoints/step-*"))
            found = rows(folder)
            assert found == expected[: len(found)], "every evaluation once, none missing"
            print(seen.kills, words[0], len(found) - begun_with, flush=True)
            if folder.exists() and not (folder / "config.json").exists():
                shutil.rmtree(folder)  # killed before it had its settings
            continue
        assert child.returncode == 0, (tmp_path / "errors").read_text()
        seen.finished += 1
        summary = json.loads((folder / "summary.json").read_text())
        assert rows(folder) == expected
        assert newest_tensors(folder) == newest_tensors(whole)
        assert {name: summary[name] for name in final} == final
        shutil.rmtree(folder)
        number += 1
        folder = tmp_path / f"run-{number}"
    print(seen)
    assert max(seen.files) <= min(seen.files) + 8, "files stay open"
    return seen


@pytest.mark.soak
def test_killed_again_and_again(start: Any, tmp_path: Path):
    seen = kill_again_and_again(start, tmp_path, KILLS, SECONDS)
    third = len(seen.memory) // 3
    assert max(seen.memory[-third:]) < 1.1 * max(seen.memory[:third]), "memory grows from process to process"


@pytest.mark.soak
def test_one_process_that_never_ends(tmp_path: Path, quick_start: dict[str, str]):
    """Runs begun, stopped and gone on with in one process, as a study does: neither memory nor open files grow."""
    worker = [sys.executable, Path(__file__).parent / "study_worker.py", tmp_path / "run", SECONDS]
    done = subprocess.run(list(map(str, worker)), env=quick_start, stdout=subprocess.PIPE, text=True, check=True)
    resident, files = zip(*(map(int, line.split()) for line in done.stdout.splitlines()), strict=True)
    print(resident, files)
    settled = resident[2:]
    half = len(settled) // 2
    assert max(settled[half:]) < 1.05 * max(settled[:half]), "memory grows from run to run"
    assert max(files[2:]) == min(files[2:]), "files stay open"
