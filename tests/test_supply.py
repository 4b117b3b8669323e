"""No file of a run makes code run, and nothing is fetched: what the sources may use, and what a poisoned run does."""

import ast
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import gacrl
from gacrl.cli.main import main
from gacrl.config import files as configuration
from gacrl.config import presets
from gacrl.evaluation.episodes import Episode

ROOT = Path(__file__).parent.parent
SOURCES = sorted(Path(gacrl.__file__).parent.rglob("*.py"))

RUN_CODE = {"pickle", "marshal", "shelve", "dill", "cloudpickle", "joblib", "yaml", "runpy", "imp"}
FETCH = {"socket", "ssl", "urllib", "http", "ftplib", "smtplib", "requests", "httpx", "aiohttp", "telnetlib"}


TALKS: dict[str, set[str]] = {
    # --distributed and --ray name who to talk to.
    "training/peers.py": {"socket"},
    "experiments/ray_search.py": {"socket"},
    # A page is served where the user says, and nothing is asked of anybody.
    "viewer/beside.py": {"socket"},
    "viewer/guard.py": {"socket", "urllib.parse"},
    "viewer/running.py": {"socket"},
    # A training and the processes that it has started, by a socket that nobody else has.
    "tasks/foreign/crew.py": {"socket", "cloudpickle"},
    "tasks/foreign/worker.py": {"pickle"},
}


def faults(source: str) -> list[str]:
    """Imports and calls that could run what a file holds, or reach the network."""
    found: list[str] = []
    for node in ast.walk(ast.parse(source)):
        imported = []
        if isinstance(node, ast.Import):
            imported = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            imported = [node.module or ""]
        found += [name for name in imported if name.partition(".")[0] in RUN_CODE | FETCH]
        if isinstance(node, ast.Call):
            called = ast.unparse(node.func)
            refused = any(
                keyword.arg == "allow_pickle" and ast.unparse(keyword.value) == "False"
                for keyword in node.keywords
            )
            if called in ("eval", "exec", "compile", "__import__") or (called == "np.load" and not refused):
                found.append(called)
    return found


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(SOURCES[0].parent)))
def test_sources_neither_run_what_they_read_nor_fetch(path: Path):
    assert set(faults(path.read_text(encoding="utf-8"))) == TALKS.get(
        path.relative_to(SOURCES[0].parent).as_posix(), set()
    )


@pytest.mark.parametrize(
    "source",
    ["import pickle", "from urllib import request", "eval('1')", "np.load(path)", "np.load(p, allow_pickle=True)"],
)
def test_what_could_is_seen(source: str):
    assert len(faults(source)) == 1


class Payload:
    def __init__(self, path: Path):
        self.path = path

    def __reduce__(self) -> Any:
        return Path.touch, (self.path,)


def test_a_poisoned_run_runs_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    """Settings that name a program, and an episode with an object in it."""
    proof, run = tmp_path / "proof", tmp_path / "run"
    run.mkdir()
    for folder in (tmp_path, run):
        (folder / "task.py").write_text(f"open({str(proof)!r}, 'w')\nclass Task: pass\n")
    monkeypatch.chdir(tmp_path)
    settings = configuration.to_dict(presets.preset())
    settings["env"]["name"] = "task.py:Task"
    (run / "config.json").write_text(json.dumps(settings))
    for command in ("resume", "evaluate", "render"):
        assert main([command, str(run)]) == 2
        assert "is of the task 'task.py:Task', which is not at hand" in capsys.readouterr().err

    arrays = dict.fromkeys(("reward", "reward_raw", "agent_mask"), np.zeros(1))
    np.savez(run / "0.npz", **arrays, actions=np.array([Payload(proof)], object))
    with pytest.raises(ValueError, match="is not a recorded episode: .*allow_pickle"):
        Episode.load(run / "0.npz")
    assert not proof.exists()


def test_what_is_installed_for_ci_is_locked():
    """Every dependency, to the version, by name alone: no address of a registry."""
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pinned = [line for line in lines if line and not line.startswith("#")]
    assert all(re.fullmatch(r"[A-Za-z0-9_.-]+==[A-Za-z0-9_.+!-]+", line) for line in pinned)
    names = {line.partition("==")[0].lower().replace("_", "-") for line in pinned}
    project = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    asked = re.findall(r'^  "([A-Za-z0-9_-]+)(?:\[\w+\])?[>=<]', project, flags=re.MULTILINE)
    assert len(asked) > 15
    assert {name.lower() for name in asked} <= names
    assert "-c constraints.txt" in (ROOT / "Makefile").read_text(encoding="utf-8")
