"""The command as a process: any letters, any reader, any disk; exit codes; and the time that it says it took."""

import os
import re
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from conftest import TinyRun

pytestmark = pytest.mark.xdist_group("runs")

GACRL = [sys.executable, "-m", "gacrl"]
TINY = [
    *("--preset", "ippo", "--env-steps", "1.6e3", "--algorithm.network.width", "8"),
    *("--evaluation.num-episodes", "2", "--evaluation.final-episodes", "2"),
]
NAME = f"Läufe {'x' * 190} für später"
"""Of 202 letters, with umlauts and spaces."""


@pytest.fixture
def run(quick_start: dict[str, str], tmp_path: Path) -> Callable[..., subprocess.CompletedProcess[bytes]]:
    """Runs a command as a process of its own; keywords are its environment."""

    def start(*words: object, out: int | object = subprocess.PIPE, **environment: str):
        return subprocess.run(
            [*GACRL, *map(str, words)],
            stdout=out,
            stderr=subprocess.PIPE,
            cwd=tmp_path,
            env={**quick_start, "PYTHONUNBUFFERED": "", **environment},
            timeout=300,
            check=False,
        )

    return start


@pytest.mark.parametrize(
    "environment",
    [
        {"PYTHONIOENCODING": "ascii"},
        {"PYTHONIOENCODING": "cp1252"},
        {"PYTHONIOENCODING": "ascii", "PYTHONUNBUFFERED": "1"},
        {"LC_ALL": "C"},
        {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"},
    ],
    ids=str,
)
def test_help_is_printed_in_any_letters(
    environment: dict[str, str], run: Callable[..., subprocess.CompletedProcess[bytes]]
):
    done = run("sweep", "--help", **environment)
    assert (done.returncode, done.stderr) == (0, b"")
    said = done.stdout.decode("cp1252" if environment.get("PYTHONIOENCODING") == "cp1252" else "utf-8")
    assert re.search("learning rate, (ε and τ|epsilon and tau) at the start", said)
    assert "SPEC" in said


def test_what_was_computed_is_printed_in_plain_letters(
    tiny_run: TinyRun, run: Callable[..., subprocess.CompletedProcess[bytes]]
):
    done = run("evaluate", tiny_run.folder, "--episodes", 4, PYTHONIOENCODING="ascii")
    assert (done.returncode, done.stderr) == (0, b"")
    title, *table = done.stdout.decode("ascii").splitlines()
    assert title.endswith("4 episodes of 15 steps; mean over seeds +/- half the 95 % interval")
    assert len({len(line) for line in table}) == 1, "and the columns are straight"


@pytest.mark.parametrize("unbuffered", ["", "1"])
def test_a_reader_that_has_gone_ends_no_command(
    tiny_run: TinyRun,
    tmp_path: Path,
    unbuffered: str,
    run: Callable[..., subprocess.CompletedProcess[bytes]],
):
    for words in (("train", "--help"), ("compare", tiny_run.folder, "--no-replays", "--out", "page")):
        reader, writer = os.pipe()
        os.close(reader)
        done = run(*words, out=writer, PYTHONUNBUFFERED=unbuffered)
        os.close(writer)
        assert (done.returncode, done.stderr) == (0, b""), words
    assert (tmp_path / "page" / "comparison.html").is_file()


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no such device here")
def test_output_that_cannot_be_written_is_told_when_all_is_done(
    tiny_run: TinyRun, tmp_path: Path, run: Callable[..., subprocess.CompletedProcess[bytes]]
):
    with Path("/dev/full").open("wb") as full:
        done = run("compare", tiny_run.folder, "--no-replays", "--out", "page", out=full)
    assert done.returncode == 2
    assert done.stderr == b"gacrl: cannot use standard output: No space left on device\n"
    assert (tmp_path / "page" / "comparison.html").is_file()


@pytest.mark.soak
def test_a_folder_of_any_name_and_the_time_on_the_wall(
    tmp_path: Path, run: Callable[..., subprocess.CompletedProcess[bytes]]
):
    folder = tmp_path / "Übung 1" / NAME
    begun = time.monotonic()
    done = run("train", *TINY, f"--out=~/{folder.relative_to(tmp_path)}", HOME=str(tmp_path))
    took = time.monotonic() - begun
    assert (done.returncode, done.stderr) == (0, b"")
    lines = done.stdout.decode().splitlines()
    assert f"summary    {folder}/summary.json" in lines
    said = re.fullmatch(r"time +([\d.]+) s in all, .*", lines[-1])
    assert said is not None
    # Python needs a while to end; the run's own clock, without imports and closing evaluation, counts less than half.
    assert 0.75 * took < float(said[1]) <= took

    for words in (
        ("evaluate", folder, "--episodes", "2"),
        ("render", folder, "--episodes", "1", "--horizon", "3", "--out", folder.with_suffix(".gif")),
        ("compare", folder, "--out", folder.with_name("page")),
        ("train", *TINY, "--out", folder),
    ):
        done = run(*words)
        assert b"Traceback" not in done.stderr
        assert done.returncode == (2 if words[0] == "train" else 0), words
    assert f"or continue it with `gacrl resume '{folder}'`\n".encode() in done.stderr, "quoted, to be copied"
    assert folder.with_suffix(".gif").is_file()
