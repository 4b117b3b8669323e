"""Training by several devices and processes gives what one gives; which process of a cluster this is; who dies."""

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
import safetensors.numpy
import spread_worker
from conftest import assert_nearly_same
from jax.sharding import Mesh

from gacrl.algorithms.shared import ENVS
from gacrl.cli.main import main
from gacrl.config.presets import preset
from gacrl.errors import UserError
from gacrl.training import build, checkpoint, devices
from gacrl.training.distributed import find_place
from gacrl.training.peers import Place

WORKER = Path(spread_worker.__file__)


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return server.getsockname()[1]


class Job:
    """Programs that run side by side, and none of which outlives the test."""

    def __init__(self, environment: dict[str, str]):
        self.environment = {**environment, "JAX_NUM_CPU_DEVICES": "1"}
        self.running: list[subprocess.Popen[str]] = []

    def start(self, *words: object) -> subprocess.Popen[str]:
        command = [sys.executable, *map(str, words)]
        pipes: Any = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
        self.running.append(subprocess.Popen(command, env=self.environment, **pipes))
        return self.running[-1]

    def together(self, count: int, *words: object) -> list[subprocess.Popen[str]]:
        """`gacrl` in so many processes, as one."""
        where = ("--distributed", "--coordinator", f"127.0.0.1:{free_port()}", "--num-processes", count)
        return [self.start("-m", "gacrl", *words, *where, "--process-id", k) for k in range(count)]

    def finish(self, *codes: int, seconds: float = 900) -> list[str]:
        """What each said; they must end with these codes (none: all well), in this time."""
        said = [child.communicate(timeout=seconds)[0] for child in self.running]
        assert [child.returncode for child in self.running] == list(codes or [0] * len(said)), "\n".join(said)
        self.running.clear()
        return said


@pytest.fixture
def job(quick_start: dict[str, str]) -> Iterator[Job]:
    job = Job(quick_start)
    yield job
    for child in job.running:
        child.kill()
        child.communicate()


# The same numbers.


def alone(name: str, seeds: int) -> dict[str, np.ndarray]:
    """Ten updates of each seed by itself, on one device of this process."""
    config = replace(spread_worker.configs(seeds)[name], num_seeds=1)
    device = Mesh(np.asarray(jax.local_devices()[:1]).reshape(1, 1), ("seeds", ENVS))
    trainer, count = build.make_trainer(config, device), spread_worker.configs(seeds)[name].num_seeds
    each = [spread_worker.after_ten_updates(trainer, replace(config, seed=seed)) for seed in range(count)]
    return {path: np.concatenate([found[path] for found in each]) for path in each[0]}


def assert_same(file: Path, expected: dict[str, np.ndarray], seeds: int, strays: int = 0) -> None:
    """The file has the first seeds of what is expected."""
    found = dict(np.load(file))
    assert all(leaf.shape[0] == seeds for leaf in found.values())
    assert_nearly_same(found, {path: leaf[:seeds] for path, leaf in expected.items()}, strays)


@pytest.mark.slow
def test_environments_on_eight_devices_and_on_two_processes(job: Job, tmp_path: Path):
    """PPO: two seeds with four devices each, and one seed on two processes, learn what they learn on one device."""
    (tmp_path / "eight").mkdir()
    (tmp_path / "two").mkdir()
    where = f"127.0.0.1:{free_port()}"
    job.start(WORKER, "ippo", tmp_path / "eight", 8)
    for process in (0, 1):
        job.start(WORKER, "ippo", tmp_path / "two", 1, where, 2, process)
    expected = alone("ippo", 8)
    job.finish()
    assert (expected[".key"][0] != expected[".key"][1]).any(), "the seeds differ"
    assert_same(tmp_path / "eight" / "ippo.npz", expected, seeds=2)
    assert_same(tmp_path / "two" / "ippo.npz", expected, seeds=1)


@pytest.mark.soak
def test_seeds_on_eight_devices_and_environments_and_seeds_on_four_processes(job: Job, tmp_path: Path):
    for folder in ("eight", "four"):
        (tmp_path / folder).mkdir()
    job.start(WORKER, "paper,gacrl", tmp_path / "eight", 8)
    job.finish()
    where = f"127.0.0.1:{free_port()}"
    for process in range(4):
        job.start(WORKER, "ippo,paper,gacrl", tmp_path / "four", 1, where, 4, process)
    job.finish()
    for name, strays in (("paper", 0), ("gacrl", 10)):
        seeds = alone(name, 8)
        assert_same(tmp_path / "eight" / f"{name}.npz", seeds, 8, strays)
        assert_same(tmp_path / "four" / f"{name}.npz", seeds, 4, strays)
    assert_same(tmp_path / "four" / "ippo.npz", alone("ippo", 4), seeds=1)


# Whole runs, deaths, resumption.

TINY = (
    *("--preset", "paper", "--num-seeds", 4, "--env.max-cycles", 15, "--algorithm.replay-capacity", 500),
    *("--evaluation.interval", 30, "--evaluation.num-episodes", 4, "--evaluation.final-episodes", 8),
)


def wait_for_lines(job: Job, folder: Path, count: int) -> None:
    metrics, end = folder / "metrics.jsonl", time.monotonic() + 240
    while not (metrics.exists() and len(metrics.read_text().splitlines()) >= count):
        assert all(child.poll() is None for child in job.running), job.finish()
        assert time.monotonic() < end
        time.sleep(0.01)


def tensors(folder: Path) -> dict[str, np.ndarray]:
    found, warnings = checkpoint.newest(folder / "checkpoints")
    assert warnings == []
    return safetensors.numpy.load_file(found.folder / "state.safetensors")


@pytest.mark.soak
@pytest.mark.parametrize(("count", "victim", "then"), [(2, 1, 3), (2, 0, 1), (4, 2, 2)])
def test_a_process_that_dies_ends_the_job_and_others_go_on(
    job: Job, tmp_path: Path, count: int, victim: int, then: int
):
    """Within 5 s, with a sentence; the checkpoint is good; another number of processes finishes the run."""
    folder = tmp_path / "run"
    running = job.together(count, "train", *TINY, "--env-steps", 100_000, "--out", folder)
    wait_for_lines(job, folder, 8)
    running[victim].send_signal(signal.SIGKILL)
    died = time.monotonic()
    survivors = [child for child in running if child is not running[victim]]
    said = [child.communicate(timeout=5)[0] for child in survivors]
    assert time.monotonic() - died < 5
    for child, words in zip(survivors, said, strict=True):
        assert child.returncode != 0
        assert f"gacrl: process {victim} of {count} has died, and with it the job" in words
        assert f"go on with `gacrl resume {folder}`" in words
    running[victim].communicate()
    job.running.clear()

    reached = checkpoint.newest(folder / "checkpoints")[0].env_steps
    assert reached >= 30, "one evaluation at most is ahead of its checkpoint"
    for path in (folder, tmp_path / "straight"):
        if path != folder:
            shutil.copytree(folder, path)
        config = json.loads((path / "config.json").read_text())
        config["training"]["env_steps"] = reached + 60  # as if it had been planned so
        (path / "config.json").write_text(json.dumps(config))
    job.together(then, "resume", folder)
    job.finish()
    assert main(["resume", str(tmp_path / "straight")]) == 0
    assert (folder / "summary.json").is_file()
    here, there = tensors(folder), tensors(tmp_path / "straight")
    assert here.keys() == there.keys()
    for name, leaf in there.items():
        np.testing.assert_allclose(here[name], leaf, atol=1e-4, err_msg=name)


@pytest.mark.soak
def test_a_whole_run_of_two_processes_stops_together_and_only_the_first_speaks(job: Job, tmp_path: Path):
    folder = tmp_path / "run"
    running = job.together(2, "train", *TINY, "--env-steps", 100_000, "--out", folder)
    wait_for_lines(job, folder, 8)
    running[1].send_signal(signal.SIGTERM)
    first, second = job.finish(130, 143)  # the second was told by the system, the first by the second
    assert "stopped at environment step" in first
    assert "run  " in first
    assert "run  " not in second
    assert "Traceback" not in first + second


@pytest.mark.soak
def test_a_mistake_of_one_process_ends_all_with_its_sentence(job: Job, tmp_path: Path):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "letter.txt").touch()
    first, second = job.together(2, "train", *TINY, "--env-steps", 100, "--out", tmp_path / "run")
    sentence = f"gacrl: {tmp_path / 'run'} exists and is not overwritten: choose another --out"
    for child, code in ((first, 2), (second, 1)):
        said = child.communicate(timeout=60)[0]
        assert child.returncode == code
        assert sentence in said
        assert "Traceback" not in said


# Which devices, which process.


def test_what_processes_cannot_share_is_refused(monkeypatch: pytest.MonkeyPatch):
    """Two devices stand for two processes."""
    first, second = jax.local_devices()[:2]

    class Far:
        process_index = 1

        def __getattr__(self, name: str) -> Any:
            return getattr(second, name)

    monkeypatch.setattr(jax, "process_count", lambda: 2)
    monkeypatch.setattr(jax, "devices", lambda: [first, Far()])
    monkeypatch.setattr(jax, "local_devices", lambda process=0: [[first], [second]][process])
    gacrl = preset("gacrl")
    with pytest.raises(UserError, match="2 processes cannot share 1 seeds .* give --num-seeds 2 or more"):
        build.mesh(gacrl)
    assert build.mesh(replace(gacrl, num_seeds=5)).shape == {"seeds": 2, "envs": 1}
    ippo = preset("ippo")
    assert build.mesh(ippo).shape == {"seeds": 1, "envs": 2}
    assert build.mesh(replace(ippo, num_seeds=2)).shape == {"seeds": 2, "envs": 1}
    odd = replace(ippo, training=replace(ippo.training, num_envs=9))
    with pytest.raises(UserError, match="num_envs 9 cannot be shared evenly by the 2 devices"):
        build.mesh(odd)


def test_one_process_spreads_environments_only_where_it_pays(monkeypatch: pytest.MonkeyPatch):
    assert devices.mesh_for(1, 64).shape == {"seeds": 1, "envs": 1}
    assert devices.mesh_for(3, 64).shape == {"seeds": 2, "envs": 1}
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert devices.mesh_for(1, 64).shape == {"seeds": 1, "envs": 2}
    assert devices.mesh_for(1, 63).shape == {"seeds": 1, "envs": 1}
    assert devices.mesh_for(1).shape == {"seeds": 1, "envs": 1}


@pytest.fixture
def nowhere(monkeypatch: pytest.MonkeyPatch) -> pytest.MonkeyPatch:
    """No cluster's variables are set."""
    for name in os.environ:
        if name.startswith(("SLURM_", "JAX_COORD", "JAX_NUM_PROC", "JAX_PROCESS", "OMPI_", "KUBERNETES")):
            monkeypatch.delenv(name)
    return monkeypatch


def test_a_place_is_found_in_flags_variables_and_slurm(nowhere: pytest.MonkeyPatch):
    assert find_place("[::1]:1234", 3, 2) == Place(2, 3, "::1", 1234)
    nowhere.setenv("JAX_COORDINATOR_ADDRESS", "head:99")
    nowhere.setenv("JAX_NUM_PROCESSES", "4")
    nowhere.setenv("JAX_PROCESS_ID", "3")
    assert find_place() == Place(3, 4, "head", 99)
    assert find_place(process_id=1) == Place(1, 4, "head", 99)
    for name in ("JAX_COORDINATOR_ADDRESS", "JAX_NUM_PROCESSES", "JAX_PROCESS_ID"):
        nowhere.delenv(name)
    slurm = {"JOB_ID": "10", "STEP_NODELIST": "node[007-009]", "NTASKS": "6", "PROCID": "5", "LOCALID": "1"}
    for name, value in slurm.items():
        nowhere.setenv(f"SLURM_{name}", value)
    assert find_place() == Place(5, 6, "node007", 65535 - 2**12 + 1 + 10, (1,))


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--distributed"], "no cluster is found here: give --coordinator HOST:PORT"),
        (["--process-id", "0"], "--coordinator, --num-processes and --process-id need --distributed"),
        (
            ["--distributed", "--coordinator", "h:1", "--num-processes", "2", "--process-id", "2"],
            "--process-id must be between 0 and 1 of 2 processes, not 2",
        ),
        (
            ["--distributed", "--coordinator", "h:1", "--num-processes", "0", "--process-id", "0"],
            "--num-processes must be at least 1, not 0",
        ),
        (
            ["--distributed", "--coordinator", "host", "--num-processes", "2", "--process-id", "0"],
            "the coordinator must be HOST:PORT, not 'host'",
        ),
        (["--distributed", "--wait", "0"], "--wait must be at least 1 second, not 0"),
    ],
)
def test_a_place_that_cannot_be_is_refused(
    words: list[str],
    sentence: str,
    nowhere: pytest.MonkeyPatch,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
):
    nowhere.chdir(tmp_path)
    assert main(["train", *words]) == 2
    said = capsys.readouterr().err
    assert said.startswith(f"gacrl: {sentence}")
    assert said.count("\n") == 1
    assert list(tmp_path.iterdir()) == []
