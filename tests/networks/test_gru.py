"""The recurrent unit beside Equinox's, and along a window beside step by step."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

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
