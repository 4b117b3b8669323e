"""Words become arguments: whole numbers as people write them, `none` for nothing, and flags by their nearest name."""

from dataclasses import fields
from pathlib import Path
from typing import get_type_hints

import pytest

from gacrl.cli import arguments, parsing
from gacrl.cli.main import main
from gacrl.config import presets
from gacrl.config.checks import SYNONYMS, nearest

COMMANDS = {
    kind.__name__.lower(): kind
    for kind in vars(arguments).values()
    if isinstance(kind, type) and kind.__module__ == arguments.__name__ and "examples:" in (kind.__doc__ or "")
}


MESSAGES = {"--silence", "--scramble", "--drop", "--delay"}


def train(*words: str, preset: str = "gacrl") -> arguments.Train:
    base = arguments.Train(arguments.Settings.of(presets.preset(preset)))
    return parsing.parse(arguments.Train, list(words), "train", default=base)


@pytest.mark.parametrize(
    ("text", "number"), [("1e5", 100_000), ("2.5E3", 2_500), ("10", 10), ("1e0", 1), ("-3", -3), ("1_000", 1_000)]
)
def test_whole_numbers_may_have_exponents(text: str, number: int):
    assert parsing.whole_number(text) == number


@pytest.mark.parametrize("text", ["1.5e0", "1e-1", "nan", "inf", "ten", "", "1e"])
def test_what_is_no_whole_number_is_refused(text: str):
    with pytest.raises(ValueError, match="must be a whole number, not"):
        parsing.whole_number(text)


def test_every_whole_number_of_every_command_may_have_an_exponent():
    seen = 0
    for name, kind in COMMANDS.items():
        hints = get_type_hints(kind)
        whole = [field.name for field in fields(kind) if hints[field.name] in (int, int | None)]
        for field in whole:
            needed = [value for it in ("run", "spec") if it in hints for value in ["runs/x"]]
            flag = f"--{field.replace('_', '-')}"
            words = [*needed, flag, "1e4"]
            asked = train(*words) if kind is arguments.Train else parsing.parse(kind, words, name)
            assert getattr(asked, field) == 10_000, (name, flag)
            seen += 1
    assert seen >= 15
    settings = train(
        "--seed", "1e3", "--training.num-envs", "2e1", "--algorithm.network.nearest-agents", "1e0"
    ).settings
    assert (settings.seed, settings.training.num_envs, settings.algorithm.network.nearest_agents) == (1_000, 20, 1)
    hidden = train("--algorithm.encoder-hidden", "1e2", "32", preset="paper").settings.algorithm.encoder_hidden
    assert hidden == (100, 32)


def test_nothing_is_written_as_none():
    asked = train("--env-steps", "none", "--out", "None", "--algorithm.network.nearest-agents", "none")
    assert (asked.env_steps, asked.out, asked.settings.algorithm.network.nearest_agents) == (None, None, None)
    assert train("--out", "a b/ü").out == Path("a b/ü")


@pytest.mark.parametrize("command", list(COMMANDS))
def test_help_calls_things_by_their_names_and_has_examples(command: str, capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit, match="0"):
        main([command, "--help"])
    said = capsys.readouterr().out
    assert "examples:\n  gacrl" in said
    assert not {"STR", "INT", "FLOAT", "{None}|INT", "{None}|PATH", "None)"} & set(said.split())
    assert ("(default: none)" in said) == (command not in ("presets", "doctor", "reproduce"))
    if "run" in {field.name for field in fields(COMMANDS[command])}:
        assert "RUN" in said.splitlines()[0].split()


def test_flags_are_those_of_help(capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit):
        main(["evaluate", "--help"])
    said = capsys.readouterr().out
    flags = parsing._flags(arguments.Evaluate, None)
    assert (
        set(flags)
        == {"--episodes", "--horizon", "--backend", "--num-agents", "--utter", "--json", "--env", "--use"}
        | MESSAGES
    )
    assert all(flag in said for flag in flags)
    known = parsing._flags(arguments.Train, arguments.Train(arguments.Settings.of(presets.preset("ippo"))))
    assert {"--from", "--algorithm.network.width", "--env.max-cycles", "--seed", "--coordinator"} <= set(known)
    assert not {flag for flag in known if flag.endswith(("task", "name", "settings", "FORMERLY"))}


def test_synonyms_are_of_settings_that_there_are():
    known = {
        flag.rpartition(".")[2].lstrip("-").replace("-", "_")
        for preset in presets.PRESETS
        for flag in parsing._flags(arguments.Train, arguments.Train(arguments.Settings.of(presets.preset(preset))))
    }
    assert {name for names in SYNONYMS.values() for name in names} <= known


def test_the_nearest_setting_of_a_file_is_found_by_its_synonym():
    assert nearest("algorithm.lr", ["algorithm.reward", "algorithm.learning_rate"]) == "algorithm.learning_rate"
    assert nearest("training.n_envs", ["training.env_steps", "training.num_envs"]) == "training.num_envs"
    assert nearest("--eps", ["--algorithm.clip-eps", "--algorithm.epsilon"]) == "--algorithm.epsilon"
    assert nearest("--eps", ["--algorithm.clip-eps", "--env-steps"]) == "--algorithm.clip-eps"
    assert nearest("--zzz", ["--json"]) is None


@pytest.mark.parametrize(
    ("words", "text"),
    [
        ([], ""),
        (["--silence"], "silence"),
        (["--silence", "0", "2", "--horizon", "5"], "silence 0 2"),
        (["--silence", "none"], ""),
        (["--scramble"], "scramble"),
        (["--drop", ".25"], "drop 0.25"),
        (["--drop", "0"], "drop 0.0"),
        (["--delay", "1e1"], "delay 10"),
    ],
)
@pytest.mark.parametrize("kind", [arguments.Evaluate, arguments.Render])
def test_what_happens_to_messages_is_one_flag(
    kind: type[arguments.Evaluate | arguments.Render], words: list[str], text: str
):
    asked, rest = parsing.parse_known(kind, ["runs/x", *words], kind.__name__.lower())
    assert (asked.messages.words(), rest) == (text, [])
