"""Flags for a GPU: where JAX will compute on one, and the user has chosen nothing."""

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import jax
import pytest

from gacrl.errors import UserError
from gacrl.training import accelerator, devices

NODE = "nvidia0"


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> pytest.MonkeyPatch:
    """A machine that has a GPU, and JAX with its plugin; JAX's settings of the tests stay."""
    (tmp_path / NODE).touch()
    monkeypatch.setattr(accelerator, "_DEV", tmp_path)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: name)
    monkeypatch.setattr(jax.config, "update", lambda *setting: None)
    monkeypatch.setattr(accelerator, "KNOWN", True)
    for name in ("XLA_FLAGS", "JAX_PLATFORMS", "CUDA_VISIBLE_DEVICES"):
        monkeypatch.delenv(name, raising=False)
    return monkeypatch


def test_a_gpu_gets_its_flags_and_the_users_own_stay(machine: pytest.MonkeyPatch):
    devices.prepare_jax()
    assert os.environ["XLA_FLAGS"] == accelerator.QUICKLY
    machine.setenv("XLA_FLAGS", "--xla_gpu_autotune_level=4")
    devices.prepare_jax()
    assert os.environ["XLA_FLAGS"] == "--xla_gpu_autotune_level=4"


@pytest.mark.parametrize(
    ("name", "value"), [("JAX_PLATFORMS", "cpu"), ("CUDA_VISIBLE_DEVICES", ""), ("CUDA_VISIBLE_DEVICES", "-1")]
)
def test_a_gpu_that_the_user_leaves_gets_none(machine: pytest.MonkeyPatch, name: str, value: str):
    machine.setenv(name, value)
    assert accelerator.flags("others") == "others"


def test_without_a_gpu_or_with_an_unknown_xla_there_are_none(machine: pytest.MonkeyPatch, tmp_path: Path):
    machine.setattr(accelerator, "KNOWN", False)
    assert accelerator.flags("others") is None, "not those for a CPU either"
    (tmp_path / NODE).unlink()
    assert accelerator.flags("others") == "others"


@pytest.mark.parametrize("platforms", ["cuda", "gpu"])
def test_a_gpu_that_jax_cannot_use_is_refused(machine: pytest.MonkeyPatch, platforms: str):
    machine.setattr(importlib.util, "find_spec", lambda name: None)
    machine.setenv("JAX_PLATFORMS", platforms)
    with pytest.raises(UserError, match=f"JAX_PLATFORMS={platforms} asks for a GPU"):
        accelerator.flags(None)
    machine.setenv("JAX_PLATFORMS", f"{platforms},cpu")
    assert accelerator.flags("others") == "others"


@pytest.mark.skipif(not accelerator.KNOWN, reason="another XLA has other flags")
def test_xla_knows_the_flags():
    """It ends a process that names one that it does not know."""
    command = [sys.executable, "-c", "import jax; print(jax.device_count())"]
    known = subprocess.run(command, env={**os.environ, "XLA_FLAGS": accelerator.QUICKLY}, capture_output=True)
    assert known.returncode == 0, known.stderr.decode()
