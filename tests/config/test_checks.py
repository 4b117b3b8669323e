"""Numbers of any kind: NumPy's and JAX's are Python's own after the check, and a wrong type is named as such."""

import json
from dataclasses import replace
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np
import pytest

from gacrl.config.algorithms import GacrlPaperConfig, LearningConfig, NetworkConfig
from gacrl.config.checks import typed, whole
from gacrl.config.files import dumps, fingerprint, from_dict
from gacrl.config.presets import preset
from gacrl.config.run import RunConfig, TrainingConfig
from gacrl.errors import ConfigError
from gacrl.tasks.spread.settings import SpreadSettings

pytestmark = pytest.mark.usefixtures("unchecked")


@pytest.mark.parametrize(
    "four", [np.int64(4), np.uint8(4), np.array(4), jnp.asarray(4)], ids=lambda it: type(it).__name__
)
def test_integers_of_other_libraries_are_whole_numbers(four: Any):
    assert whole(four, "seeds") == 4 and type(whole(four, "seeds")) is int
    plain = replace(
        preset("ippo"), seed=4, num_seeds=4, training=TrainingConfig(4, 4, 4), env=SpreadSettings(num_agents=4)
    )
    found = replace(
        plain,
        seed=four,
        num_seeds=four,
        training=TrainingConfig(four, four, four),
        env=SpreadSettings(num_agents=four),
    )
    assert found == plain and dumps(found) == dumps(plain), "a run folder can hold it"
    assert from_dict({"seed": four, "env": {"num_agents": four}}, plain) == plain


def test_every_number_of_numpy_becomes_one_of_python():
    found = GacrlPaperConfig(
        radius=np.float32(0.5),
        epsilon=np.int64(0),
        encoder_hidden=np.array([64, 32]),  # pyright: ignore[reportArgumentType]
    )
    assert found == GacrlPaperConfig(radius=0.5, epsilon=0.0, encoder_hidden=(64, 32))
    assert [type(size) for size in found.encoder_hidden] == [int, int]
    assert (type(found.radius), type(found.epsilon)) == (float, float)
    assert SpreadSettings(terminate_on_success=np.bool_(True)).terminate_on_success is True
    assert (
        NetworkConfig(parameters=np.int64(9)).parameters == 9 and NetworkConfig(parameters=None).parameters is None
    )


def test_a_whole_number_for_a_fraction_makes_the_same_run():
    """What Python holds and what a file would give back have one fingerprint."""
    whole_gamma = replace(preset("ippo"), algorithm=replace(preset("ippo").algorithm, gamma=1))
    assert fingerprint(whole_gamma) == fingerprint(from_dict(json.loads(dumps(whole_gamma))))


@pytest.mark.parametrize(
    ("value", "told"),
    [
        ("4", "the string '4'"),
        (4.0, "4.0"),
        (np.float64(4), "4.0"),
        (True, "True"),
        (np.bool_(True), "True"),
        (None, "None"),
        (np.array([4]), "[4]"),
    ],
)
def test_what_is_no_whole_number_is_named_as_such(value: Any, told: str):
    with pytest.raises(ConfigError) as refused:
        replace(preset("ippo"), seed=value)
    assert str(refused.value) == f"run.seed must be a whole number, not {told}"
    with pytest.raises(ConfigError) as refused:
        TrainingConfig(num_envs=value)
    assert str(refused.value) == f"training.num_envs must be a whole number, not {told}"
    with pytest.raises(ConfigError) as refused:
        whole(value, "episodes")
    assert str(refused.value) == f"episodes must be a whole number, not {told}"


@pytest.mark.parametrize(
    ("made", "said"),
    [
        (lambda: LearningConfig(gamma="0.9"), "algorithm.gamma must be a number, not the string '0.9'"),  # pyright: ignore[reportArgumentType]
        (
            lambda: SpreadSettings(reward="mpe"),
            "env.reward must be one of mpe2, paper, coverage, potential, not the",
        ),  # pyright: ignore[reportArgumentType]
        (lambda: SpreadSettings(terminate_on_success=1), "env.terminate_on_success must be true or false, not 1"),  # pyright: ignore[reportArgumentType]
        (lambda: RunConfig(training=4), "run.training must be of the class TrainingConfig, not 4"),  # pyright: ignore[reportArgumentType]
        (lambda: whole(0, "episodes", 1), "episodes must be at least 1, not 0"),
        (lambda: typed("x" * 999, Literal["a"], "kind"), "kind must be one of a, not the string 'xxx"),
    ],
)
def test_other_types_are_named_as_such(made: Any, said: str):
    with pytest.raises(ConfigError) as refused:
        made()
    assert str(refused.value).startswith(said) and len(str(refused.value)) < 120
