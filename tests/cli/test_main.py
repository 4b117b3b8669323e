"""The command line: mistakes end in one sentence and exit code 2; what it writes and prints is what it says.

All of it runs in one process on one tiny run; with xdist, on one worker.
"""

import errno
import json
import os
import re
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from importlib import metadata
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import TinyRun
from PIL import Image

from gacrl import play
from gacrl.adapters import mpe2
from gacrl.cli import main as cli
from gacrl.cli.main import main
from gacrl.config import files as configuration
from gacrl.config import presets
from gacrl.evaluation import references
from gacrl.evaluation.evaluate import evaluate, stream_key
from gacrl.experiments import scoring
from gacrl.tasks.spread.settings import METRICS
from gacrl.training import checkpoint

pytestmark = [pytest.mark.usefixtures("one_trainer"), pytest.mark.xdist_group("runs")]  # the tiny run's

EPISODES = 8
"""Of the tiny run's closing evaluation."""


@pytest.fixture
def copy(tiny_run: TinyRun, tmp_path: Path) -> Path:
    """The tiny run, to be spoilt."""
    return Path(shutil.copytree(tiny_run.folder, tmp_path / "copy"))


@pytest.fixture
def refused(capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Runs a command that must fail as a user's mistake does, and gives its one sentence."""

    def run(*words: object) -> str:
        capsys.readouterr()
        assert main([str(word) for word in words]) == 2
        said = capsys.readouterr().err
        assert said.startswith("gacrl: ")
        assert said.endswith("\n")
        assert said.count("\n") == 1
        return said.removeprefix("gacrl: ").removesuffix("\n")

    return run


@pytest.fixture
def answered(capsys: pytest.CaptureFixture[str]) -> Callable[..., Any]:
    """Runs a command that must succeed, and gives the JSON object in its last line."""

    def run(*words: object) -> Any:
        capsys.readouterr()
        assert main([*map(str, words), "--json"]) == 0
        return json.loads(capsys.readouterr().out.splitlines()[-1])

    return run


def content(folder: Path) -> dict[str, tuple[bytes, int]]:
    """Every file's bytes and time of change."""
    return {
        str(path.relative_to(folder)): (path.read_bytes(), path.stat().st_mtime_ns)
        for path in folder.rglob("*")
        if path.is_file()
    }


def flip_a_byte(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


@pytest.mark.parametrize(
    ("words", "thing", "mend"),
    [
        ("trian", "unknown command 'trian'", "did you mean 'train'?"),
        ("xyz", "unknown command 'xyz'", "gacrl --help"),
        ("train --preset papre", "unknown preset 'papre'", "did you mean 'paper'?"),
        ("config --preset papre", "unknown preset 'papre'", "did you mean 'paper'?"),
        ("train --preset", "--preset needs a value", "gacrl train --help"),
        ("train --config --json", "--config needs a value", "gacrl train --help"),
        (
            "train --algorithm.learnig-rate 1",
            "--algorithm.learnig-rate",
            "did you mean --algorithm.learning-rate?",
        ),
        ("train --num-sedes 2", "--num-sedes", "did you mean --num-seeds?"),
        ("evaluate random --episodse 2", "--episodse", "did you mean --episodes?"),
        ("presets --nonsense", "--nonsense", "gacrl presets --help"),
        ("doctor now", "now", "gacrl doctor --help"),
        ("train --seed", "--seed needs a value", "gacrl train --help"),
        ("evaluate", "gacrl evaluate needs a RUN", "gacrl evaluate --help"),
        ("evaluate random --arena-scale 0", "--env.arena-scale must be between 0.001", "evaluate --help"),
        ("train --env.num-agents 0", "--env.num-agents must be between 1 and 10000, not 0", "gacrl train --help"),
        ("train --env.num-agents three", "--env.num-agents", "gacrl train --help"),
        ("train --env-steps many", "--env-steps must be a whole number, not many", "gacrl train --help"),
        ("train --env-steps 1.5e0", "--env-steps must be a whole number, not 1.5e0", "gacrl train --help"),
        ("train --seed 1e400", "--seed must be smaller than 1e400", "gacrl train --help"),
        ("sweep paper-grid --seeds 1e-1", "--seeds must be a whole number, not 1e-1", "gacrl sweep --help"),
        ("train --wait soon", "--wait must be a number, not soon", "gacrl train --help"),
        ("train --algorithm.lr 1e-3", "--algorithm.lr", "did you mean --algorithm.learning-rate?"),
        ("train --lr 1e-3", "--lr", "did you mean --algorithm.learning-rate?"),
        ("train --algorithm.eps 1", "--algorithm.eps", "did you mean --algorithm.epsilon?"),
        ("train --preset ippo --algorithm.clip 1", "--algorithm.clip", "did you mean --algorithm.clip-eps?"),
        ("train --preset ippo --ent 1", "--ent", "did you mean --algorithm.ent-coef?"),
        ("train --discount 1", "--discount", "did you mean --algorithm.gamma?"),
        ("train --gamma 1", "--gamma", "did you mean --algorithm.gamma?"),
        ("train --n_envs 1", "--n_envs", "did you mean --training.num-envs?"),
        ("train --n-steps 1", "--n-steps", "did you mean --training.num-steps?"),
        ("train --algorithm.bs 1", "--algorithm.bs", "did you mean --algorithm.batch-size?"),
        ("evaluate random --n-agents 3", "--n-agents", "did you mean --num-agents?"),
        ("train gacrl", "unexpected word 'gacrl'", "did you mean --preset gacrl?"),
        ("config paper", "unexpected word 'paper'", "did you mean --preset paper?"),
        ("ablate gacrl-112k", "unexpected word 'gacrl-112k'", "did you mean --preset gacrl-112k?"),
        ("train --env.reward mpe", "'mpe'", "('mpe2', 'paper', 'coverage', 'potential')"),
        ("train --preset paper --algorithm.encoder-hidden a", "--algorithm.encoder-hidden", "gacrl train --help"),
        ("train --algorithm.learning-rate nan", "--algorithm.learning-rate", "between 0 and 1"),
        ("train --preset paper --algorithm.epsilon 0.9", "algorithm.epsilon", "must not exceed 1"),
        ("train --num-seeds 0", "--num-seeds must", "between 1 and 10000"),
        ("train --seed -1", "seed", "between 0 and 2147483647"),
        ("train --env-steps 0", "--env-steps must be at least 1, not 0", "at least"),
        ("train --env-steps 1e13", "--env-steps must be between 1 and 1e+12, not 10000000000000", "between"),
        ("train --episodes 0", "--episodes must be at least 1, not 0", "at least"),
        ("train --episodes 1 --env-steps 9", "--env-steps and --episodes", "give one of them"),
        (
            "train --preset paper --env.continuous-actions",
            "needs discrete actions",
            "leave env.continuous_actions at False",
        ),
        (
            "train --preset paper --env scouts --env.num-agents-start 2",
            "knows teams of one size only",
            "take another preset",
        ),
        ("train --env colours --env.talk actions", "env.talk must be messages, not actions", "has no utterances"),
        ("evaluate told --env scouts --num-agents 1", "env.num_blind must be below", "somebody must see"),
        ("evaluate told --env colours --backend mpe2", "MPE2 has spread", "--backend jax"),
        ("train --out /dev/null/run", "/dev/null/run", "choose another with --out"),
        ("train --config none.json", "none.json", "gacrl config"),
        ("resume nowhere", "there is no run nowhere", "gacrl train"),
        ("resume nowhere --extend 0", "--extend", "at least 1"),
        ("resume .", "is not a run folder", "config.json"),
        ("evaluate nowhere", "there is no run nowhere", "gacrl train"),
        ("evaluate nowhere@1", "there is no run nowhere", "gacrl train"),
        ("evaluate random --episodes 0", "--episodes", "at least 1"),
        ("evaluate random --horizon 0", "--horizon must be between 1 and 1000000, not 0", "evaluate --help"),
        ("render random --horizon 0", "--horizon must be between 1 and 1000000, not 0", "render --help"),
        ("evaluate random --num-agents 0", "--num-agents must be between 1 and 10000, not 0", "evaluate --help"),
        ("evaluate random --arena-scale nan", "--env.arena-scale", "between 0.001 and"),
        ("evaluate random --backend mpe", "'mpe'", "'mpe2'"),
        ("evaluate random --backend mpe2 --arena-scale 2", "arena scale of 2", "--backend jax"),
        ("render random --episodes 0", "--episodes", "between 1 and 100"),
        ("render random --size 5000", "--size", "between 120 and 4096"),
        ("render random --out no/folder.gif", "no folder no", "folder.gif"),
        ("render random --out film.avi", "cannot write AVI", ".gif or, with ffmpeg installed, in .mp4"),
        ("render random --out film", "film: its name does not say what to write", ".gif or"),
    ],
)
def test_a_mistake_ends_in_one_sentence(
    words: str,
    thing: str,
    mend: str,
    refused: Callable[..., str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
):
    monkeypatch.chdir(tmp_path)
    said = refused(*words.split())
    assert thing in said
    assert any(way in said for way in mend.split("|"))
    assert list(tmp_path.iterdir()) == [], "a mistake leaves nothing behind"


@pytest.mark.parametrize(
    ("text", "thing"),
    [
        ("not json", "is not JSON"),
        ("[1]", "must hold a JSON object"),
        ('{"env": {"num_agent": 4}}', "did you mean 'env.num_agents'?"),
        ('{"env": {"num_agents": "4"}}', "env.num_agents must be a whole number, not the string '4'"),
        ('{"env": {"local_ratio": NaN}}', "env.local_ratio must be between 0 and 1, not nan"),
    ],
)
def test_a_file_of_settings_that_cannot_be_is_named(
    text: str, thing: str, refused: Callable[..., str], tmp_path: Path
):
    path = tmp_path / "my.json"
    path.write_text(text)
    said = refused("train", "--config", path, "--out", tmp_path / "run")
    assert thing in said
    assert str(path) in said
    assert not (tmp_path / "run").exists()


def test_what_exists_is_not_overwritten(
    tiny_run: TinyRun, copy: Path, refused: Callable[..., str], tmp_path: Path
):
    before = content(copy)
    said = refused("train", "--out", copy, *tiny_run.words)
    assert f"{copy} exists" in said
    assert f"gacrl resume {copy}" in said
    assert content(copy) == before

    other = tmp_path / "other"
    other.mkdir()
    (other / "thesis.tex").write_text("years of work")
    said = refused("train", "--out", other, *tiny_run.words)
    assert said == f"{other} exists and is not overwritten: choose another --out"
    assert f"{other / 'thesis.tex'} exists" in refused("train", "--out", other / "thesis.tex", *tiny_run.words)
    assert {name: data for name, (data, _) in content(other).items()} == {"thesis.tex": b"years of work"}


def test_a_checkpoint_of_another_architecture_is_refused(copy: Path, refused: Callable[..., str]):
    settings = json.loads((copy / "config.json").read_text())
    settings["algorithm"]["latent_size"] = 8
    (copy / "config.json").write_text(json.dumps(settings))
    before = content(copy)
    said = refused("evaluate", copy)
    assert "step-000000000450 holds another architecture" in said
    assert "float32[2, 32, 32] there and float32[2, 16, 32] here" in said
    assert "use the config.json that it was trained with" in said
    said = refused("resume", copy)
    assert "was trained with other settings" in said
    assert "put the file back" in said
    before.pop(".lock", None)
    assert {name: it for name, it in content(copy).items() if name != ".lock"} == before


def test_a_run_folder_without_its_settings_or_with_broken_ones_is_refused(copy: Path, refused: Callable[..., str]):
    (copy / "config.json").write_text('{"env": ')
    for command in ("evaluate", "resume", "render"):
        assert f"{copy / 'config.json'} is not JSON" in refused(command, copy)
    (copy / "config.json").unlink()
    for command in ("evaluate", "resume", "render"):
        assert f"{copy} is not a run folder" in refused(command, copy)


def test_members_that_are_not_there_are_refused(tiny_run: TinyRun, refused: Callable[..., str]):
    assert "has the members 0 to 1: there is no @2" in refused("evaluate", f"{tiny_run.folder}@2")
    assert "leave num_agents out" in refused("evaluate", tiny_run.folder, "--num-agents", 4)


def test_a_damaged_checkpoint_is_passed_over_and_none_is_refused(
    copy: Path, refused: Callable[..., str], capsys: pytest.CaptureFixture[str]
):
    newest, older = copy / "checkpoints/step-000000000450", copy / "checkpoints/step-000000000420"
    flip_a_byte(newest / "state.safetensors")
    assert main(["render", str(copy), "--out", str(copy / "old.gif"), "--size", "120"]) == 0
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert said.startswith(f"gacrl: checkpoint {newest} is damaged")
    assert said.endswith("taking the one before it\n")

    (older / "manifest.json").write_text("{}")
    for command in ("evaluate", "resume", "render"):
        said = refused(command, copy)
        assert f"every checkpoint in {copy / 'checkpoints'} is damaged" in said
        assert "train the run again" in said
    shutil.rmtree(newest)
    shutil.rmtree(older)
    assert "is missing" in refused("evaluate", copy)


def test_a_device_without_memory_left_is_told(refused: Callable[..., str], monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(cli.COMMANDS, "presets", lambda words: jnp.zeros(2**46))
    said = refused("presets")
    assert "memory is full" in said
    assert "281474976710656 bytes): take fewer seeds" in said


def no_package(name: str) -> str:
    raise metadata.PackageNotFoundError(name)


def no_space(*_: object) -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_a_full_disk_at_the_start_is_told(
    tiny_run: TinyRun, refused: Callable[..., str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(os, "fsync", no_space)
    said = refused("train", "--out", tmp_path / "run", *tiny_run.words)
    assert f"cannot write the run folder {tmp_path / 'run'}: No space left on device" in said


def test_a_disk_that_fills_up_leaves_a_run_that_can_go_on(
    copy: Path, refused: Callable[..., str], monkeypatch: pytest.MonkeyPatch
):
    real, before = os.fsync, content(copy / "checkpoints")

    def fsync(descriptor: int) -> None:
        if "step-000000000510" in os.readlink(f"/proc/self/fd/{descriptor}"):
            no_space()
        real(descriptor)

    monkeypatch.setattr(os, "fsync", fsync)
    said = refused("resume", copy, "--extend", 60)
    assert f"cannot write to {copy}: No space left on device" in said
    assert f"`gacrl resume {copy}` goes on from the last checkpoint" in said

    after = content(copy / "checkpoints")
    assert {name: after[name] for name in before} == before
    found, warnings = checkpoint.newest(copy / "checkpoints")
    assert found.env_steps == 450
    assert warnings == []
    assert found.fingerprint == configuration.fingerprint(configuration.load(copy / "config.json"))


def test_training_leaves_what_it_says(tiny_run: TinyRun):
    folder, said = tiny_run.folder, tiny_run.said
    preset, settings = presets.preset("paper"), configuration.load(folder / "config.json")
    assert settings.env == replace(preset.env, max_cycles=15)
    assert settings.algorithm == replace(preset.algorithm, replay_capacity=500)
    assert (settings.training.env_steps, settings.seeds) == (450, (5, 6))

    rows = [json.loads(row) for row in (folder / "metrics.jsonl").read_text().splitlines()]
    assert [row["env_steps"] for row in rows[::2]] == [60, 120, 180, 240, 300, 360, 420, 450]
    assert [row["episodes_done"] for row in rows[::2]] == [4, 8, 12, 16, 20, 24, 28, 30]
    assert [row["train"]["episodes"] for row in rows[::2]] == [4] * 7 + [2]
    assert [row["seed"] for row in rows] == [5, 6] * 8
    returns = [np.mean([row["greedy"]["return_agent_mean"] for row in rows[k : k + 2]]) for k in range(0, 16, 2)]
    assert sorted(path.name for path in (folder / "checkpoints").iterdir()) == [
        f"best-{rows[2 * int(np.argmax(returns))]['env_steps']:012d}",
        "step-000000000420",
        "step-000000000450",
    ]
    assert sorted(path.name for path in (folder / "episodes").iterdir()) == [f"{k}.npz" for k in range(4)]
    with Image.open(folder / "episodes.gif") as picture:
        assert picture.n_frames > 15

    summary = json.loads((folder / "summary.json").read_text())
    told = json.loads(said.splitlines()[-1])
    assert told == {"folder": str(folder), "env_steps": 450, "summary": summary}
    greedy = summary["final"]["greedy"]["return_agent_mean"]
    low, high = (summary["references"][who]["return_agent_mean"] for who in ("random", "oracle"))
    assert greedy["mean"] == pytest.approx(np.mean(greedy["values"]))
    assert greedy["interval"][0] < greedy["mean"] < greedy["interval"][1]
    score = summary["final"]["greedy"]["score_return_agent_mean"]
    assert score["values"] == pytest.approx([(value - low) / (high - low) for value in greedy["values"]])
    lines = said.splitlines()
    assert f"run        {folder}" in lines, "a path is not broken over lines"
    assert f"summary    {folder / 'summary.json'}" in lines
    told_along = [line for line in lines if line.startswith("step ")]
    assert len(told_along) == 8
    assert told_along[3].startswith(
        f"step 240 of 450, episode 16: greedy return = {returns[3]:.3f}, coverage 0.1 = "
    )
    assert "(mean of 2 seeds)" in told_along[3]
    assert all(re.search(r"steps/s, [1-9]\d* s left$", line) for line in told_along), (
        "what closes the run takes time"
    )
    table = next(number for number, line in enumerate(lines) if line.startswith("Table III"))
    assert lines[table + 2].split()[:4] == ["episode", "who", "Sh.", "Reward"]
    assert [line.split()[1] for line in lines[table + 4 : table + 10]] == [
        *("paper", "ours,", "ours,", "random", "noop", "oracle")
    ]
    assert "9.12 ± 3.87" in lines[table + 4], "the paper's own number"
    assert lines[table + 7].split()[2:] == ["12.50", "±", "0.25", "0.50", "±", "0.25"]


def test_presets_and_settings_are_printed(answered: Callable[..., Any], capsys: pytest.CaptureFixture[str]):
    assert set(answered("presets")) == set(presets.PRESETS)
    for name, (_, settings) in presets.PRESETS.items():
        assert main(["config", "--preset", name]) == 0
        assert capsys.readouterr().out == configuration.dumps(settings)
    assert main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("gacrl 0.")
    with pytest.MonkeyPatch.context() as uninstalled:
        uninstalled.setattr(metadata, "version", no_package)
        assert main(["--version"]) == 0
        assert capsys.readouterr().out == "gacrl not installed\n"
    assert main([]) == 0
    assert "usage: gacrl COMMAND" in capsys.readouterr().out


def test_help_shows_what_a_preset_and_a_file_set(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "my.json").write_text('{"env": {"num_agents": 77}}')
    with pytest.raises(SystemExit, match="0"):
        main(["train", "--config", str(tmp_path / "my.json"), "--help"])
    said = capsys.readouterr().out
    assert "(default: 77)" in said
    assert "examples:" in said


def test_scripted_policies_stand_on_their_own_scale(answered: Callable[..., Any]):
    scores = {
        name: answered("evaluate", name, "--episodes", EPISODES, "--horizon", 15)
        for name in ("random", "noop", "oracle")
    }
    for name, score in scores.items():
        assert score["episodes"] == EPISODES
        assert score["horizon"] == 15
        assert score["references"] == scores["random"]["references"], "every policy plays the same starts"
        greedy = score["final"]["greedy"]
        assert greedy["return_agent_mean"]["mean"] == score["references"][name]["return_agent_mean"]
    for name, worth in (("random", 0.0), ("oracle", 1.0)):
        greedy = scores[name]["final"]["greedy"]
        assert {greedy[metric]["mean"] for metric in greedy if metric.startswith("score_")} == {worth}


def test_evaluating_a_run_again_gives_its_summary(tiny_run: TinyRun, answered: Callable[..., Any]):
    again = answered("evaluate", tiny_run.folder, "--episodes", EPISODES)
    summary = json.loads((tiny_run.folder / "summary.json").read_text())
    assert again["references"] == summary["references"]
    assert again["final"] == summary["final"]
    assert again["horizon"] == summary["horizon"] == 15


def test_the_real_mpe2_gives_the_same_within_sampling_error(
    tiny_run: TinyRun, answered: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
):
    episodes, member, key = 100, f"{tiny_run.folder}@1", stream_key("report")
    opened = play.open_run(member)
    env = opened.env
    noop, memory = references.noop(env)
    ours = {
        "run": opened.trainer.evaluate(opened.learners, False, "report", episodes),
        "noop": jax.jit(
            lambda: evaluate(env, noop, memory, env.default_params(), key, episodes, metrics=METRICS)
        )(),
    }

    beside = {"random": dict.fromkeys(ours["noop"], 0.0), "oracle": dict.fromkeys(ours["noop"], 1.0)}
    monkeypatch.setattr(scoring, "_references", lambda *task: beside)  # playing those takes long
    answer = answered("evaluate", member, "--backend", "mpe2", "--episodes", episodes)
    assert answer["backend"] == "mpe2"
    theirs = {
        "run": {name: entry["values"] for name, entry in answer["final"]["greedy"].items()},
        "noop": {
            name: [values.mean()] for name, values in mpe2.evaluate(env, noop, memory, key, episodes).items()
        },
    }
    for who, metrics in ours.items():
        for name in ("return_agent_mean", "distance_landmark_agent", "coverage_mean_0.5", "reward_shaped"):
            values = np.asarray(metrics[name]).reshape(-1)
            (there,) = theirs[who][name]
            error = values.std() * np.sqrt(2 / episodes)
            assert abs(values.mean() - there) < 4 * error, (who, name)
            assert error < 0.2 * abs(values.mean()), "an error that could hide anything"


def frames(path: Path) -> Iterator[np.ndarray]:
    with Image.open(path) as picture:
        for number in range(picture.n_frames):
            picture.seek(number)
            yield np.asarray(picture.convert("RGB"))


def test_a_rendered_episode_moves_and_is_not_overwritten(
    tiny_run: TinyRun, refused: Callable[..., str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    out = tmp_path / "run.gif"
    words = ["render", str(tiny_run.folder), "--out", str(out), "--size", "120"]
    assert main(words) == 0
    assert f"{out}: 4 episodes of {tiny_run.folder}" in capsys.readouterr().out
    shown = list(frames(out))
    assert len(shown) == 4 * 16, "15 steps and where they started"
    assert any((frame != shown[0]).any() for frame in shown[1:])
    assert max(shown[0].shape) >= 120

    before = out.read_bytes()
    assert f"{out} exists" in refused(*words)
    assert out.read_bytes() == before
    assert main([*words, "--overwrite"]) == 0
    assert len(list(frames(out))) == 4 * 16
