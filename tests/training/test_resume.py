"""Interrupted runs end with the same bits as runs that never were; checkpoints know when they are damaged.

With xdist all of it runs on one worker, that of the tiny run, which has two seeds.
"""

import contextlib
import dataclasses
import io
import json
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import safetensors.numpy
from conftest import TinyRun

from gacrl.algorithms import objectives
from gacrl.algorithms.replay import Replay
from gacrl.cli.main import main
from gacrl.config import files as configuration
from gacrl.config import presets
from gacrl.errors import UserError
from gacrl.experiments.paper import tables as paper_tables
from gacrl.training import checkpoint
from gacrl.training.recorder import RunFolder

pytestmark = [pytest.mark.usefixtures("one_trainer"), pytest.mark.xdist_group("runs")]

STEPS, CHUNK, LAST = 450, 60, 30
"""The tiny run's."""
OFFLINE = "import socket; socket.socket.connect = socket.socket.sendto = socket.getaddrinfo = None"
TIMES = ("steps_per_second", "compile_seconds", "wall_seconds")


@pytest.fixture(scope="module", autouse=True)
def no_tables() -> Iterator[None]:
    """What the paper's tables show does not matter here, and takes long to compile."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(paper_tables, "table_2", lambda *_: [])
        patch.setattr(paper_tables, "table_3", lambda *_: [])
        yield


def gacrl(*words: object) -> int:
    with contextlib.redirect_stdout(io.StringIO()):
        return main([str(word) for word in words])


@pytest.fixture
def uninterrupted(tiny_run: TinyRun) -> Path:
    """Two seeds, 450 steps each, in seven chunks and half a one."""
    return tiny_run.folder


@pytest.fixture
def process(quick_start: dict[str, str]) -> Iterator[Any]:
    """Starts `gacrl` with these words in a process of its own, on two devices as here."""
    running: list[subprocess.Popen[str]] = []

    def start(*words: object) -> subprocess.Popen[str]:
        code = f"{OFFLINE}; import jax, sys; jax.config.update('jax_num_cpu_devices', 2); from gacrl.cli.main import main; sys.exit(main())"
        running.append(
            subprocess.Popen(
                [sys.executable, "-c", code, *map(str, words)],
                env=quick_start,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
            )
        )
        return running[-1]

    yield start
    for child in running:
        child.kill()
        child.communicate()


def rows(folder: Path) -> list[dict[str, Any]]:
    """Every line of the metrics, without the times that no two runs share."""
    lines = (folder / "metrics.jsonl").read_text().splitlines()
    return [{name: value for name, value in json.loads(line).items() if name not in TIMES} for line in lines]


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def tensors(folder: Path, env_steps: int = STEPS) -> bytes:
    return (folder / f"checkpoints/step-{env_steps:012d}/state.safetensors").read_bytes()


def assert_same_end(folder: Path, uninterrupted: Path) -> None:
    assert tensors(folder) == tensors(uninterrupted)
    assert rows(folder) == rows(uninterrupted)
    here, there = (json.loads((path / "summary.json").read_text()) for path in (folder, uninterrupted))
    for name in ("seeds", "env_steps", "final", "references", "episodes", "horizon"):
        assert here[name] == there[name]
    for k in range(4):
        assert (folder / f"episodes/{k}.npz").exists()


def wait_for_lines(child: subprocess.Popen[str], folder: Path, count: int) -> None:
    metrics, end = folder / "metrics.jsonl", time.monotonic() + 240
    while not (metrics.exists() and len(metrics.read_text().splitlines()) >= count):
        assert child.poll() is None, child.communicate()[0]
        assert time.monotonic() < end
        time.sleep(0.002)


def test_an_uninterrupted_run_is_as_planned(uninterrupted: Path):
    found = rows(uninterrupted)
    assert [(row["env_steps"], row["seed"]) for row in found] == [
        (steps, seed) for steps in [*range(CHUNK, STEPS, CHUNK), STEPS] for seed in (5, 6)
    ]
    one, two = (row["train"]["mean"]["return_agent_mean"] for row in found[:2])
    assert one != two, "the seeds differ"
    assert tensors(uninterrupted) != tensors(uninterrupted, STEPS - LAST)


def test_a_run_that_was_interrupted_and_killed_ends_with_the_same_bits(
    tiny_run: TinyRun,
    tmp_path: Path,
    process: Any,
    capfd: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
):
    folder, uninterrupted = tmp_path / "interrupted", tiny_run.folder

    # Ctrl-C during the second chunk.
    real = RunFolder.append_metrics

    def interrupted(self: RunFolder, rows: list[dict[str, Any]]) -> None:
        if rows[0]["env_steps"] == 2 * CHUNK:
            signal.raise_signal(signal.SIGINT)
        real(self, rows)

    before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    with monkeypatch.context() as patch:
        patch.setattr(RunFolder, "append_metrics", interrupted)
        assert main(["train", *tiny_run.words, "--out", str(folder)]) == 130
    assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == before
    said = capfd.readouterr()
    assert said.err == ""
    assert said.out.splitlines()[-1] == f"stopped at environment step 120; go on with: gacrl resume {folder}"
    assert rows(folder) == rows(uninterrupted)[:4]
    assert checkpoint.newest(folder / "checkpoints")[0].env_steps == 120
    assert not (folder / "summary.json").exists()

    # kill -9 during the fourth or a later one; meanwhile nobody else may go on with the run.
    child = process("resume", folder)
    wait_for_lines(child, folder, 6)
    assert main(["resume", str(folder)]) == 2
    in_use = f"gacrl: {folder} is in use by another gacrl process: wait for it, or stop it\n"
    assert capfd.readouterr().err == in_use
    child.send_signal(signal.SIGKILL)
    assert child.wait() == -signal.SIGKILL
    assert not (folder / "summary.json").exists(), "killed before its end"
    # What a crash in the middle of a write leaves behind.
    with (folder / "metrics.jsonl").open("a") as file:
        file.write('{"seed": 5, "env_ste')
    (folder / f"checkpoints/.unfinished-step-{STEPS:012d}").mkdir()

    assert gacrl("resume", folder) == 0
    assert_same_end(folder, uninterrupted)
    assert names(folder / "checkpoints") == names(uninterrupted / "checkpoints")


def test_an_extended_run_is_one_planned_longer(uninterrupted: Path, tmp_path: Path):
    folder = tmp_path / "extended"
    shutil.copytree(uninterrupted, folder)
    shorter = json.loads((folder / "config.json").read_text())
    shorter["training"]["env_steps"] = STEPS - LAST
    (folder / "config.json").write_text(json.dumps(shorter))
    shutil.rmtree(folder / f"checkpoints/step-{STEPS:012d}")
    (folder / "summary.json").unlink()

    assert gacrl("resume", folder, "--extend", LAST) == 0
    assert_same_end(folder, uninterrupted)
    assert configuration.load(folder / "config.json") == configuration.load(uninterrupted / "config.json")


def test_a_finished_run_has_nothing_left_to_do(uninterrupted: Path, tmp_path: Path):
    folder = Path(shutil.copytree(uninterrupted, tmp_path / "finished"))
    (folder / "summary.json").unlink()
    assert gacrl("resume", folder) == 0
    assert_same_end(folder, uninterrupted)


def test_an_extension_that_dies_before_its_first_checkpoint_goes_on(uninterrupted: Path, tmp_path: Path):
    """The new length is in config.json, and the checkpoints are from before it."""
    folder = RunFolder(Path(shutil.copytree(uninterrupted, tmp_path / "died")))
    config = folder.config()
    longer = dataclasses.replace(config, training=dataclasses.replace(config.training, env_steps=STEPS + CHUNK))
    found, _ = checkpoint.newest(folder.checkpoints)
    assert found.fingerprint == configuration.fingerprint(longer)


def test_a_run_made_before_a_setting_was_added_can_go_on(tmp_path: Path):
    """What its checkpoints belong to is what stands in its file, before and after an extension."""
    config = presets.preset("paper")
    folder = RunFolder.create(tmp_path / "run", config)
    older = json.loads(folder.config_file.read_text(encoding="utf-8"))
    assert configuration.fingerprint(folder.settings()) == configuration.fingerprint(config)
    del older["env"]["coverage_bonus"]
    folder.config_file.write_text(json.dumps(older), encoding="utf-8")
    made_then = configuration.fingerprint(older)
    assert made_then != configuration.fingerprint(config)
    assert configuration.fingerprint(folder.settings()) == made_then
    folder.extend(999)
    assert "coverage_bonus" not in folder.settings()["env"]
    assert configuration.fingerprint(folder.settings()) == made_then
    assert folder.config().training.env_steps == 999


# Checkpoints by themselves.

STATE = {
    "weights": jnp.arange(6.0).reshape(2, 3),
    "count": jnp.asarray(7, jnp.int32),
    "mask": jnp.array([True, False]),
    "key": jax.random.key(3),
    "keys": jax.random.split(jax.random.key(4), 2),
}


TENSORS = checkpoint.serialise(checkpoint.arrays(STATE))


class LearnedRewards(NamedTuple):
    """The part of a learner that knows what rewards are like."""

    rewards: Any


def saved(folder: Path, env_steps: int = 30) -> Path:
    return checkpoint.save(folder, TENSORS, env_steps, "fingerprint", {"wall": 1.5})


def test_a_state_loads_as_it_was_saved(tmp_path: Path):
    saved(tmp_path)
    found, warnings = checkpoint.newest(tmp_path)
    assert (found.env_steps, found.fingerprint, found.counters, warnings) == (30, "fingerprint", {"wall": 1.5}, [])
    for like in (STATE, jax.eval_shape(lambda: STATE)):
        loaded = checkpoint.load(found, like)
        assert jax.tree.structure(loaded) == jax.tree.structure(STATE)
        for leaf, original in zip(jax.tree.leaves(loaded), jax.tree.leaves(STATE), strict=True):
            assert leaf.dtype == original.dtype
            if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
                leaf, original = jax.random.key_data(leaf), jax.random.key_data(original)
            np.testing.assert_array_equal(leaf, original)
    draw, again = (jax.random.normal(state["key"], (3,)) for state in (STATE, loaded))
    np.testing.assert_array_equal(draw, again)


def test_empty_rows_are_not_written_and_are_there_again(tmp_path: Path):
    """Two seeds' rings of four rows of two environments, three of them filled; a full ring is written whole."""
    items = jnp.arange(48.0).reshape(2, 4, 2, 3) + 1
    for added, rows in ((3, 3), (4, 4), (9, 4)):
        ring = jax.vmap(Replay)(items.at[:, rows:].set(0.0), jnp.full(2, added, jnp.int32))
        cut = {f".learner.replay{name}": array for name, array in checkpoint.arrays(ring, ring).items()}
        assert cut[".learner.replay.items"].shape == (2, rows, 2, 3)
        assert checkpoint.arrays(ring)[".items"].shape == (2, 4, 2, 3), "whole, where nobody says what remembers"
        checkpoint.save(tmp_path, checkpoint.serialise(cut), added, "", {})
        found, _ = checkpoint.newest(tmp_path)
        loaded = checkpoint.load(found, ring, prefix=".learner.replay", replay=ring)
        np.testing.assert_array_equal(loaded.items, ring.items)
    smaller = jax.vmap(Replay)(items[:, :3], ring.added)
    with pytest.raises(UserError, match="holds another architecture"):
        checkpoint.load(found, smaller, prefix=".learner.replay", replay=smaller)


def test_a_part_of_a_state_can_be_loaded(tmp_path: Path):
    tensors = checkpoint.serialise(checkpoint.arrays({"learner": STATE, "rest": jnp.zeros(1)}))
    checkpoint.save(tmp_path, tensors, 1, "", {})
    found, _ = checkpoint.newest(tmp_path)
    loaded = checkpoint.load(found, STATE, prefix="['learner']")
    np.testing.assert_array_equal(loaded["weights"], STATE["weights"])


def test_a_state_from_before_rewards_knew_of_ends_is_read(tmp_path: Path):
    now = LearnedRewards(objectives.no_rewards()._replace(moments=objectives.ValueNorm(*jnp.arange(3.0))))
    before = LearnedRewards(now.rewards.moments)
    checkpoint.save(tmp_path, checkpoint.serialise(checkpoint.arrays(before)), 1, "", {})
    loaded = checkpoint.load(checkpoint.newest(tmp_path)[0], now)
    jax.tree.map(np.testing.assert_array_equal, loaded, now)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"weights": jnp.zeros((2, 4))}, r"\['weights'\] is float32\[2, 3\] there and float32\[2, 4\] here"),
        ({"count": jnp.zeros(())}, r"\['count'\] is int32\[\] there and float32\[\] here"),
        ({"more": jnp.zeros(())}, r"\['more'\] is nothing there and float32\[\] here"),
        ({"keys": jax.random.key(0)}, r"\['keys'\] is uint32\[2, 2\] there and uint32\[2\] here"),
    ],
)
def test_another_architecture_is_refused_by_its_first_difference(change: Any, said: str, tmp_path: Path):
    saved(tmp_path)
    found, _ = checkpoint.newest(tmp_path)
    with pytest.raises(UserError, match=said):
        checkpoint.load(found, {**STATE, **change})


def test_only_the_newest_checkpoints_stay(tmp_path: Path):
    for env_steps in (999, 1000, 20, 10_000_000_000):
        saved(tmp_path, env_steps)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["step-000000001000", "step-010000000000"]
    assert checkpoint.newest(tmp_path)[0].env_steps == 10_000_000_000
    saved(tmp_path, 1000)  # over itself
    assert len(list(tmp_path.iterdir())) == 2


def test_no_damage_goes_unseen(tmp_path: Path):
    """Every byte of the tensors and of their manifest, one at a time: the checkpoint before is taken."""
    older, newer = saved(tmp_path, 10), saved(tmp_path, 20)
    for path in (newer / "state.safetensors", newer / "manifest.json"):
        good = path.read_bytes()
        for position in range(0, len(good), 3):
            bad = bytearray(good)
            bad[position] ^= 1
            path.write_bytes(bad)
            found, warnings = checkpoint.newest(tmp_path)
            assert found.folder == older, (path.name, position, bytes(bad[position - 9 : position + 9]))
            assert len(warnings) == 1
            assert warnings[0].startswith(f"checkpoint {newer} is damaged")
            assert "\n" not in warnings[0]
        path.write_bytes(good[: len(good) // 2])
        assert checkpoint.newest(tmp_path)[0].folder == older, "cut off"
        path.unlink()
        assert checkpoint.newest(tmp_path)[0].folder == older, "missing"
        path.write_bytes(good)
        assert checkpoint.newest(tmp_path)[0].folder == newer


@pytest.mark.parametrize(
    "content", ["", "[]", "3", "null", "{}", '{"format_version": 1}', '{"format_version": 2}']
)
def test_what_is_no_manifest_is_damage(content: str, tmp_path: Path):
    (saved(tmp_path) / "manifest.json").write_text(content)
    with pytest.raises(UserError, match=f"every checkpoint in {tmp_path} is damaged: train the run again"):
        checkpoint.newest(tmp_path)


def test_a_write_that_fails_leaves_the_old_checkpoint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    saved(tmp_path, 10)

    def fail(path: Path, content: bytes) -> None:
        path.write_bytes(content[:5])
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(checkpoint, "_write_synced", fail)
        with pytest.raises(OSError, match="No space"):
            saved(tmp_path, 20)
    assert checkpoint.newest(tmp_path)[0].env_steps == 10
    saved(tmp_path, 20)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["step-000000000010", "step-000000000020"]


def test_tensors_are_plain_safetensors(tmp_path: Path):
    arrays = safetensors.numpy.load((saved(tmp_path) / "state.safetensors").read_bytes())
    assert {name: array.shape for name, array in arrays.items()} == {
        "['weights']": (2, 3),
        "['count']": (),
        "['mask']": (2,),
        "['key']": (2,),
        "['keys']": (2, 2),
    }
