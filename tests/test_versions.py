"""The commit that a run notes is that of our sources, whosever repository surrounds them."""

import shutil
import subprocess
from pathlib import Path

import pytest

from gacrl.versions import git_commit

OURS = '[project]\nname = "gacrl"\n'


def git(folder: Path, *words: str) -> str:
    done = subprocess.run(
        ["git", "-C", str(folder), "-c", "user.email=a@b", "-c", "user.name=x", *words],
        capture_output=True,
        text=True,
        check=True,
    )
    return done.stdout.strip()


def repository(folder: Path, project: str) -> str:
    """One with a package in `src` and its project's file, committed."""
    (folder / "src" / "gacrl").mkdir(parents=True)
    (folder / "pyproject.toml").write_text(project)
    git(folder, "init", "-q", ".")
    git(folder, "commit", "-q", "--allow-empty", "-m", project)
    return git(folder, "rev-parse", "HEAD")


@pytest.mark.skipif(shutil.which("git") is None, reason="needs git")
def test_only_our_own_repository_is_noted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    clone, theirs = tmp_path / "clone", tmp_path / "theirs"
    commit, other = repository(clone, OURS), repository(theirs, '[project]\nname = "thesis"\n')
    installed = theirs / ".venv" / "lib" / "python3.11" / "site-packages" / "gacrl"
    unpacked = theirs / "vendor" / "gacrl-0.2.0" / "src" / "gacrl"
    for folder in (installed, unpacked):
        folder.mkdir(parents=True)
    (unpacked.parents[1] / "pyproject.toml").write_text(OURS)

    assert git_commit(clone / "src" / "gacrl") == commit
    (clone / "src" / "gacrl" / "new.py").write_text("x = 1\n")
    assert git_commit(clone / "src" / "gacrl") == f"{commit}-dirty"
    (clone / "src" / "gacrl" / "new.py").unlink()
    for package in (installed, unpacked, theirs / "src" / "gacrl", Path("/gacrl")):
        assert git_commit(package) is None
    monkeypatch.setenv("GIT_DIR", str(theirs / ".git"))  # as in a hook of theirs
    assert git_commit(clone / "src" / "gacrl") == commit != other
    monkeypatch.setenv("PATH", str(tmp_path))
    assert git_commit(clone / "src" / "gacrl") is None, "a machine without git"
