"""QMIX's promise: what is better for one agent is never worse for the team."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from conftest import drawn
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from gacrl.networks.mixer import MonotonicMixer

N, S = 3, 4
numbers = st.floats(-50, 50, width=32)


@eqx.filter_jit
def q_tot(seed_network, values, state, mask):
    return seed_network(values, state, mask)


MIXERS = [drawn(MonotonicMixer, N, S, 5, seed=seed) for seed in range(3)]


@settings(deadline=None, max_examples=100)
@given(
    st.sampled_from(MIXERS),
    hnp.arrays(np.float32, N, elements=numbers),
    hnp.arrays(np.float32, S, elements=st.floats(-1e4, 1e4, width=32)),
    hnp.arrays(bool, N),
    hnp.arrays(np.float32, N, elements=st.floats(0, 20, width=32)),
)
def test_the_teams_value_rises_with_each_agents(mixer, values, state, mask, rise):
    before = q_tot(mixer, values, state, mask)
    assert np.isfinite(before)
    slack = 1e-5 * (1 + abs(float(before)))
    for agent in range(N):
        higher = values + rise * np.eye(N, dtype=np.float32)[agent]
        after = q_tot(mixer, higher, state, mask)
        assert after == before if not mask[agent] else after >= before - slack


def test_each_real_agent_counts_and_padding_does_not():
    values, state = jnp.array([0.5, -1.0, 2.0]), jnp.array([0.3, -2.0, 0.0, 1.0])
    slope = jax.grad(q_tot, argnums=1)
    for mixer in MIXERS:
        mask = jnp.array([True, False, True])
        steep = slope(mixer, values, state, mask)
        assert (steep[mask] > 1e-3).all() and steep[1] == 0
        padded = q_tot(mixer, values.at[1].set(jnp.nan), state, mask)
        np.testing.assert_array_equal(padded, q_tot(mixer, values, state, mask))


def test_it_is_the_printed_formula():
    """Q_tot = elu(Qᵀ |W₁ s + …| + b₁(s)) · |w₂(s)| + b₂(s), in NumPy, on s squashed by sign(s) log(1 + |s|)."""
    mixer, values, raw = MIXERS[0], np.array([0.5, -1.0, 2.0]), np.array([0.3, -2.0, 0.0, 1.0])
    state = np.sign(raw) * np.log1p(np.abs(raw))
    affine = lambda layer, x: np.asarray(layer.weight, float) @ x + np.asarray(layer.bias, float)  # noqa: E731
    inner = values @ np.abs(affine(mixer.weights, state)).reshape(N, -1) + affine(mixer.bias, state)
    inner = np.where(inner > 0, inner, np.expm1(inner))
    bias = affine(mixer.out_bias_head, np.maximum(affine(mixer.out_bias.layers[0], state), 0))[0]
    expected = inner @ np.abs(affine(mixer.out_weights, state)) + bias
    found = q_tot(mixer, jnp.asarray(values, jnp.float32), jnp.asarray(raw, jnp.float32), jnp.ones(N, bool))
    np.testing.assert_allclose(found, expected, rtol=1e-5)
