"""What is known of tasks before anybody learns them, and the score that runs from silence to being told."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import soaked

import gacrl
from gacrl import tasks
from gacrl.evaluation import references
from gacrl.experiments import anchors, scoring
from gacrl.tasks.task import SILENT, TOLD

TALKING = [name for name in tasks.names() if SILENT in tasks.find(name).references]


def test_tasks_are_listed_with_random_silent_and_told_scores():
    assert {"scouts", "reference", "speaker_listener", "colours"} <= set(TALKING)
    for name in ("spread", *TALKING):
        row = anchors.row(name)
        scores = [row["scores"][who] for who in anchors.SCORED]
        assert scores == sorted(scores), "being told is worth something"
        assert all(f"{who} {row['scores'][who]:.2f}" in anchors.sentence(row) for who in anchors.SCORED)


@pytest.mark.parametrize("name", soaked(TALKING, "scouts"))
def test_anchors_are_what_the_scripted_policies_score(name: str):
    """As far as 512 episodes tell; trained policies may have taken their place where they are better."""
    task = tasks.find(name)
    known = task.known()
    for who in anchors.SCORED:
        played = references.scripted_episodes(who, name, tasks.default_settings(name), 512)[task.headline]
        error = np.std(played) / np.sqrt(512)
        assert abs(np.mean(played) - known["scripted"][who][task.headline]) < 4 * error, who
        assert known["scripted"][who]["standard_error"] < error
    for who in (SILENT, TOLD):
        assert known["scores"][who] >= known["scripted"][who][task.headline]
        assert who in known["trained"], "there is a place for it"


def test_score_talk_is_0_in_silence_and_1_where_all_is_told():
    talk = tasks.find("reference").known()["scores"]
    scores = scoring.score_run("random", 64, task="reference")
    greedy = scores["final"]["greedy"]
    expected = (greedy["return_agent_mean"]["mean"] - talk[SILENT]) / (talk[TOLD] - talk[SILENT])
    assert expected < -0.8
    np.testing.assert_allclose(greedy["score_talk"]["mean"], expected, rtol=1e-6)
    assert scores["task"]["talk"] == {SILENT: talk[SILENT], TOLD: talk[TOLD]}


@pytest.mark.parametrize(
    ("name", "changes", "has"),
    [
        ("colours", {"graph": "full", "goal_bonus": 0.0}, True),
        ("colours", {"num_landmarks": 4}, False),
        ("reference", {"max_cycles": 50}, False),
        ("scouts", {"num_agents": 5}, False),
        ("scouts", {"reward": "mpe2"}, True),
        ("spread", {}, False),  # its anchors are there, and being told is worth next to nothing
        ("traffic_junction", {"arrival_start": 0.1}, True),
        ("traffic_junction", {"vision": 1}, False),
    ],
)
def test_anchors_are_of_one_setting_of_the_task(name: str, changes: dict[str, object], has: bool):
    task = tasks.find(name)
    facts = task.facts(replace(tasks.default_settings(name), **changes), [])
    assert (facts["talk"] is not None) == has
    assert json.loads(json.dumps(facts)) == facts


@pytest.mark.parametrize("text", ["{", "[]", "{}", '{"scores": 3}'])
def test_damaged_anchors_are_named(tmp_path: Path, text: str):
    file = tmp_path / "anchors.json"
    file.write_text(text)
    with pytest.raises(gacrl.ConfigError, match=r"anchors\.json, the anchors of reference, must be a JSON object"):
        tasks.find("reference")._replace(anchors=file).known()
    assert tasks.find("reference")._replace(anchors=tmp_path / "none.json").known() == {}
