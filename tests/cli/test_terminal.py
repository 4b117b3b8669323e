"""Screens: where a run stands, in the words of the closing table; which of how many; how long it will take."""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import SCRIPTED_ROW

from gacrl import doctor
from gacrl.cli.main import main
from gacrl.cli.terminal import RunsWatcher, print_evaluation, print_examination
from gacrl.config import presets
from gacrl.config.run import RunConfig
from gacrl.doctor import Check, Finding
from gacrl.experiments.study import Planned, Watch, train_missing
from gacrl.tasks.spread.settings import METRICS
from gacrl.training import session
from gacrl.training.loop import Progress
from gacrl.training.recorder import RunFolder
from gacrl.training.telling import standing
from gacrl.training.watching import Watcher

pytestmark = [pytest.mark.usefixtures("quick_start"), pytest.mark.xdist_group("runs")]


@pytest.fixture
def quick_references(monkeypatch: pytest.MonkeyPatch) -> None:
    """In place of what the scripted policies reach, which would take longer to compile than all the rest."""
    nothing = {
        who: dict.fromkeys(METRICS, float(SCRIPTED_ROW["reward_shaped"][0]))
        for who in ("random", "noop", "oracle")
    }
    nothing["oracle"] = {name: value + 1 for name, value in nothing["oracle"].items()}
    monkeypatch.setattr(session, "evaluate_scripted", lambda *task: nothing)


def long_episodes(seeds: int = 1) -> RunConfig:
    """Three evaluations, and the first training episode ends after the second of them."""
    ippo = presets.preset("ippo")
    return replace(
        ippo,
        algorithm=replace(ippo.algorithm, network=replace(ippo.algorithm.network, width=4)),
        env=replace(ippo.env, max_cycles=5),
        training=replace(ippo.training, env_steps=6, num_envs=1, num_steps=2),
        evaluation=replace(ippo.evaluation, interval=2, num_episodes=2, final_episodes=2),
        num_seeds=seeds,
    )


def test_while_no_episode_has_ended_there_is_no_number(quick_references: None, tmp_path: Path):
    told: list[Progress] = []
    run = session.start(long_episodes(), tmp_path / "run", Watcher(progress=told.append))
    first, second, third = (row["train"] for row in RunFolder(run.folder).metrics())
    for train in (first, second):
        assert train["episodes"] == 0
        assert set(train["mean"]) == set(train["sd"]) == set(train["last_episode"]) >= set(METRICS)
        assert {*train["mean"].values(), *train["sd"].values(), *train["last_episode"].values()} == {None}
    assert third["episodes"] == 1
    assert third["mean"]["return_agent_mean"] < 0
    assert third["mean"] == third["last_episode"]

    lines = [standing(progress) for progress in told]
    reached = [f"greedy return = {p.rows[0]['greedy']['return_agent_mean']:.3f}, coverage 0.1 = " for p in told]
    assert lines[0].startswith(f"step 2 of 6, no episode has ended: {reached[0]}")
    assert lines[1].startswith(f"step 4 of 6, no episode has ended: {reached[1]}")
    assert lines[2].startswith(f"step 6 of 6, episode 1: {reached[2]}")


def test_the_time_left_counts_what_follows_the_last_chunk(quick_references: None, tmp_path: Path):
    told: list[Progress] = []
    session.start(long_episodes(seeds=2), tmp_path / "run", Watcher(progress=told.append))
    assert told[-1].done
    assert 0 < told[-1].seconds_left <= told[0].seconds_left
    assert re.search(r"\(mean of 2 seeds\); [\d,]+ steps/s, \d+ s left$", standing(told[0]))


@pytest.mark.soak
def test_of_several_runs_it_says_which_of_how_many_and_how_long_all_will_take(
    quick_references: None, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    runs = [Planned(name, long_episodes(), tmp_path / name) for name in ("one", "two", "three")]
    for _ in range(2):
        with RunsWatcher() as watcher:
            watch = Watch(watcher.planned, watcher.watcher, watcher.finished, watcher.say)
            watch.planned({"one": "", "two": "without the other", "three": ""})
            assert train_missing(runs, watch)
    lines = capsys.readouterr().out.splitlines()
    told = [line for line in lines if "step " in line]
    assert len(told) == 3, "of three evaluations within a second, one line"
    assert re.search(r"^1 of 3, one: step 2 of 6, no episode .*, \d+ s left; all runs: \d+ s left$", told[0])
    assert [line for line in lines if "without the other" in line] == ["2 of 3, two: without the other"]
    done = [line for line in lines if "done" in line]
    assert re.fullmatch(
        r"1 of 3, one: done in \d+ s, greedy return = -[\d.]+, coverage 0.1 = [\d.]+; all runs: \d+ s left",
        done[0],
    )
    assert re.fullmatch(r"3 of 3, three: done in \d+ s, greedy return = -[\d.]+, coverage 0.1 = [\d.]+", done[2])
    assert lines[-3:] == [f"{k} of 3, {name}: there already" for k, name in enumerate(("one", "two", "three"), 1)]


@pytest.fixture
def scores() -> dict[str, Any]:
    """An evaluation of two seeds."""
    shown = {name: metric.label for name, metric in METRICS.items() if metric.label}
    entry = {"mean": -22.168, "interval": [-30.0, -14.336]}
    return {
        "run": "/home/somebody/with/a/long/name/runs/gacrl-1",
        "episodes": 320,
        "horizon": 25,
        "task": {"shown": shown},
        "final": {"greedy": dict.fromkeys(shown, entry), "sampled": dict.fromkeys(shown, entry)},
        "references": {"random": dict.fromkeys(shown, -29.777)},
        "messages": {"bits_sent": 48.0, "bits_used_last_round": 0.32},
    }


@pytest.mark.parametrize("width", [130, 80, 60, 40])
def test_a_closing_table_is_whole_on_every_screen(
    width: int, scores: dict[str, Any], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setenv("COLUMNS", str(width))
    print_evaluation(scores)
    title, *lines = capsys.readouterr().out.splitlines()
    assert title == (
        "/home/somebody/with/a/long/name/runs/gacrl-1: 320 episodes of 25 steps; mean over seeds ± half the 95 % interval"
    )
    assert max(len(line.rstrip()) for line in lines) <= width
    said = " ".join(" ".join(lines).split())
    assert said.count("-22.168 ± 7.832") == 2 * len(scores["task"]["shown"])
    assert "an agent sends 48 bits in a step, all rounds and turned worlds together" in said
    assert "tells 0.32 bits (0: it is always the same one)" in said


def checks(good: bool) -> list[Check]:
    def look(what: str, verdict: bool = True) -> Callable[[], Any]:
        return lambda: iter([Finding(f"{what} a", True, "1.00"), Finding(f"{what} b", verdict, "0.50")])

    return [
        Check("one", 0.0, look("one")),
        Check("two", 1.0, look("two", good)),
        Check("three", 1.0, look("three")),
    ]


def test_the_doctor_says_how_far_it_is(capsys: pytest.CaptureFixture[str]):
    found = print_examination(checks(good=True))
    assert [finding.what for finding in found] == ["one a", "one b", "two a", "two b", "three a", "three b"]
    assert capsys.readouterr().out.splitlines() == [
        "ok   1 of 3  one a: 1.00",
        "ok   1 of 3  one b: 0.50",
        "ok   2 of 3  two a: 1.00",
        "ok   2 of 3  two b: 0.50 (0 s left)",
        "ok   3 of 3  three a: 1.00",
        "ok   3 of 3  three b: 0.50",
    ]


def test_a_machine_that_fails_ends_the_doctor_with_a_sentence(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setattr(doctor, "checks", lambda: checks(good=False))
    assert main(["doctor"]) == 2
    said = capsys.readouterr()
    assert "BAD  2 of 3  two b: 0.50" in said.out
    assert said.err == "gacrl: this machine does not do what it must: two b\n"


def test_the_doctors_list_has_every_learner_once():
    asked = doctor.checks()
    learners = [check.what.partition(" ")[0] for check in asked if check.what.endswith("on the probes")]
    assert learners == ["gacrl", "qmix", "vdn", "iql", "mappo", "ippo", "commnet", "dial", "paper"]
    assert np.isclose(sum(check.work for check in asked), 1 + len(learners))
