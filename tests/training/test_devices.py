"""How JAX is set up: quickly compiled but for training, and only where the user has not chosen."""

import errno
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import jax
import pytest

from gacrl.training import devices, program_cache

KNOWN = pytest.mark.skipif(not devices.KNOWN_XLA, reason="another version compiles as it likes")


@pytest.fixture
def unset(monkeypatch: pytest.MonkeyPatch) -> pytest.MonkeyPatch:
    """No flags yet; JAX's settings of the tests stay."""
    monkeypatch.delenv("XLA_FLAGS")
    monkeypatch.setenv("NPROC", "1")
    monkeypatch.setattr(jax.config, "update", lambda *setting: None)
    return monkeypatch


@KNOWN
def test_training_is_compiled_for_speed_and_all_else_quickly(unset: pytest.MonkeyPatch):
    devices.prepare_jax()
    fast, quick = devices.compiler_options(), devices.compiler_options(for_speed=False)
    assert fast["xla_cpu_use_fusion_emitters"] is True and fast["xla_backend_optimization_level"] == 3
    assert set(fast) - set(quick) == {"xla_cpu_use_fusion_emitters", "xla_backend_optimization_level"}
    library = devices.compiler_options(library_sums=True)
    assert set(fast) - set(library) == {"xla_cpu_experimental_ynn_fusion_type"}, "XLA's own choice"
    for options in (fast, quick, library):
        assert jax.jit(lambda x: x + 1, compiler_options=options)(1) == 2, "XLA knows them"


@KNOWN
def test_whoever_sets_the_flags_has_the_choice(unset: pytest.MonkeyPatch):
    unset.setenv("XLA_FLAGS", "--xla_cpu_enable_fast_math=false")
    devices.prepare_jax()
    assert os.environ["XLA_FLAGS"] == "--xla_cpu_enable_fast_math=false"
    assert devices.compiler_options() == devices.compiler_options(for_speed=False)


def test_a_cache_that_cannot_be_written_is_left_out_and_said(tmp_path: Path, monkeypatch, capsys):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert program_cache.make_folder() == tmp_path / "gacrl" / "jax" and capsys.readouterr().err == ""
    monkeypatch.setattr(tempfile, "TemporaryFile", full_disk)
    assert program_cache.make_folder() is None
    assert capsys.readouterr().err == (
        f"gacrl: {tmp_path}/gacrl/jax keeps no compiled programs: No space left on device; each start compiles anew\n"
    )


def full_disk(dir: Path):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.mark.soak
def test_two_trainings_at_once_share_an_empty_cache(tmp_path: Path):
    environment = {**os.environ, "XDG_CACHE_HOME": str(tmp_path / "cache")}
    words = [sys.executable, "-m", "gacrl", "train", "--preset", "qmix", "--env-steps", "3000"]
    runs = [
        subprocess.Popen(
            [*words, "--out", str(tmp_path / name)], env=environment, stderr=subprocess.PIPE, text=True
        )
        for name in "ab"
    ]
    said = [run.communicate()[1] for run in runs]
    assert [run.returncode for run in runs] == [0, 0], said
    finals = [json.loads((tmp_path / name / "summary.json").read_text())["final"] for name in "ab"]
    assert finals[0] == finals[1]
    assert any((tmp_path / "cache" / "gacrl" / "jax").iterdir())
