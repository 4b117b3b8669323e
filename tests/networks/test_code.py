"""The code of an agent's vector: what acts on it, and what is reconstructed from it."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gacrl.config.algorithms import NetworkConfig
from gacrl.networks.encoder import Code, kl_divergence

CONFIG = NetworkConfig(width=6, latent="vae", latent_size=3)
HIDDEN = jax.random.normal(jax.random.key(1), (4, 6))


def mean_and_log_variance(code: Code) -> tuple[jax.Array, jax.Array]:
    return jnp.split(code.encode(HIDDEN), 2, axis=-1)


@pytest.mark.parametrize("use", ["sample", "mean"])
def test_played_it_is_the_mean_whatever_learning_uses(use: str):
    code = Code(replace(CONFIG, latent_use=use), jax.random.key(0))
    z, vector, _ = code(HIDDEN, None)
    mean, _ = mean_and_log_variance(code)
    np.testing.assert_allclose(z, mean, rtol=1e-6)
    np.testing.assert_allclose(vector, HIDDEN + jax.nn.relu(code.merge(mean)), rtol=1e-6)


def test_agents_that_use_the_mean_act_without_noise_while_the_sample_is_reconstructed():
    sampling = Code(CONFIG, jax.random.key(0))
    steady = Code(replace(CONFIG, latent_use="mean"), jax.random.key(0))
    key = jax.random.key(2)
    z, vector, loss = steady(HIDDEN, key)
    drawn, noisy, same_loss = sampling(HIDDEN, key)
    mean, log_variance = mean_and_log_variance(steady)
    np.testing.assert_allclose(z, mean, rtol=1e-6)
    np.testing.assert_allclose(vector, steady(HIDDEN, None)[1], rtol=1e-6)
    assert np.abs(drawn - mean).max() > 0.1 and np.abs(noisy - vector).max() > 0.01
    np.testing.assert_allclose(loss, same_loss, rtol=1e-6, err_msg="equation (20) is the same for both")
    np.testing.assert_allclose(
        loss - 0.5 * jnp.square(steady.decode(drawn) - HIDDEN).sum(-1),
        kl_divergence(mean, log_variance),
        rtol=1e-4,
    )
