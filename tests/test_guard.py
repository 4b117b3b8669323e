"""The guard of `make bench`: what has fallen or grown too far is named, what has not is let through."""

import importlib.util
import sys
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"


@pytest.fixture
def guard(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    spec = importlib.util.spec_from_file_location("guard", BENCHMARKS / "guard.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    yield module
    for name in ("environment", "peers"):
        sys.modules.pop(name, None)


def test_a_ratio_that_fell_by_more_than_the_tolerance_is_named(guard, capsys):
    before = {"peer": {"1": 10.0, "32": 10.0}}
    now = {"peer": {"1": [8.0, 8.4, 20.0], "32": [8.0, 8.6, 20.0], "64": [0.1]}}
    assert guard.fallen("environment", now, before) == ["environment: peer at 1"]
    said = capsys.readouterr().out
    assert said.count("FALLEN") == 1
    assert "8.4 (8 to 20)" in said
    missing = ["environment: peer at 1 (not measured)", "environment: peer at 32 (not measured)"]
    assert guard.fallen("environment", {}, before) == missing, "a peer that is not there is not let through"


def test_a_program_that_grew_by_more_than_the_tolerance_is_named(guard):
    before = {"instructions: paper": 1000, "messages: ippo": 1000}
    now = {"instructions: paper": 1160, "messages: ippo": 1140, "new": 5}
    assert guard.grown(now, before) == ["instructions: paper"]


def test_the_committed_baseline_is_what_the_guard_reads(guard):
    baseline = guard.json.loads(guard.BASELINE.read_text(encoding="utf-8"))
    assert set(baseline) == {"jax", "counts", "environment", "training"}
    assert set(baseline["training"]["products"]) == {"ippo", "qmix"}
    assert set(baseline["environment"]) == {"jaxmarl", "vmas"}
    assert all(set(sizes) == {"1", "32", "1024", "16384"} for sizes in baseline["environment"].values())
