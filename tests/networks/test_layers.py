"""First numbers of layers: what they are, and that a network takes them from one draw."""

import re

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array

import gacrl
from gacrl.config import files as configuration
from gacrl.networks.layers import Linear, Mlp, Score, redrawn
from gacrl.training.build import make_algorithm


class Net(eqx.Module):
    uniform: Mlp
    orthogonal: tuple[Linear, ...]
    score: Score
    own: Array

    def __init__(self, key: Array):
        self.uniform = Mlp(40, (30, 20), key)
        self.orthogonal = (Linear(8, 5, key, 2.0), Linear(5, 8, key, 0.5))
        self.score, self.own = Score(64, key), jax.random.normal(key, (3,))


@pytest.fixture(scope="module")
def nets() -> list[Net]:
    """As its layers make it, and with numbers from one draw."""
    made, key = eqx.filter_jit(Net)(jax.random.key(0)), jax.random.key(1)
    return [made, eqx.filter_jit(redrawn)(made, key)]


def test_weights_without_a_gain_are_uniform_within_the_root_of_the_inputs(nets: list[Net]) -> None:
    for net in nets:
        for layer in net.uniform.layers:
            limit = layer.weight.shape[1] ** -0.5
            for numbers in (layer.weight, layer.bias):
                assert np.abs(numbers).max() < limit
            share = np.sort(np.ravel(layer.weight)) / limit / 2 + 0.5
            even = (np.arange(share.size) + 0.5) / share.size
            assert (
                np.abs(share - even).max() < 1.63 / share.size**0.5
            )  # Kolmogorov and Smirnov's, one in a hundred
        assert np.abs(net.score.weight).max() < 64**-0.5


def test_weights_with_a_gain_are_orthogonal_and_biases_zero(nets: list[Net]) -> None:
    for net in nets:
        wide, tall = net.orthogonal
        np.testing.assert_allclose(wide.weight @ wide.weight.T, 4.0 * np.eye(5), atol=1e-5)
        np.testing.assert_allclose(tall.weight.T @ tall.weight, 0.25 * np.eye(5), atol=1e-5)
        assert not np.any(wide.bias) and not np.any(tall.bias)


def test_layers_share_no_number_and_what_is_no_layer_stays(nets: list[Net]) -> None:
    made, anew = nets
    first, second = (np.ravel(layer.weight) * layer.weight.shape[1] ** 0.5 for layer in anew.uniform.layers)
    assert len(set(np.round(np.concatenate([first, second, anew.score.weight[0] * 8]), 6))) > 1850
    assert not np.any(made.uniform.layers[0].weight == anew.uniform.layers[0].weight)
    np.testing.assert_array_equal(made.own, anew.own)


def test_a_network_without_layers_stays() -> None:
    class Bare(eqx.Module):
        own: Array

    assert redrawn(Bare(jnp.ones(2)), jax.random.key(0)).own.tolist() == [1.0, 1.0]


@pytest.mark.parametrize(
    ("name", "task"),
    [("gacrl", "spread"), ("gacrl", "reference"), ("mappo", "spread"), ("qmix", "spread"), ("paper", "spread")],
)
def test_a_learner_begins_with_one_draw(name: str, task: str) -> None:
    """A draw is a loop to compile: it does not grow with the layers."""
    algorithm = make_algorithm(configuration.on_task(gacrl.preset(name), task))
    made = jax.jit(algorithm.init).lower(jax.random.key(0), algorithm.hyper).as_text()
    assert len(re.findall(r"call @_uniform", made)) == 1
    assert len(re.findall(r"call @_threefry_split|call @_normal|call @_gumbel", made)) == 0
