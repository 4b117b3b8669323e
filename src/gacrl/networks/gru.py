"""The gated recurrent unit, for one step and along many."""

from typing import Any, NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from gacrl.networks.layers import Linear
from gacrl.types import PRNGKey

Gates: TypeAlias = tuple[Float[Array, "*b H"], Float[Array, "*b H"], Float[Array, "*b H"]]
Recurrent: TypeAlias = tuple[Linear, Linear, Linear]


class Gru(eqx.Module):
    """Cho et al. 2014, with the reset gate after the product, as torch and cuDNN have it.

    Each gate has products of its own: the pieces of one large product are slow to read (a step takes twice the time).
    """

    incoming: tuple[Linear, Linear, Linear]
    """Of the input: for the reset gate, the update gate and the candidate."""
    recurrent: Recurrent
    """Of the memory, for the same."""

    def __init__(self, width: int, key: PRNGKey):
        a, b, c, d, e, f = (Linear(width, width, key) for key in jax.random.split(key, 6))
        self.incoming, self.recurrent = (a, b, c), (d, e, f)

    def empty(self, num_agents: int) -> Float[Array, "N H"]:
        """Make the memory of agents that remember nothing yet."""
        return jnp.zeros((num_agents, self.recurrent[0].bias.size))

    def __call__(self, x: Float[Array, "N H"], memory: Float[Array, "N H"]) -> Float[Array, "N H"]:
        """The memory after a step, which is also the output."""
        return _advance(self.recurrent, self._gates(x), memory)

    def unroll(
        self, x: Float[Array, "T *b N H"], first: Bool[Array, "T ..."], memory: Float[Array, "*b N H"]
    ) -> Float[Array, "T *b N H"]:
        """Return the memory after each step; before one that is `first` [T, *b], or [T, *b, N] for each agent, it is
        empty.

        The inputs' products, which wait for nothing, are computed for all steps at once.
        """
        begins = first.reshape(*first.shape, *[1] * (x.ndim - first.ndim))
        return _unroll(self.recurrent, self._gates(x), begins, memory)

    def _gates(self, x: Float[Array, "*b H"]) -> Gates:
        reset, update, new = self.incoming
        return reset(x), update(x), new(x)


class Step(NamedTuple):
    """What a step computes on the way."""

    reset: Float[Array, "*b H"]
    update: Float[Array, "*b H"]
    new: Float[Array, "*b H"]
    """The product that the reset gate lets pass."""
    candidate: Float[Array, "*b H"]


def _look(recurrent: Recurrent, gates: Gates, memory: Float[Array, "*b H"]) -> Step:
    reset_in, update_in, new_in = gates
    reset, update, new = (linear(memory) for linear in recurrent)
    reset = jax.nn.sigmoid(reset_in + reset)
    return Step(reset, jax.nn.sigmoid(update_in + update), new, jnp.tanh(new_in + reset * new))


def _advance(recurrent: Recurrent, gates: Gates, memory: Float[Array, "*b H"]) -> Float[Array, "*b H"]:
    step = _look(recurrent, gates, memory)
    return step.candidate + step.update * (memory - step.candidate)


@jax.custom_vjp
def _unroll(
    recurrent: Recurrent, gates: Gates, begins: Bool[Array, "T ..."], memory: Float[Array, "*e H"]
) -> Float[Array, "T *e H"]:
    """Return the memory after each step; where one begins, before it is empty.

    Its derivative is written out below: in the loop backwards is only what waits for the step after. Derived by JAX it
    keeps thirteen arrays of a number for each step, and adds up the weights' gradients step by step.
    """

    def step(memory: Array, inputs: tuple[Gates, Array]) -> tuple[Array, Array]:
        gates, begins = inputs
        memory = _advance(recurrent, gates, jnp.where(begins, 0.0, memory))
        return memory, memory

    return jax.lax.scan(step, memory, (gates, begins))[1]


def _unroll_keeping(recurrent: Recurrent, gates: Gates, begins: Array, memory: Array) -> tuple[Array, Any]:
    after = _unroll(recurrent, gates, begins, memory)
    return after, (recurrent, gates, begins, memory, after)


def _unroll_back(kept: Any, gradient: Array) -> tuple[Recurrent, Gates, None, Array]:
    """Return the gradients of the weights, the gates and the first memory from that of the memories."""
    recurrent, gates, begins, memory, after = kept
    before = jnp.where(begins, 0.0, jnp.concatenate([memory[None], after[:-1]]))
    step = _look(recurrent, gates, before)
    # By how much each sum inside a gate moves with the memory after the step; that of `reset` with the candidate's.
    by_candidate = (1.0 - step.update) * (1.0 - jnp.square(step.candidate))
    by_update = (before - step.candidate) * step.update * (1.0 - step.update)
    by_reset = step.new * step.reset * (1.0 - step.reset)

    def back(later: Array, now: tuple[Array, ...]) -> tuple[Array, Gates]:
        gradient, begins, update, reset, by_candidate, by_update, by_reset = now
        whole = gradient + later
        candidate = whole * by_candidate
        sums = candidate * by_reset, whole * by_update, candidate
        through = sums[0], sums[1], candidate * reset
        earlier = whole * update + sum(s @ linear.weight for s, linear in zip(through, recurrent, strict=True))
        return jnp.where(begins, 0.0, earlier), sums

    inputs = (gradient, begins, step.update, step.reset, by_candidate, by_update, by_reset)
    first, sums = jax.lax.scan(back, jnp.zeros_like(memory), inputs, reverse=True)
    through, rows = (sums[0], sums[1], sums[2] * step.reset), tuple(range(before.ndim - 1))

    def gradients(linear: Linear, through: Array) -> Linear:
        weight = jnp.tensordot(through, before, axes=(rows, rows))
        return eqx.tree_at(lambda it: (it.weight, it.bias), linear, (weight, through.sum(rows)))

    reset, update, new = (gradients(linear, s) for linear, s in zip(recurrent, through, strict=True))
    return (reset, update, new), sums, None, first


_unroll.defvjp(_unroll_keeping, _unroll_back)
