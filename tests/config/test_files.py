"""Settings: they load as they were saved, and whatever cannot be ends in one sentence."""

import dataclasses
import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gacrl import tasks
from gacrl.config import presets
from gacrl.config.algorithms import GacrlPaperConfig
from gacrl.config.files import dumps, fingerprint, from_dict, load, on_task, to_dict
from gacrl.config.presets import PRESETS, preset
from gacrl.config.run import CurriculumConfig, EvaluationConfig, RunConfig, TrainingConfig
from gacrl.errors import ConfigError
from gacrl.tasks.spread.settings import SpreadSettings
from gacrl.tasks.task import Task
from gacrl.training.recorder import RunFolder

PAPER = preset("paper")
UNUSUAL = RunConfig(
    algorithm=GacrlPaperConfig(encoder_hidden=(7,), policy_hidden=(5, 6), messages="straight_through", radius=0.3),
    env=SpreadSettings(
        num_agents=5, num_landmarks=2, terminate_on_success=True, reward="paper", local_ratio_end=0.2
    ),
    curriculum=CurriculumConfig(episodes=20, gate=0.5),
    training=TrainingConfig(env_steps=7, num_envs=2, num_steps=3),
    evaluation=EvaluationConfig(horizon=9),
    preset="paper",
    seed=11,
    num_seeds=3,
)
"""Every kind of value, away from its default."""


def write(folder: Path, data: Any) -> Path:
    path = folder / "settings.json"
    path.write_text(data if isinstance(data, str) else json.dumps(data), encoding="utf-8")
    return path


def nested(path: str, value: Any) -> dict[str, Any]:
    """{"a": {"b": value}} for "a.b"."""
    for key in reversed(path.split(".")):
        value = {key: value}
    return value


def numbers(config: Any, where: str = "") -> Iterator[tuple[str, str]]:
    """The path and the type of every setting that is a number."""
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if dataclasses.is_dataclass(value):
            yield from numbers(value, f"{where}{field.name}.")
        elif str(field.type).startswith(("int", "float", "<class 'int'>", "<class 'float'>")):
            yield where + field.name, "float" if "float" in str(field.type) else "int"


NUMBERS = [
    (base, path, kind)
    for base in (UNUSUAL, preset("gacrl"), preset("qmix"), preset("mappo"))
    for path, kind in numbers(base)
    if base is UNUSUAL or path.startswith("algorithm.")
]


@pytest.mark.parametrize("config", [*(config for _, config in PRESETS.values()), UNUSUAL])
def test_settings_load_as_they_were_saved(config: RunConfig, tmp_path: Path):
    assert from_dict(to_dict(config)) == config
    assert from_dict(json.loads(dumps(config))) == config
    path = write(tmp_path, dumps(config))
    assert load(path) == config
    assert load(path, UNUSUAL) == config, "a complete file hides its base"
    assert fingerprint(load(path)) == fingerprint(config)


def test_a_preset_is_named_after_itself():
    for name, (description, config) in PRESETS.items():
        assert config.preset == name
        assert description
        assert preset(name) is config
    assert preset() is preset(presets.DEFAULT_PRESET)


def test_a_part_of_the_settings_lies_over_its_base(tmp_path: Path):
    path = write(tmp_path, {"env": {"num_agents": 4, "local_ratio": 1}, "algorithm": {"encoder_hidden": [8]}})
    loaded = load(path, UNUSUAL)
    assert loaded.env == dataclasses.replace(UNUSUAL.env, num_agents=4, local_ratio=1.0)
    assert isinstance(loaded.env.local_ratio, float), "JSON writes 1 for 1.0"
    assert loaded.algorithm == dataclasses.replace(UNUSUAL.algorithm, encoder_hidden=(8,))
    assert loaded.training == UNUSUAL.training

    assert load(write(tmp_path, {"preset": "paper", "seed": 3})) == dataclasses.replace(PAPER, seed=3)
    assert load(write(tmp_path, {"env": {"num_landmarks": None}}), UNUSUAL).env.landmarks == 5


def test_the_fingerprint_follows_every_setting_that_training_depends_on():
    changed = [
        dataclasses.replace(PAPER, seed=1),
        dataclasses.replace(PAPER, env=dataclasses.replace(PAPER.env, local_ratio=0.25)),
        dataclasses.replace(PAPER, algorithm=dataclasses.replace(PAPER.algorithm, radius=1.0)),
        dataclasses.replace(PAPER, training=dataclasses.replace(PAPER.training, num_envs=2)),
    ]
    assert len({fingerprint(config) for config in [PAPER, *changed]}) == 5


@pytest.mark.parametrize(
    ("data", "named", "meant"),
    [
        ({"sead": 1}, "sead", "seed"),
        ({"env": {"num_agent": 4}}, "env.num_agent", "env.num_agents"),
        ({"algorithm": {"learnig_rate": 0.1}}, "algorithm.learnig_rate", "algorithm.learning_rate"),
        ({"algorithm": {"name": "gacrl_papre"}}, "gacrl_papre", "gacrl_paper"),
        ({"preset": "papre"}, "papre", "paper"),
        ({"env": {"name": "spred"}}, "spred", "spread"),
        ({"algorithm": {"network": {"communication": "discret"}}}, "discret", "discrete"),
        ({"algorithm": {"exploration": "adaptiv"}}, "adaptiv", "adaptive"),
    ],
)
def test_an_unknown_key_is_refused_with_the_nearest_one(data: Any, named: str, meant: str, tmp_path: Path):
    learner = "exploration" in str(data) or "communication" in str(data)  # which the paper's algorithm has not
    for attempt in (
        lambda: from_dict(data),
        lambda: from_dict(data, preset("gacrl") if learner else UNUSUAL),
        lambda: load(write(tmp_path, data)),
    ):
        with pytest.raises(ConfigError) as refused:
            attempt()
        assert f"'{named}': did you mean '{meant}'?" in str(refused.value)
    assert str(refused.value).startswith(f"{tmp_path / 'settings.json'}: ")


def test_a_key_like_no_other_is_answered_with_all_there_are():
    with pytest.raises(ConfigError, match="unknown setting '@': known: algorithm, .*, training"):
        from_dict({"@": 1})
    with pytest.raises(ConfigError, match=r"unknown setting 'a\\n\\x1b\[2J'"):
        from_dict({"a\n\x1b[2J": 1})


@pytest.mark.parametrize(
    ("path", "value", "wanted"),
    [
        ("seed", "1", "a whole number"),
        ("seed", 1.5, "a whole number"),
        ("seed", True, "a whole number"),
        ("seed", None, "a whole number"),
        ("env.local_ratio", "0.5", "a number"),
        ("env.local_ratio", False, "a number"),
        ("env.local_ratio", [0.5], "a number"),
        ("env.terminate_on_success", 1, "true or false"),
        ("env.num_landmarks", "3", "a whole number"),
        ("env.reward", "mpe", "one of mpe2, paper"),
        ("env.reward", ["mpe2"], "one of mpe2, paper"),
        ("env", [], "an object of settings"),
        ("algorithm", None, "an object of settings"),
        ("algorithm.name", 3, "a name"),
        ("algorithm.encoder_hidden", 64, "must be a list, not"),
        ("algorithm.encoder_hidden", {}, "must be a list, not"),
        ("algorithm.encoder_hidden", [64, "32"], "a whole number"),
        ("algorithm.encoder_hidden", [], "layer sizes"),
        ("algorithm.policy_hidden", [64], "2 numbers"),
        ("preset", 3, "a name"),
    ],
)
def test_a_value_of_the_wrong_type_is_refused(path: str, value: Any, wanted: str):
    with pytest.raises(ConfigError) as refused:
        from_dict(nested(path, value), PAPER)
    assert path in str(refused.value)
    assert wanted in str(refused.value)


@pytest.mark.parametrize(("base", "path", "kind"), NUMBERS, ids=lambda it: it if isinstance(it, str) else "")
def test_no_number_is_beyond_all_bounds(base: RunConfig, path: str, kind: str):
    """Also not NaN, which is neither below nor above any bound."""
    beyond: list[Any] = [-1, 10**30, 10**400]
    if kind == "float":
        beyond += [-0.001, math.nan, math.inf, -math.inf]
    for value in beyond:
        with pytest.raises(ConfigError) as refused:
            from_dict(nested(path, value), base)
        assert path in str(refused.value)
        assert "must" in str(refused.value)


@pytest.mark.parametrize("path", ["env.num_agents", "env.num_landmarks", "num_seeds", "training.num_envs"])
def test_none_at_all_is_refused(path: str):
    with pytest.raises(ConfigError, match=rf"{path} must be between 1 and 1.*, not 0"):
        from_dict(nested(path, 0))


def test_settings_made_in_python_are_checked_too():
    with pytest.raises(ConfigError, match="env.num_agents must be between 1 and 10000, not 0"):
        SpreadSettings(num_agents=0)
    with pytest.raises(ConfigError, match="must not exceed 1, a probability"):
        GacrlPaperConfig(epsilon=0.9)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("{", "is not JSON"),
        ("", "is not JSON"),
        ('"paper"', "must hold a JSON object"),
        ("[]", "must hold a JSON object"),
        ('{"seed": 1' + "0" * 5000 + "}", "is not JSON"),
        ("[" * 100_000, "is not JSON"),
    ],
)
def test_a_file_that_holds_no_settings_is_refused(text: str, said: str, tmp_path: Path):
    path = write(tmp_path, text)
    with pytest.raises(ConfigError, match=said) as refused:
        load(path)
    assert str(path) in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_file_that_cannot_be_read_is_named(tmp_path: Path):
    for path in (tmp_path / "none.json", tmp_path):
        with pytest.raises(ConfigError, match="cannot read the configuration") as refused:
            load(path)
        assert str(path) in str(refused.value)
    binary = tmp_path / "binary.json"
    binary.write_bytes(b"\xff\xfe{}")
    with pytest.raises(ConfigError, match="is not JSON"):
        load(binary)


def test_derived_sizes():
    config = dataclasses.replace(UNUSUAL, evaluation=EvaluationConfig(interval=13))
    assert config.seeds == (11, 12, 13)
    assert config.steps_per_update == 6
    assert config.num_updates == 2, "a started update is finished"
    assert config.updates_per_chunk == 2, "no chunk is longer than the run"
    longer = dataclasses.replace(config, training=TrainingConfig(env_steps=600, num_envs=2, num_steps=3))
    assert longer.updates_per_chunk == 3


JSON = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats()
    | st.text(max_size=8)
    | st.sampled_from(["paper", "mpe2", "spread", "gacrl_paper", 10**400, 1e308]),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner, max_size=3),
    max_leaves=8,
)


def like_settings(config: Any) -> st.SearchStrategy[dict[str, Any]]:
    """Objects with some of the right keys, at the right depth, and any values."""
    optional: dict[str, st.SearchStrategy[Any]] = {}
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        good = like_settings(value) if dataclasses.is_dataclass(value) else st.just(value)
        optional[field.name] = good | JSON
    return st.fixed_dictionaries({}, optional=optional)


@settings(max_examples=300, deadline=None)
@given(st.dictionaries(st.text(max_size=8), JSON, max_size=4) | like_settings(UNUSUAL))
def test_any_object_is_settings_or_a_sentence(data: dict[str, Any]):
    try:
        config = from_dict(json.loads(json.dumps(data)))
    except ConfigError as refused:
        assert str(refused)
        assert "\n" not in str(refused)
    else:
        assert from_dict(json.loads(dumps(config))) == config
        assert all(isinstance(value, str | int | float | bool | tuple | None) for value in values(config))


def values(config: Any) -> Iterator[Any]:
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if dataclasses.is_dataclass(value):
            yield from values(value)
        else:
            yield value


FORMER = {
    "algorithm": {"name": "qmix", "mixer": "vdn", "mixer_width": 32, "epsilon_steps": 9, "learning_rate": 0.5},
    "env": {"name": "spread", "num_agents": 4},
    "curriculum": {"local_ratio_end": 0.1, "num_agents_start": None, "episodes": 7, "gate": None},
    "preset": "vdn",
}
"""As version 0.1.0 wrote settings."""


def test_settings_of_version_0_1_0_load_under_their_names_of_today():
    config = from_dict(FORMER)
    assert (config.algorithm.name, config.algorithm.exploration_steps, config.algorithm.learning_rate) == (
        "vdn",
        9,
        0.5,
    )
    assert config.env == SpreadSettings(num_agents=4, local_ratio_end=0.1)
    assert config.curriculum == CurriculumConfig(episodes=7)
    yoked = {"algorithm": {"name": "gacrl", "yoked_coverage": [0.5], "coverage_radius": "0.2"}}
    assert from_dict(yoked).algorithm.yoked_progress == (0.5,)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            {"curriculum": {"local_ratio_end": 0.1, "gate": 0.5}},
            "curriculum.gate of gacrl 0.1.0 followed the coverage",
        ),
        ({"algorithm": {"name": "gacrl", "coverage_radius": "0.1"}}, "was a setting of gacrl 0.1.0"),
    ],
)
def test_what_no_later_version_does_is_refused_with_the_version_that_did(change: Any, said: str):
    with pytest.raises(ConfigError, match=said):
        from_dict(change)


@dataclasses.dataclass(frozen=True)
class MarketSettings:
    stalls: int = 3
    prices: tuple[float, ...] = (1.0,)


def test_settings_of_a_task_from_outside_load_once_it_is_at_hand(monkeypatch: pytest.MonkeyPatch):
    """A preset's task settings apply to its own task alone; a file that names a task needs it."""
    data = {"env": {"name": "Market", "stalls": 5}, "preset": "paper"}
    with pytest.raises(ConfigError, match="unknown task 'Market': .*a task of your own is --env FILE.py:NAME"):
        from_dict(data)
    monkeypatch.setattr(tasks, "_OWN", {})
    tasks.bring(tasks.Own(Task("Market", MarketSettings, lambda settings: None), MarketSettings()))
    config = from_dict(data)
    assert (config.task, config.env) == ("Market", MarketSettings(stalls=5))
    assert config.algorithm == PAPER.algorithm
    assert from_dict(json.loads(dumps(config))) == config
    assert on_task(PAPER, "Market").env == MarketSettings() and on_task(PAPER, "spread") is PAPER
    with pytest.raises(ConfigError, match="unknown setting 'env.stals': did you mean 'env.stalls'"):
        from_dict({"env": {"name": "Market", "stals": 5}})
    with pytest.raises(ConfigError, match="there is a task 'spread' already"):
        tasks.bring(tasks.Own(Task("spread", MarketSettings, lambda settings: None), MarketSettings()))


def test_memory_is_there_where_the_task_needs_it_and_a_file_may_say_otherwise(from_outside: None):
    task = Task("later", SpreadSettings, lambda settings: settings, needs_memory=True)
    tasks.bring(tasks.Own(task, SpreadSettings()))
    assert on_task(preset("ippo"), "later").algorithm.network.recurrent  # pyright: ignore[reportAttributeAccessIssue]
    assert not on_task(preset("ippo"), "reference").algorithm.network.recurrent  # pyright: ignore[reportAttributeAccessIssue]
    assert on_task(preset("paper"), "later").algorithm == preset("paper").algorithm, "it has a network of its own"
    written = {"env": {"name": "later"}, "algorithm": {"network": {"recurrent": False}}}
    assert not from_dict(written, preset("ippo")).algorithm.network.recurrent  # pyright: ignore[reportAttributeAccessIssue]


def test_gacrl_has_a_told_critic_where_something_must_be_said_and_a_file_may_say_otherwise():
    def critic(config: RunConfig) -> str:
        return config.algorithm.critic  # pyright: ignore[reportAttributeAccessIssue]

    assert critic(preset("gacrl")) == "central"
    assert {critic(on_task(preset("gacrl"), name)) for name in ("reference", "scouts", "traffic_junction")} == {
        "told"
    }
    assert critic(from_dict({"env": {"name": "colours"}, "algorithm": {"critic": "sum"}})) == "sum"
    assert on_task(preset("qmix"), "reference").algorithm == preset("qmix").algorithm
    assert from_dict({"preset": "gacrl-talk", "env": {"name": "colours"}}) == on_task(preset("gacrl"), "colours")


def test_a_run_without_a_setting_that_came_later_plays_as_it_was_trained(tmp_path: Path):
    """A preset that has it since says nothing of that run; a file of settings is completed from its preset."""
    written = to_dict(preset("gacrl"))
    del written["algorithm"]["network"]["seen_slope"]
    (tmp_path / "config.json").write_text(json.dumps(written), encoding="utf-8")
    slopes = [config.algorithm.network.seen_slope for config in (RunFolder(tmp_path).config(), from_dict(written))]  # pyright: ignore
    assert slopes == [0.0, 0.1]
