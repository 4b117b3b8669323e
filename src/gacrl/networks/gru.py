"""The gated recurrent unit, for one step and along many."""

from typing import TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from gacrl.networks.layers import Linear
from gacrl.types import PRNGKey

Gates: TypeAlias = tuple[Float[Array, "*b H"], Float[Array, "*b H"], Float[Array, "*b H"]]


class Gru(eqx.Module):
    """Cho et al. 2014, with the reset gate after the product, as torch and cuDNN have it.

    Each gate has products of its own: the pieces of one large product are slow to read (a step takes twice the time).
    """

    incoming: tuple[Linear, Linear, Linear]
    """Of the input: for the reset gate, the update gate and the candidate."""
    recurrent: tuple[Linear, Linear, Linear]
    """Of the memory, for the same."""

    def __init__(self, width: int, key: PRNGKey):
        a, b, c, d, e, f = (Linear(width, width, key) for key in jax.random.split(key, 6))
        self.incoming, self.recurrent = (a, b, c), (d, e, f)

    def empty(self, num_agents: int) -> Float[Array, "N H"]:
        """The memory of agents that remember nothing yet."""
        return jnp.zeros((num_agents, self.recurrent[0].bias.size))

    def __call__(self, x: Float[Array, "N H"], memory: Float[Array, "N H"]) -> Float[Array, "N H"]:
        """The memory after a step, which is also the output."""
        return self._advance(self._gates(x), memory)

    def unroll(
        self, x: Float[Array, "T N H"], first: Bool[Array, "T ..."], memory: Float[Array, "N H"]
    ) -> Float[Array, "T N H"]:
        """The memory after each step; before one that is `first` [T], or [T, N] for each agent, it is empty.

        The inputs' products, which wait for nothing, are computed for all steps at once.
        """

        def step(memory: Array, inputs: tuple[Gates, Array]) -> tuple[Array, Array]:
            gates, first = inputs
            begins = first if first.ndim == 0 else first[:, None]
            memory = self._advance(gates, jnp.where(begins, 0.0, memory))
            return memory, memory

        return jax.lax.scan(step, memory, (self._gates(x), first))[1]

    def _gates(self, x: Float[Array, "*b H"]) -> Gates:
        reset, update, new = self.incoming
        return reset(x), update(x), new(x)

    def _advance(self, gates: Gates, memory: Float[Array, "N H"]) -> Float[Array, "N H"]:
        reset_in, update_in, new_in = gates
        reset, update, new = (linear(memory) for linear in self.recurrent)
        candidate = jnp.tanh(new_in + jax.nn.sigmoid(reset_in + reset) * new)
        return candidate + jax.nn.sigmoid(update_in + update) * (memory - candidate)
