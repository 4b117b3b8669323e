"""Every command of the README and of the guides works, and every line of Python in them, word for word.

The presets are small ones here, and trainings and evaluations short; nothing else is changed.
"""

import re
import shlex
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import jax
import numpy as np
import pytest
from conftest import SCRIPTED_ROW, kept_trainers

import gacrl
from gacrl.cli import main as cli
from gacrl.config import presets
from gacrl.config.algorithms import GacrlConfig
from gacrl.config.run import RunConfig
from gacrl.experiments import scoring
from gacrl.experiments.paper import tables as paper_tables
from gacrl.export import html

ROOT = Path(__file__).parent.parent
BLOCKS = re.findall(r"```(\w+)\n(.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), flags=re.DOTALL)
COMMANDS = [
    line.split("#")[0].strip() for language, block in BLOCKS if language == "bash" for line in block.splitlines()
]
PYTHON = [block for language, block in BLOCKS if language == "python"]
GUIDE = (ROOT / "docs" / "guides" / "python.md").read_text(encoding="utf-8")

LONG = {"ablate", "doctor", "reproduce", "sweep", "talk", "view"}
"""Minutes each, or until Ctrl-C: the first is below, the others have tests of their own."""
GUIDES = sorted(path.stem for path in (ROOT / "docs" / "guides").glob("*.md"))
ELSEWHERE = {
    "cluster": "several machines, and Ray: tests/training/test_distributed.py, tests/experiments/test_ray_search.py",
    "python": "below, with what it must print",
}
"""Guides whose blocks are run by other tests."""

GIVEN: dict[str, dict[str, Any]] = {
    "export": {"features": np.zeros((2, 21), np.float32)},
    "jaxmarl": {"jax": jax, "key": jax.random.key(1), "actions": {"agent_0": 0, "agent_1": 0}},
}
"""What the reader of a guide has already."""


pytestmark = pytest.mark.xdist_group("readme")


@pytest.fixture
def room(from_outside, room_of_short_schedules):
    """The folder, in which the examples lie too."""


@pytest.fixture(scope="module")
def room_of_short_schedules(tmp_path_factory):
    """A folder to work in, in which the paper's schedule is short."""

    def short(preset: RunConfig) -> RunConfig:
        algorithm = preset.algorithm
        if isinstance(algorithm, GacrlConfig):
            algorithm = replace(algorithm, updates=1, batch_size=8, replay_capacity=500)
        return replace(
            preset,
            algorithm=algorithm,
            env=replace(preset.env, max_cycles=5),
            training=replace(
                preset.training,
                env_steps=500,
                num_envs=min(preset.training.num_envs, 25),
                num_steps=min(preset.training.num_steps, 5),
            ),
            evaluation=replace(preset.evaluation, interval=250, num_episodes=4, final_episodes=8),
        )

    score_run = scoring.score_run

    def few(run: str, episodes: int, **asked: Any) -> dict[str, Any]:
        return score_run(run, episodes=min(episodes, 4), **asked)

    shortened = {name: ("short", short(presets.preset(name))) for name in presets.PRESETS}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(presets, "PRESETS", MappingProxyType({**presets.PRESETS, **shortened}))
        patch.setattr(scoring, "score_run", few)
        patch.setattr(html, "HEARD", 4)
        patch.setattr(paper_tables, "_play_scripted", lambda *task: SCRIPTED_ROW)
        folder = tmp_path_factory.mktemp("readme")
        (folder / "examples").symlink_to(ROOT / "examples")
        patch.chdir(folder)
        yield


def test_the_two_commands_are_in_the_makefile():
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    made = [command.split()[1] for command in COMMANDS if command.startswith("make ")]
    assert made[:2] == ["train", "test"]
    assert all(re.search(rf"^{target}:", makefile, flags=re.MULTILINE) for target in made)


def test_every_command_does_what_it_says(room, capsys):
    commands = [shlex.split(command) for command in COMMANDS if command.startswith("gacrl ")]
    assert {words[1] for words in commands} == set(cli.COMMANDS), "every command has its line"
    commands = [words for words in commands if words[1] not in LONG]
    with kept_trainers():
        run_each(commands, capsys)


def short_of(words: list[str]) -> list[str]:
    """The same command for 1,000 steps, where it says how many."""
    asked = [words.index(flag) + 1 for flag in ("--env-steps", "--extend") if flag in words]
    return [str(min(int(word), 1_000)) if k in asked else word for k, word in enumerate(words)]


def run_each(commands: list[list[str]], capsys: pytest.CaptureFixture[str]) -> None:
    for words in map(short_of, commands):
        if ">" in words:
            words, target = words[: words.index(">")], words[words.index(">") + 1]
            assert cli.main(words[1:]) == 0
            Path(target).write_text(capsys.readouterr().out, encoding="utf-8")
        else:
            assert cli.main(words[1:]) == 0, words
        said = capsys.readouterr()
        assert "Traceback" not in said.err
        if words[1] in ("train", "resume"):
            folder = re.search(r"^summary +(\S+)/summary.json$", said.out, flags=re.MULTILINE)
            unseen = "does not say where things are" in said.out  # Beacon
            assert folder is not None and (unseen or (Path(folder[1]) / "episodes.gif").is_file()), words


@pytest.mark.soak
def test_the_doctor_finds_this_machine_healthy(capsys):
    assert cli.main(["doctor"]) == 0
    assert "BAD" not in capsys.readouterr().out


def test_the_python_of_the_readme(room):
    assert len(PYTHON) == 1
    names: dict = {}
    exec(PYTHON[0], names)
    env = gacrl.make_env("spread")
    observations = np.zeros((3, env.observation_size), np.float32)
    assert names["policy"](observations).shape == (3,)


@pytest.mark.soak
def test_the_python_of_its_guide(room, capsys):
    """Block after block, in one session that begins with the first: five lines train, evaluate in silence, and plot."""
    blocks = re.findall(r"```python\n(.*?)```", GUIDE, flags=re.DOTALL)
    assert len(blocks[0].replace("\n\n", "\n").splitlines()) == 5
    names: dict = {}
    for block in blocks:
        exec(block, names)
    assert Path("curve.png").read_bytes().startswith(b"\x89PNG")
    said = capsys.readouterr().out
    assert re.search(r"^-?[\d.]+ \[-?[\d.]+, -?[\d.]+\] -?[\d.]+ \[", said), "both returns, with their intervals"
    assert names["steps"] == [250, 500] and "done in" in said
    assert names["scores"]["return_agent_mean"].shape == (8, 4)
    assert set(names["actions"]) == {"agent_0", "agent_1", "agent_2"}
    assert names["policy"](np.zeros((10, names["policy"].env.observation_size))).shape == (10,)


@pytest.fixture
def a_room_of_its_own(room, tmp_path, monkeypatch):
    """As the room, but empty: a guide's first run is `runs/gacrl-1`."""
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    monkeypatch.chdir(tmp_path)
    yield
    jax.clear_caches()  # all guides together fill 3 GB


@pytest.mark.soak
@pytest.mark.filterwarnings("ignore:The system font")  # pygame's, of SISL's pursuit
@pytest.mark.parametrize("guide", [guide for guide in GUIDES if guide not in ELSEWHERE])
def test_every_block_of_a_guide(guide: str, a_room_of_its_own, capsys):
    """One after the other, and Python in one session. Commands for what is not installed say what to install."""
    text = (ROOT / "docs" / "guides" / f"{guide}.md").read_text(encoding="utf-8")
    names: dict[str, Any] = {"gacrl": gacrl, **GIVEN.get(guide, {})}
    ran = 0
    for language, block in re.findall(r"```(bash|python)\n(.*?)```", text, flags=re.DOTALL):
        if language == "python":
            ran += runs_python(block, names)
        else:
            ran += sum([runs(shlex.split(line, comments=True), capsys) for line in block.splitlines()])
    if not ran:
        pytest.skip("all of it needs what is not installed")


def runs_python(block: str, names: dict[str, Any]) -> bool:
    """Run Python of a guide, unless it needs what is not installed: onnxruntime, JaxMARL."""
    try:
        exec(block, names)
    except (ImportError, gacrl.UserError) as error:
        foreign = isinstance(error, ModuleNotFoundError) and (error.name or "").partition(".")[0] != "gacrl"
        assert foreign or "pip install" in str(error), block
        return False
    return True


def runs(words: list[str], capsys: pytest.CaptureFixture[str]) -> bool:
    """Run a command of a guide, unless it is for a machine with other things on it."""
    if words[0] in ("pip", "make") or words[1].startswith("benchmarks/"):
        return False
    if words[0] == "python":
        done = subprocess.run([sys.executable, *words[1:]], capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        return True
    assert words[0] == "gacrl"
    if words[1] in LONG or any("NAME" in word for word in words):
        return False
    code, said = cli.main(short_of(words)[1:]), capsys.readouterr().err
    assert code == 0 or "pip install 'gacrl[" in said, (words, said)
    return True
