"""`benchmarks/keep.py` takes into docs/data only what one clean commit made, whole."""

import importlib.util
import json
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from gacrl.config import files, presets
from gacrl.errors import UserError

ROOT = Path(__file__).parent.parent


@pytest.fixture(scope="module")
def keep() -> ModuleType:
    spec = importlib.util.spec_from_file_location("keep", ROOT / "benchmarks" / "keep.py")
    assert spec is not None and spec.loader is not None
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    return script


CLEAN, OTHER = "c0ffee" * 6 + "c0ff", "decade" * 6 + "deca"


@pytest.mark.parametrize(
    ("begun", "summary", "refused"),
    [
        (CLEAN, {}, ""),
        (OTHER, {}, "was begun by commit decade.* and ended by c0ffee"),
        (None, {}, "knows no commit"),
        (f"{CLEAN}-dirty", {"versions": {"git_commit": f"{CLEAN}-dirty"}}, "with changes beside commit c0ffee"),
        (CLEAN, {"seeds": [0, 2]}, r"holds seeds \[0, 2\], where \[0, 1\] were planned"),
        (CLEAN, {"final": {"greedy": {"x": {"values": [1.0]}}}}, r"lacks a finite value of x \(greedy\)"),
        (CLEAN, {"final": {"greedy": {"x": {"values": [1.0, float("nan")]}}}}, "lacks a finite value"),
    ],
)
def test_only_what_one_clean_commit_made_is_kept(
    keep: ModuleType, tmp_path: Path, begun: str | None, summary: dict[str, Any], refused: str
):
    whole = {
        "seeds": [0, 1],
        "final": {"greedy": {"x": {"values": [1.0, 2.0]}}},
        "versions": {"git_commit": CLEAN},
        **summary,
    }
    config = files.from_dict({"num_seeds": 2}, presets.preset("gacrl"))
    (tmp_path / "config.json").write_text(files.dumps(config), encoding="utf-8")
    (tmp_path / "origin.json").write_text(json.dumps({"versions": {"git_commit": begun}}), encoding="utf-8")
    with pytest.raises(UserError, match="is no finished run"):
        keep.kept_summary(tmp_path, "gacrl train")
    (tmp_path / "summary.json").write_text(json.dumps(whole), encoding="utf-8")
    if refused:
        with pytest.raises(UserError, match=refused):
            keep.kept_summary(tmp_path, "gacrl train")
        return
    assert keep.kept_summary(tmp_path, "gacrl train") == {"command": "gacrl train", **whole}
    (tmp_path / "diverged.json").write_text("{}", encoding="utf-8")
    with pytest.raises(UserError, match="diverged"):
        keep.kept_summary(tmp_path, "gacrl train")


def scores(**changes: Any) -> dict[str, Any]:
    final = {"greedy": {"return_agent_mean": {"values": [-7.0, -7.2]}}}
    return {"run": "runs/gacrl", "final": final, "versions": {"git_commit": CLEAN}, **changes}


@pytest.mark.parametrize(
    ("printed", "refused"),
    [
        (scores(), ""),
        (scores(versions={"jax": "0.10.2"}), "the evaluation knows no commit"),
        (scores(versions={"git_commit": f"{CLEAN}-dirty"}), "with changes beside commit c0ffee"),
        (scores(final={"greedy": {"return_agent_mean": {"values": [float("nan")]}}}), "lacks a finite value"),
        ({"run": "runs/gacrl"}, "that is no evaluation: pipe in what `gacrl evaluate --json` prints"),
    ],
)
def test_an_evaluation_is_kept_with_the_commit_that_played(
    keep: ModuleType, printed: dict[str, Any], refused: str
):
    lines = f"greedy  −7.1\n{json.dumps(printed)}\n"
    if refused:
        with pytest.raises(UserError, match=refused):
            keep.kept_evaluation(lines, "gacrl evaluate runs/gacrl")
    else:
        assert keep.kept_evaluation(lines, "gacrl evaluate runs/gacrl")["versions"] == {"git_commit": CLEAN}


@pytest.mark.parametrize(
    ("summary", "refused"),
    [
        ({"versions": [{"git_commit": CLEAN}]}, ""),
        (
            {"versions": [{"git_commit": CLEAN}, {"git_commit": OTHER}]},
            "not of one version of the code, but of c0ffee",
        ),
        ({"versions": [{"git_commit": f"{CLEAN}-dirty"}]}, "no commit has the code that made these"),
        (
            {"versions": [{"git_commit": CLEAN, "jax": "0.10"}, {"git_commit": CLEAN, "jax": "0.11"}]},
            "versions of jax",
        ),
        ({"versions": [{"jax": "0.10.2"}]}, "knows no commit"),
        ({}, "knows no commit"),
        ({"versions": [{"git_commit": CLEAN}], "returns": {"told": [1.0, float("nan")]}}, "not a finite number"),
    ],
)
def test_a_study_is_kept_with_the_one_commit_of_its_runs(
    keep: ModuleType, tmp_path: Path, summary: dict[str, Any], refused: str
):
    with pytest.raises(UserError, match="is no finished study"):
        keep.kept_study(tmp_path, "gacrl talk")
    (tmp_path / "summary.json").write_text(json.dumps(summary), encoding="utf-8")
    if refused:
        with pytest.raises(UserError, match=refused):
            keep.kept_study(tmp_path, "gacrl talk")
    else:
        assert keep.kept_study(tmp_path, "gacrl talk") == {"command": "gacrl talk", **summary}


def test_folders_of_this_machine_are_not_kept(keep: ModuleType):
    kept = {"out": "/tmp/x/talk", "report": "/tmp/x/talk/report.html", "task": "reference"}
    assert keep._places(kept) == {"out": "runs/talk", "report": "runs/talk/report.html"}
    assert keep._places({"run": "pretrained:gacrl"}) == {}
