"""Which versions of what is running. A leaf: it imports no jax."""

import platform
import subprocess
from importlib import metadata
from pathlib import Path


def version(package: str = "gacrl") -> str:
    """Of an installed package."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:  # imported from a folder of sources that was never installed
        return "not installed"


def versions() -> dict[str, str]:
    """What produced a run: packages, Python, and the commit where the source is a git checkout."""
    packages = ("gacrl", "jax", "jaxlib", "equinox", "optax", "numpy", "mpe2")
    found = {name: version(name) for name in packages}
    git = ["git", "-C", str(Path(__file__).parent), "rev-parse", "HEAD"]
    try:
        done = subprocess.run(git, capture_output=True, text=True, timeout=5, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return {**found, "python": platform.python_version()}
    commit = {"git_commit": done.stdout.strip()} if done.returncode == 0 else {}
    return {**found, "python": platform.python_version(), **commit}
