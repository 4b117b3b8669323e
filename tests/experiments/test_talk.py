"""Does a task need talk, and do the agents use it: the judgement by hand, and a study from end to end."""

import json
from pathlib import Path

import numpy as np
import pytest

from gacrl.cli import arguments, parsing
from gacrl.config import files as configuration
from gacrl.errors import UserError
from gacrl.experiments import talk
from gacrl.experiments.talk import LEARNERS, SCRAMBLED, SENT, SILENT, TALKING, TOLD
from gacrl.training.recorder import RunFolder

pytestmark = pytest.mark.xdist_group("runs")

ON_REFERENCE = configuration.on_task(configuration.preset(), "reference")


def judged(silent: float, told: float, sent: float, scrambled: float, noise: float = 0.1) -> talk.Answer:
    """Judge seeds that lie a little around these returns; random earns −30."""

    def seeds(middle: float) -> np.ndarray:
        return middle + noise * np.array([-1.0, 0.0, 1.0])

    returns = {SILENT: seeds(silent), TALKING: seeds(sent), TOLD: seeds(told)}
    return talk.answer(returns, {SENT: seeds(sent), SCRAMBLED: seeds(scrambled)}, -30.0)


def test_worth_and_use_are_judged_by_hand_worked_numbers():
    """Told earns 10 more than silent, silent 12 more than random; scrambling costs 8 of the 10."""
    found = judged(-18.0, -8.0, -8.5, -16.5)
    assert (found.worth.point, found.used.point) == pytest.approx((10.0, 8.0))
    assert (found.needs, found.uses) == (True, True)


def test_agents_that_ignore_each_other_do_not_use_talk():
    found = judged(-18.0, -8.0, -17.9, -17.9)
    assert (found.needs, found.uses) == (True, False)
    loss = judged(-18.0, -8.0, -17.0, -17.4)  # .4 of 10 is below the 5 % that count
    assert not loss.uses


def test_a_gain_that_is_small_beside_what_is_learned_is_no_need():
    assert not judged(-18.0, -17.6, -18.0, -18.0).needs  # .4 of 12
    assert not judged(-18.0, -17.0, -18.0, -18.0, noise=3.0).needs, "the interval includes 0"
    assert not judged(-18.0, -19.0, -18.0, -18.0).needs


def test_the_sentence_says_both():
    def told(answer: talk.Answer) -> str:
        returns = dict.fromkeys(LEARNERS, np.zeros(3))
        return talk.Talk(Path(), Path(), ON_REFERENCE, {}, returns, {}, answer).sentence

    assert told(judged(-18.0, -8.0, -8.5, -16.5)).startswith(
        "reference needs talk: agents that are told what others see earn 10.00 ["
    )
    assert "These agents use it: scrambling their words costs them 8.00 [8.00, 8.00], 80 % of that." in told(
        judged(-18.0, -8.0, -8.5, -16.5)
    )
    assert "do not use it" in told(judged(-18.0, -8.0, -17.9, -17.9))
    assert "needs no talk" in told(judged(-18.0, -18.0, -18.0, -18.0))


def test_the_three_learners_are_about_as_large(tmp_path: Path):
    runs = talk.plan(ON_REFERENCE, tmp_path)
    sizes = [talk.num_parameters(run.config) for run in runs]
    assert [run.name for run in runs] == list(LEARNERS)
    assert max(sizes) / min(sizes) < 1.05, sizes
    assert len({run.config.algorithm.network.communication for run in runs}) == 3  # pyright: ignore[reportAttributeAccessIssue]


def test_only_those_who_talk_are_taught_to(tmp_path: Path):
    runs = talk.plan(configuration.on_task(configuration.preset("gacrl"), "reference"), tmp_path)
    critics = [run.config.algorithm.critic for run in runs]  # pyright: ignore[reportAttributeAccessIssue]
    assert critics == ["central", "told", "central"]


def test_the_command_in_the_report_is_the_one_that_was_given():
    """What it says of the task is understood, and trains on the same settings."""
    usual = configuration.on_task(configuration.preset("gacrl"), "colours")
    config = configuration.from_dict({"env": {"graph": "full", "named": False, "num_agents": 4}}, usual)
    words = talk._command(config).split()
    assert {"--env.no-named", "--env.graph"} < set(words)
    flags = words[words.index("--env.num-agents") :]
    assert parsing.changed(usual.env, flags, "talk", arguments.Talk) == config.env
    assert "--env." not in talk._command(usual)
    assert "--env spread" in talk._command(configuration.preset("gacrl")), "without a task it is the study of all"


def test_what_cannot_talk_is_refused(tmp_path: Path):
    with pytest.raises(UserError, match="--seeds must be at least 2, not 1"):
        talk.talk(ON_REFERENCE, tmp_path / "one", seeds=1)
    with pytest.raises(UserError, match="--preset paper has a network of its own"):
        talk.talk(configuration.preset("paper"), tmp_path / "paper")
    alone = configuration.from_dict({"env": {"num_agents": 1}}, configuration.preset())
    with pytest.raises(UserError, match="single agent"):
        talk.talk(alone, tmp_path / "alone")
    assert not list(tmp_path.iterdir()), "nothing is made for what is refused"


SMALL = configuration.from_dict(
    {
        "algorithm": {"updates": 1, "batch_size": 8, "replay_capacity": 500, "learning_starts": 0},
        "evaluation": {"num_episodes": 4, "final_episodes": 8},
    },
    configuration.on_task(configuration.preset("vdn", **{"algorithm.network.width": 8}), "reference"),
)


@pytest.mark.soak
def test_a_study_trains_three_learners_and_plays_one_of_them_in_four_ways(tmp_path: Path):
    done = talk.talk(SMALL, tmp_path / "study", seeds=2, env_steps=512)
    assert done is not None
    summary = json.loads((tmp_path / "study" / "summary.json").read_text())
    assert summary["sentence"] == done.sentence
    for name in LEARNERS:
        final = json.loads(RunFolder(tmp_path / "study" / name).summary_file.read_text())["final"]["greedy"]
        np.testing.assert_allclose(summary["returns"][name], final["return_agent_mean"]["values"], rtol=1e-6)
    assert set(summary["played"]) == {"as sent", "silenced", "scrambled", "a step late"}
    assert summary["played"]["as sent"] == summary["returns"]["talking"]
    assert "Does reference need talk?" in done.report.read_text(encoding="utf-8")
    again = talk.talk(SMALL, tmp_path / "study", seeds=2, env_steps=512)
    assert again is not None and again.to_dict() == done.to_dict(), "nothing is trained again"
