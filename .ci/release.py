"""Build wheel and sdist, and try each in a fresh environment, from another folder, as somebody who installs it would.

python .ci/release.py [LEG …]     all legs without one: wheel-3.11 wheel-3.12 wheel-3.13 sdist lowest

A leg whose Python is missing is skipped, and said to be. The leg `lowest` has the oldest versions that pyproject.toml
allows, on the oldest Python. Needs the network, and some 800 MB of disk for one leg at a time.
"""

import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
MOST_PACKAGES, MOST_MEGABYTES = 50, 850
OLDEST, PYTHONS = "3.11", ("3.11", "3.12", "3.13")
SMOKE = """
import sys, time
begun = time.perf_counter()
import gacrl
seconds = time.perf_counter() - begun
assert "jax" not in sys.modules, "import gacrl imports jax"
assert seconds < 0.2, f"import gacrl takes {seconds:.2f} s"
from importlib.resources import files
assert (files("gacrl") / "py.typed").is_file()
import numpy as np
policy = gacrl.load_policy("pretrained:gacrl")
assert policy(np.zeros((3, 18))).shape == (3,)
print(f"import gacrl takes {seconds * 1000:.0f} ms")
"""
COMMANDS = (
    ("--version",),
    ("train", "--preset", "ippo", "--env", "reference", "--env-steps", "800", "--training.num-envs", "4",
     "--evaluation.num-episodes", "2", "--evaluation.final-episodes", "4", "--out", "run", "--track", "csv"),
    ("evaluate", "run", "--episodes", "4"),
    ("evaluate", "pretrained:gacrl", "--episodes", "2", "--backend", "mpe2"),
    ("export", "run", "--out", "policy.safetensors"),
    ("export", "pretrained:gacrl", "--out", "policy.npz"),
)  # fmt: skip


def interpreter(version: str) -> str | None:
    """Return a Python of this version that starts; a shim of pyenv may not."""
    for name in (
        shutil.which(f"python{version}"),
        *map(str, Path.home().glob(f".pyenv/versions/{version}.*/bin/python")),
    ):
        if name is None:
            continue
        asked = [name, "-c", "import sys; print('%d.%d' % sys.version_info[:2])"]
        done = subprocess.run(asked, capture_output=True, text=True, check=False)
        if done.stdout.strip() == version:
            return name
    return None


def build(python: str, folder: Path) -> dict[str, Path]:
    """Build both distributions of a checkout, the wheel out of the sdist."""
    subprocess.run([python, "-m", "venv", folder / "build"], check=True)
    tool = folder / "build" / "bin" / "python"
    subprocess.run([tool, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "build"], check=True)
    subprocess.run([tool, "-m", "build", "--outdir", folder / "dist", ROOT], check=True, stdout=subprocess.DEVNULL)
    (wheel,), (sdist,) = (folder / "dist").glob("*.whl"), (folder / "dist").glob("*.tar.gz")
    return {"wheel": wheel, "sdist": sdist}


def lowest() -> list[str]:
    """Return what the package needs, each at the oldest version that pyproject.toml allows."""
    needs = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["dependencies"]
    return [re.sub(r">=", "==", need) for need in needs]


def weigh(environment: Path) -> str:
    """Return how many packages are installed beside pip and setuptools, and the size of all.

    Raises SystemExit where it is more than promised.
    """
    packages = {path.name.partition("-")[0] for path in environment.rglob("*.dist-info")} - {"pip", "setuptools"}
    size = sum(path.lstat().st_blocks * 512 for path in environment.rglob("*")) / 2**20  # pip's files too
    weight = f"{len(packages)} packages, {size:.0f} MB"
    if len(packages) > MOST_PACKAGES or size > MOST_MEGABYTES:
        raise SystemExit(f"an install takes {weight}; at most {MOST_PACKAGES} and {MOST_MEGABYTES} are promised")
    return weight


def attempt(python: str, archive: Path, folder: Path, pins: list[str]) -> str:
    """Install an archive into a fresh environment, use it in a folder whose name has a space, return its weight."""
    subprocess.run([python, "-m", "venv", folder / "venv"], check=True)
    tool, elsewhere = folder / "venv" / "bin" / "python", folder / "some where"
    install = [tool, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", archive, *pins]
    subprocess.run(install, check=True)
    weight = weigh(folder / "venv")
    elsewhere.mkdir()
    subprocess.run([tool, "-c", "import gacrl"], check=True, cwd=elsewhere)  # compiles its files
    subprocess.run([tool, "-c", SMOKE], check=True, cwd=elsewhere)
    for words in COMMANDS:
        command = [tool.with_name("gacrl"), *words]
        done = subprocess.run(command, cwd=elsewhere, capture_output=True, text=True, check=False)
        if done.returncode:
            raise SystemExit(f"gacrl {' '.join(words)} ends with {done.returncode}:\n{done.stdout}{done.stderr}")
    return weight


def main(asked: list[str]) -> None:
    """Try the legs that are asked for, and say of each how it went."""
    legs = {f"wheel-{version}": ("wheel", version, []) for version in PYTHONS}
    legs |= {"sdist": ("sdist", OLDEST, []), "lowest": ("wheel", OLDEST, lowest())}
    odd = [leg for leg in asked if leg not in legs]
    if odd:
        raise SystemExit(f"there is no leg {odd[0]}: {', '.join(legs)}")
    with tempfile.TemporaryDirectory(prefix="gacrl-release-") as place:
        archives = build(sys.executable, Path(place))
        for leg in asked or legs:
            kind, version, pins = legs[leg]
            python = interpreter(version)
            if python is None:
                print(f"{leg:12} SKIPPED: there is no Python {version} here", flush=True)
                continue
            with tempfile.TemporaryDirectory(prefix=f"{leg}-", dir=place) as folder:
                weight = attempt(python, archives[kind], Path(folder), pins)
            print(f"{leg:12} works: {archives[kind].name}, {weight}", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
