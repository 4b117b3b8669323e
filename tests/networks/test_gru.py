"""The recurrent unit beside Equinox's, and along a window beside step by step."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gacrl.networks.gru import Gru

X = jax.random.normal(jax.random.key(0), (6, 3, 8))
MEMORY = jax.random.normal(jax.random.key(1), (3, 8))
GRU = Gru(8, jax.random.key(2))


def test_a_step_is_that_of_equinox():
    cell = eqx.nn.GRUCell(8, 8, key=jax.random.key(3))
    both = [(into.bias, again.bias) for into, again in zip(GRU.incoming, GRU.recurrent, strict=True)]
    ours = (
        jnp.concatenate([linear.weight for linear in GRU.incoming]),
        jnp.concatenate([linear.weight for linear in GRU.recurrent]),
        jnp.concatenate([both[0][0] + both[0][1], both[1][0] + both[1][1], both[2][0]]),
        both[2][1],
    )
    theirs = eqx.tree_at(lambda cell: (cell.weight_ih, cell.weight_hh, cell.bias, cell.bias_n), cell, ours)
    np.testing.assert_allclose(GRU(X[0], MEMORY), jax.vmap(theirs)(X[0], MEMORY), atol=1e-6)


def test_unrolled_it_is_step_by_step_and_forgets_where_an_episode_begins():
    first = jnp.array([False, False, True, False, True, False])
    memory, after, step = MEMORY, [], eqx.filter_jit(GRU)
    for x, begins in zip(X, first, strict=True):
        memory = step(x, GRU.empty(3) if begins else memory)
        after.append(memory)
    np.testing.assert_allclose(GRU.unroll(X, first, MEMORY), jnp.stack(after), atol=1e-6)


@pytest.mark.parametrize("agents", [False, True])
def test_the_written_out_derivative_is_that_of_the_steps(agents):
    """By JAX through a plain loop, for several environments, and where single agents begin anew."""
    keys = jax.random.split(jax.random.key(4), 4)
    x, weight = jax.random.normal(keys[0], (5, 2, 3, 8)), jax.random.normal(keys[1], (5, 2, 3, 8))
    memory = jax.random.normal(keys[2], (2, 3, 8))
    first = jax.random.bernoulli(keys[3], 0.3, (5, 2, 3) if agents else (5, 2))

    def plain(gru, x, memory):
        after = []
        for at, begins in zip(x, first.reshape(*first.shape, *[1] * (4 - first.ndim)), strict=True):
            memory = jax.vmap(gru)(at, jnp.where(begins, 0.0, memory))
            after.append(memory)
        return (jnp.stack(after) * weight).sum()

    def unrolled(gru, x, memory):
        return (gru.unroll(x, first, memory) * weight).sum()

    expected = jax.jit(jax.grad(plain, (0, 1, 2)))(GRU, x, memory)
    found = jax.jit(jax.grad(unrolled, (0, 1, 2)))(GRU, x, memory)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=2e-5), found, expected)
