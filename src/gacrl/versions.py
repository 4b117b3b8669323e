"""Which versions of what is running. A leaf: it imports no jax."""

import os
import platform
import subprocess
import tomllib
from functools import cache
from importlib import metadata
from pathlib import Path

DIRTY = "-dirty"

_PACKAGE = Path(__file__).resolve().parent


def version(package: str = "gacrl") -> str:
    """Return the version of an installed package."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:  # imported from a folder of sources that was never installed
        return "not installed"


def versions() -> dict[str, str]:
    """Return what produced a run: packages, Python, and the commit where the source is a checkout of our own
    repository.

    As they are when this process first asks, at the start of a run: a commit made since did not train it. A commit
    ends in `-dirty` where the sources have changes that are not in it.
    """
    return dict(_versions())


@cache
def _versions() -> dict[str, str]:
    packages = ("gacrl", "jax", "jaxlib", "equinox", "optax", "numpy", "mpe2")
    commit = git_commit(_PACKAGE)
    return {
        **{name: version(name) for name in packages},
        "python": platform.python_version(),
        **({} if commit is None else {"git_commit": commit}),
    }


def git_commit(package: Path) -> str | None:
    """Return the commit of our own repository, whose `src` holds this package; None where another one surrounds it, or
    none.

    With changes in `src` that are not committed it ends in `-dirty`.

    A virtual environment may lie in its user's repository, and a hook of theirs may name that in GIT_DIR.
    """
    root = package.parent.parent
    if package.parent.name != "src" or not (root / ".git").exists() or not _is_ours(root / "pyproject.toml"):
        return None
    commit, changes = _git(root, "rev-parse", "HEAD"), _git(root, "status", "--porcelain", "--", "src")
    return f"{commit}{DIRTY}" if commit and changes else commit


def _git(root: Path, *words: str) -> str | None:
    """What git answers there; None where it does not."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("GIT_")}
    git = ["git", "-C", str(root), *words]
    try:
        done = subprocess.run(git, capture_output=True, text=True, timeout=5, check=False, env=environment)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout.strip() if done.returncode == 0 else None


def _is_ours(project: Path) -> bool:
    try:
        return tomllib.loads(project.read_text(encoding="utf-8"))["project"]["name"] == "gacrl"
    except (OSError, ValueError, KeyError, TypeError):
        return False
