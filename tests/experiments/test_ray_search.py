"""Searches on a real Ray cluster of two nodes, 127.0.0.2 and 127.0.0.3: nodes and drivers may die, finished trials stay."""

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
import venv
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

pytestmark = [pytest.mark.cluster, pytest.mark.xdist_group("ray")]

FILE = """
preset = "ippo"
metric = "distance_landmark_agent"
direction = "minimize"
trials = 6
env_steps = 3600

[fixed]
training = {num_envs = 4, num_steps = 5}
evaluation = {interval = 200, num_episodes = 4, final_episodes = 8}

[search]
algorithm.learning_rate = {log = [1e-4, 1e-1]}
algorithm.update_epochs = {integer = [1, 2]}
algorithm.reward = {choice = ["own", "team"]}
"""

HEAD, OTHER = "127.0.0.2", "127.0.0.3"


class Cluster:
    """Nodes with a core each; killing one kills all its processes."""

    def __init__(self, environment: dict[str, str], python: str = sys.executable):
        self.python = python
        self.environment = {**environment, "RAY_USAGE_STATS_ENABLED": "0"}
        self.folder = Path(tempfile.mkdtemp(prefix="ray-", dir="/tmp"))  # sockets need short paths
        self.nodes: dict[str, subprocess.Popen[bytes]] = {}
        with socket.create_server((HEAD, 0)) as server:
            self.address = f"{HEAD}:{server.getsockname()[1]}"

    def start(self, node: str) -> None:
        port = self.address.rpartition(":")[2]
        where = ["--head", "--port", port] if node == HEAD else ["--address", self.address]
        own = ["--temp-dir", str(self.folder), "--include-dashboard", "false"] if node == HEAD else []
        ray = [self.python, "-m", "ray.scripts.scripts", "start", *where, *own]
        words = [*ray, "--node-ip-address", node, "--num-cpus", "1", "--disable-usage-stats", "--block"]
        with (self.folder / f"{node}.log").open("ab") as log:
            self.nodes[node] = subprocess.Popen(
                words, env=self.environment, stdout=log, stderr=log, start_new_session=True
            )
        end = time.monotonic() + 120
        while len(self.alive()) < len(self.nodes):
            assert time.monotonic() < end, (self.folder / f"{node}.log").read_text()
            time.sleep(1)

    def alive(self) -> list[str]:
        """The nodes that the head knows to be alive."""
        code = (
            f"import ray; ray.init(address='{self.address}', log_to_driver=False, logging_level='ERROR'); "
            "print(*[node['NodeManagerAddress'] for node in ray.nodes() if node['Alive']])"
        )
        done = subprocess.run([sys.executable, "-c", code], env=self.environment, capture_output=True, text=True)
        return done.stdout.split()

    def kill(self, node: str) -> None:
        started = self.nodes.pop(node)
        for child in descendants(started.pid):
            os.kill(child, signal.SIGKILL)
        started.wait()

    def close(self) -> None:
        for node in list(self.nodes):
            self.kill(node)
        shutil.rmtree(self.folder, ignore_errors=True)


def descendants(process: int) -> list[int]:
    """A process and all that it started, itself last."""
    parents: dict[int, list[int]] = {}
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = stat.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        parents.setdefault(int(fields[1]), []).append(int(stat.parent.name))
    found: list[int] = []
    for child in parents.get(process, []):
        found += descendants(child)
    return [*found, process]


@pytest.fixture(scope="module")
def cluster(quick_start: dict[str, str]) -> Iterator[Cluster]:
    cluster = Cluster(quick_start)
    try:
        cluster.start(HEAD)
        cluster.start(OTHER)
        yield cluster
    finally:
        cluster.close()


@pytest.fixture
def file(tmp_path: Path) -> Path:
    (tmp_path / "search.toml").write_text(FILE, encoding="utf-8")
    return tmp_path / "search.toml"


def drive(cluster: Cluster, file: Path, out: Path) -> subprocess.Popen[str]:
    words = [sys.executable, "-m", "gacrl", "sweep", str(file), "--ray", cluster.address, "--out", str(out)]
    pipes: Any = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    return subprocess.Popen(words, env=cluster.environment, **pipes)


def finished(out: Path) -> dict[str, int]:
    """When each finished trial was finished."""
    return {path.parent.name: path.stat().st_mtime_ns for path in out.glob("trials/*/summary.json")}


def wait_until(condition: Any, driver: subprocess.Popen[str], seconds: float = 400) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert driver.poll() is None, driver.communicate()[0]
        assert time.monotonic() < end
        time.sleep(0.1)


def test_a_python_whose_path_has_a_space_is_refused_at_once(
    quick_start: dict[str, str], file: Path, tmp_path: Path
):
    """Ray's shell takes such a path apart, and Tune would wait for its workers for ever."""
    venv.create(tmp_path / "new comer")
    python = tmp_path / "new comer" / "bin" / "python"
    (own,) = (tmp_path / "new comer").glob("lib/*/site-packages")
    (own / "all.pth").write_text("\n".join(path for path in sys.path if path.endswith("site-packages")))
    with closing(Cluster(quick_start, str(python))) as cluster:
        cluster.start(HEAD)
        driver = drive(cluster, file, tmp_path / "out")
        said = driver.communicate(timeout=60)[0]
    assert driver.returncode == 2
    assert said.startswith(f"gacrl: Ray cannot start trials on {HEAD}, since the path of its Python has a space")
    assert str(python) in said and said.count("\n") == 1


def test_workers_that_do_not_start_are_told_with_their_last_words(
    quick_start: dict[str, str], file: Path, tmp_path: Path
):
    shell = tmp_path / "bin" / "bash"
    shell.parent.mkdir()
    shell.write_text("#!/bin/sh\necho 'bash: not today' >&2\nexit 1\n")
    shell.chmod(0o755)
    with closing(Cluster({**quick_start, "PATH": f"{shell.parent}:{os.environ['PATH']}"})) as cluster:
        cluster.start(HEAD)
        begun = time.monotonic()
        driver = drive(cluster, file, tmp_path / "out")
        said = driver.communicate(timeout=90)[0]
    assert time.monotonic() - begun < 75
    assert driver.returncode == 2
    assert said.startswith(
        f"gacrl: Ray started no worker on {HEAD} within 45 s (bash: not today): see {cluster.folder}"
    )


@pytest.mark.skipif(shutil.which("make") is None, reason="needs make")
def test_make_cluster_says_that_it_needs_a_plain_path(tmp_path: Path):
    clone = tmp_path / "new comer"
    clone.mkdir()
    shutil.copy(Path(__file__).parents[2] / "Makefile", clone)
    done = subprocess.run(["make", "cluster"], cwd=clone, capture_output=True, text=True)
    assert done.returncode == 2 and "clone into a folder whose path has no space" in done.stderr
    assert [path.name for path in clone.iterdir()] == ["Makefile"], "nothing was installed"


def test_a_node_and_a_driver_die_and_no_finished_trial_is_lost(cluster: Cluster, file: Path, tmp_path: Path):
    out = tmp_path / "out"
    driver = drive(cluster, file, out)
    try:
        wait_until(lambda: len(list(out.glob("trials/*/metrics.jsonl"))) == 2, driver)
        cluster.kill(OTHER)
        wait_until(lambda: len(finished(out)) >= 2, driver)
    finally:
        driver.kill()
        driver.communicate()
    before = finished(out)
    assert len(before) < 6

    cluster.start(OTHER)
    driver = drive(cluster, file, out)
    said = driver.communicate(timeout=900)[0]
    assert driver.returncode == 0, said
    after = finished(out)
    assert {name: after.get(name) for name in before} == before, "they were not trained again"
    trials = json.loads((out / "summary.json").read_text())["trials"]
    assert len(trials) == 6
    states = [trial["state"] for trial in trials]
    assert set(states) <= {"finished", "pruned"}
    assert "pruned" in states, "poor ones were given up"
    values = [trial["value"] for trial in trials if trial["state"] == "finished"]
    assert values == sorted(values)
    assert all(trial["env_steps"] == 3600 for trial in trials if trial["state"] == "finished")
    assert all(trial["env_steps"] < 3600 for trial in trials if trial["state"] == "pruned")
    assert all(name in said or name in before for name in (trial["name"] for trial in trials))

    again = drive(cluster, file, out)
    said = again.communicate(timeout=300)[0]
    assert again.returncode == 0, said
    assert finished(out) == after


@pytest.mark.parametrize(
    ("address", "sentence"),
    [
        ("127.0.0.9:1", "no Ray cluster answers at 127.0.0.9:1"),
        ("nonsense", "--ray must be HOST:PORT of the cluster's head, or auto, not 'nonsense'"),
    ],
)
def test_a_cluster_that_is_not_there_is_refused_at_once(
    address: str, sentence: str, file: Path, tmp_path: Path, quick_start: dict[str, str]
):
    words = [sys.executable, "-m", "gacrl", "sweep", str(file), "--ray", address, "--out", str(tmp_path / "out")]
    done = subprocess.run(words, env=quick_start, capture_output=True, text=True, timeout=300)
    assert done.returncode == 2
    assert done.stderr.startswith(f"gacrl: {sentence}")
    assert done.stderr.count("\n") == 1
