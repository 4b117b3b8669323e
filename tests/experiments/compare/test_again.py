"""`gacrl compare --horizon`: runs of other horizons are played again, as `gacrl evaluate --horizon` plays them."""

import csv
import json
import re
from dataclasses import replace
from pathlib import Path

import pytest

from gacrl.cli.main import main
from gacrl.config import presets
from gacrl.config.run import EvaluationConfig, RunConfig, TrainingConfig
from gacrl.training import session

pytestmark = [pytest.mark.usefixtures("one_trainer"), pytest.mark.xdist_group("runs")]


def tiny(horizon: int, episodes: int) -> RunConfig:
    ippo = presets.preset("ippo")
    algorithm = replace(ippo.algorithm, network=replace(ippo.algorithm.network, width=8))
    return replace(
        ippo,
        algorithm=algorithm,
        env=replace(ippo.env, max_cycles=horizon),
        training=TrainingConfig(env_steps=48, num_envs=2, num_steps=12),
        evaluation=EvaluationConfig(interval=24, num_episodes=2, final_episodes=episodes),
        num_seeds=2,
    )


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """One of 4 steps an episode, one of 6."""
    folder = tmp_path_factory.mktemp("again")
    return tuple(  # pyright: ignore[reportReturnType]
        session.start(tiny(horizon, 3), folder / f"steps-{horizon}").folder for horizon in (4, 6)
    )


@pytest.mark.soak
def test_runs_of_other_horizons_stand_in_one_table(
    runs: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    short, long = runs
    assert main(["compare", str(short), str(long)]) == 2
    assert "--horizon 4 plays the others again" in capsys.readouterr().err

    assert main(["evaluate", str(long), "--horizon", "4", "--episodes", "3", "--json"]) == 0
    expected = json.loads(capsys.readouterr().out.splitlines()[-1])
    table = tmp_path / "values.csv"
    words = [
        "--horizon",
        "4",
        "--metric",
        "return_agent_mean",
        "--csv",
        str(table),
        "--out",
        str(tmp_path / "page"),
    ]
    assert main(["compare", str(short), str(long), *words, "--json"]) == 0
    said = capsys.readouterr()
    first, *others = said.err.splitlines()
    assert first == f"gacrl: playing {long} again, over 4 steps"
    assert [line.rpartition(" of ")[2] for line in others] == ["steps-4 for the page", "steps-6 for the page"]
    shown = (tmp_path / "page" / "comparison.html").read_text(encoding="utf-8")
    assert set(re.findall(r'"steps":(\d+)', shown)) == {"4"}, "the episodes to look at are as long"
    data = json.loads(said.out.splitlines()[-1])
    own = json.loads((short / "summary.json").read_text(encoding="utf-8"))
    values = [group["metrics"]["return_agent_mean"]["values"] for group in data["groups"]]
    assert values[0] == own["final"]["greedy"]["return_agent_mean"]["values"], "its own closing evaluation"
    assert values[1] == pytest.approx(expected["final"]["greedy"]["return_agent_mean"]["values"], rel=1e-6)
    assert values[1] != pytest.approx(
        json.loads((long / "summary.json").read_text())["final"]["greedy"]["return_agent_mean"]["values"], rel=1e-3
    )
    assert data["references"]["random"]["return_agent_mean"] == pytest.approx(
        expected["references"]["random"]["return_agent_mean"], rel=1e-6
    )
    assert data["horizon"] == 4 and "env.max_cycles" in data["unequal_switches"]
    assert [group["env_steps"] for group in data["groups"]] == [[24, 48], []]
    assert any(note.startswith("played again over 4 steps, and without a curve") for note in data["notes"])
    with table.open(newline="") as file:
        assert {row["stage"] for row in csv.DictReader(file) if row["run"] == str(long)} == {"closing"}
    assert f"gacrl compare {short} {long} --horizon 4 --metric return_agent_mean" in shown, "what was typed"


def test_a_horizon_that_all_have_plays_nothing(runs: tuple[Path, Path], capsys: pytest.CaptureFixture[str]):
    assert main(["compare", str(runs[0]), "--horizon", "4"]) == 0
    assert capsys.readouterr().err == ""
    assert main(["compare", str(runs[0]), "--horizon", "0"]) == 2
    assert capsys.readouterr().err == "gacrl: --horizon must be at least 1 step, not 0\n"
