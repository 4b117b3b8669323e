"""Seconds that each command takes, the compilation cache empty and full.

    python benchmarks/commands.py [--rounds 3]

Every round is a process of its own in an empty folder. `train` here is a training of 2,500 steps with all that
closes one (evaluation, episodes, GIF); what is between two updates is benchmarks/training.py's. The first update by
itself: benchmarks/first_update.py.
"""

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

SHORT = ("--training.env-steps", "2500", "--evaluation.num-episodes", "32")
BEFORE = ("train", "--preset", "mappo", *SHORT, "--out", "there")
"""Makes the run that others take, once, untimed."""
COMMANDS: tuple[tuple[str, ...], ...] = (
    ("--help",),
    ("train", "--help"),
    ("presets",),
    ("train", "--preset", "gacrl", *SHORT, "--out", "here"),
    ("train", "--preset", "paper", *SHORT, "--out", "here"),
    ("train", "--preset", "mappo", *SHORT, "--out", "here"),
    ("train", "--preset", "qmix", *SHORT, "--out", "here"),
    ("resume", "there", "--extend", "5000"),
    ("evaluate", "pretrained:gacrl"),
    ("evaluate", "pretrained:gacrl", "--backend", "mpe2", "--episodes", "32"),
    ("evaluate", "oracle"),
    ("render", "pretrained:gacrl", "--out", "here.gif"),
    ("compare", "there"),
)


def seconds(command: tuple[str, ...], cache: Path) -> float:
    """One run of a command. Raises CalledProcessError where it fails."""
    environment = {name: value for name, value in os.environ.items() if name != "JAX_COMPILATION_CACHE_DIR"}
    environment["XDG_CACHE_HOME"] = str(cache)
    gacrl = (sys.executable, "-m", "gacrl")
    with tempfile.TemporaryDirectory() as room:
        if "there" in command:
            subprocess.run([*gacrl, *BEFORE], cwd=room, env=os.environ, check=True, capture_output=True)
        begun = time.perf_counter()
        subprocess.run([*gacrl, *command], cwd=room, env=environment, check=True, capture_output=True)
        return time.perf_counter() - begun


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=3, help="warm ones; there is one cold")
    asked = parser.parse_args()
    print("| command | cold, s | warm, s |\n| --- | --- | --- |")
    for command in COMMANDS:
        with tempfile.TemporaryDirectory() as cache:
            cold, *warm = (seconds(command, Path(cache)) for _ in range(1 + asked.rounds))
        spread = f"{statistics.median(warm):.1f} ({min(warm):.1f} to {max(warm):.1f})"
        print(f"| `gacrl {' '.join(command)}` | {cold:.1f} | {spread} |", flush=True)


if __name__ == "__main__":
    main()
