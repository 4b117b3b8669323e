"""What is done to messages from the command line: the words of the flags, what it is called, and what it changes."""

import json
import re
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from conftest import TinyRun
from PIL import Image

from gacrl.cli.main import main
from gacrl.config import presets
from gacrl.experiments import scoring
from gacrl.messages import interventions
from gacrl.tasks.spread.settings import METRICS
from gacrl.training import session

pytestmark = [pytest.mark.usefixtures("one_trainer"), pytest.mark.xdist_group("runs")]

EVALUATED = ["--episodes", "4", "--horizon", "6"]
NOTHING = {who: dict.fromkeys(METRICS, reached) for who, reached in (("random", -2.0), ("oracle", -1.0))}
"""What the scripted policies reach."""


@pytest.fixture(scope="module", autouse=True)
def parsed_once() -> Iterator[None]:
    """The same words are the same intervention, so that the command and Python share a program."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(interventions, "parse", cache(interventions.parse))
        yield


@pytest.fixture
def quick_references(monkeypatch: pytest.MonkeyPatch) -> None:
    """In place of what the scripted policies reach, which would take longer to compile than all the rest."""
    monkeypatch.setattr(scoring, "_references", lambda *asked: NOTHING)


@pytest.mark.parametrize(
    ("words", "text", "told"),
    [
        (["--silence"], "silence", "nobody hears anybody"),
        pytest.param(["--silence", "1"], "silence 1", "nobody hears agent 1", marks=pytest.mark.slow),
        (["--silence", "0", "2"], "silence 0 2", "nobody hears agents 0 and 2"),
        (["--scramble"], "scramble", "every agent is heard with its words from another episode"),
        (["--drop", "0.25"], "drop 0.25", "each edge loses its messages in 25 % of the steps"),
        pytest.param(["--delay", "1"], "delay 1", "words arrive 1 step late", marks=pytest.mark.slow),
        (["--delay", "3"], "delay 3", "words arrive 3 steps late"),
    ],
    ids=lambda value: value if isinstance(value, str) and " " not in value else None,
)
def test_the_table_says_what_was_done_and_the_numbers_are_those_of_python(
    words: list[str],
    text: str,
    told: str,
    tiny_run: TinyRun,
    quick_references: None,
    capsys: pytest.CaptureFixture[str],
):
    assert main(["evaluate", str(tiny_run.folder), *EVALUATED, *words, "--json"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith(f"{tiny_run.folder}: 4 episodes of 6 steps; {told}; mean over seeds")
    scores = json.loads(lines[-1])
    assert scores["intervention"] == told

    values = scoring.play(
        str(tiny_run.folder), 4, lambda task: replace(task, max_cycles=6), interventions.parse(text)
    )
    for name in ("return_agent_mean", "coverage_final_0.1"):
        np.testing.assert_allclose(scores["final"]["greedy"][name]["mean"], values[name].mean(), rtol=1e-6)


def test_without_a_flag_nothing_is_done(
    tiny_run: TinyRun, quick_references: None, capsys: pytest.CaptureFixture[str]
):
    assert main(["evaluate", str(tiny_run.folder), *EVALUATED, "--json"]) == 0
    title, *_, last = capsys.readouterr().out.splitlines()
    assert "episodes of 6 steps; mean over seeds" in title
    scores = json.loads(last)
    assert "intervention" not in scores and scores["versions"]["jax"]


def test_a_film_says_what_was_done(tiny_run: TinyRun, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    words = ["render", str(tiny_run.folder), "--episodes", "1", "--horizon", "3"]
    assert main([*words, "--out", str(tmp_path / "heard.gif")]) == 0
    assert main([*words, "--silence", "--out", str(tmp_path / "silent.gif")]) == 0
    assert main([*words, "--beside", "--size", "120", "--out", str(tmp_path / "both.png")]) == 0
    said = capsys.readouterr().out.splitlines()
    assert said[0].endswith(f"heard.gif: 1 episode of {tiny_run.folder}")
    assert said[1].endswith(f"silent.gif: 1 episode of {tiny_run.folder}; nobody hears anybody")
    assert said[2].endswith(f"both.png: 1 episode of {tiny_run.folder}; beside them nobody hears anybody")
    heads: list[np.ndarray] = []
    for name in ("heard.gif", "silent.gif"):
        with Image.open(tmp_path / name) as film:
            heads.append(np.asarray(film.convert("RGB"))[:38])
    assert (heads[0] != heads[1]).any(), "its title too"


@pytest.mark.parametrize("command", ["evaluate", "render"])
@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--silence", "7"], r"silence: there are the agents 0 to 2, and no agent 7"),
        (["--silence", "x"], r"--silence must be a whole number, not x; other words stand before it: see .*"),
        (["--silence", "--drop", "0.1"], r"one thing at a time .*, not --silence and --drop"),
        (["--drop", "1.5"], r"--drop must be a probability between 0 and 1, not 1.5"),
        (["--drop", "nan"], r"--drop must be a probability between 0 and 1, not nan"),
        (["--delay", "-1"], r"--delay must be a whole number of steps between 1 and 1000, not -1"),
        (["--delay", "0"], r"--delay must be a whole number of steps between 1 and 1000, not 0"),
        (["--delay", "1.5"], r"--delay must be a whole number, not 1.5: see .*"),
    ],
    ids=" ".join,
)
def test_what_cannot_be_done_is_one_sentence(
    command: str,
    words: list[str],
    sentence: str,
    tiny_run: TinyRun,
    quick_references: None,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
):
    out = [] if command == "evaluate" else ["--out", str(tmp_path / "film.gif")]
    assert main([command, str(tiny_run.folder), "--horizon", "3", *out, *words]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert re.fullmatch(rf"gacrl: {sentence}\n", said)


@pytest.fixture(scope="module")
def silent_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run whose agents say nothing."""
    ippo = presets.preset("ippo")
    config = replace(
        ippo,
        algorithm=replace(ippo.algorithm, network=replace(ippo.algorithm.network, width=4)),
        env=replace(ippo.env, max_cycles=3),
        training=replace(ippo.training, env_steps=2, num_envs=1, num_steps=2),
        evaluation=replace(ippo.evaluation, interval=2, num_episodes=2, final_episodes=2),
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(session, "evaluate_scripted", lambda *task: NOTHING)
        return session.start(config, tmp_path_factory.mktemp("silent") / "run").folder


@pytest.mark.parametrize("command", ["evaluate", "render"])
@pytest.mark.parametrize("words", [["--silence"], ["--delay", "2"]], ids=" ".join)
@pytest.mark.soak
def test_who_says_nothing_cannot_be_changed(
    command: str,
    words: list[str],
    silent_run: Path,
    quick_references: None,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
):
    out = [] if command == "evaluate" else ["--out", str(tmp_path / "film.gif")]
    for run, who in ((str(silent_run), "the agents say"), ("oracle", "oracle says")):
        assert main([command, run, *out, *words]) == 2
        assert capsys.readouterr().err == (
            f"gacrl: {who} nothing: there are no messages to intervene in; leave the intervention out\n"
        )


def test_the_real_mpe2_lets_every_message_arrive(tiny_run: TinyRun, capsys: pytest.CaptureFixture[str]):
    assert main(["evaluate", str(tiny_run.folder), *EVALUATED, "--silence", "--backend", "mpe2"]) == 2
    assert capsys.readouterr().err == (
        "gacrl: in the real MPE2 every message arrives: take the backend jax, or no intervention\n"
    )
