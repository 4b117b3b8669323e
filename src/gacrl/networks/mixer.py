"""From the agents' values to the team's."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from gacrl.networks.layers import Linear, Mlp
from gacrl.types import PRNGKey


class MonotonicMixer(eqx.Module):
    """QMIX's mixing network (Rashid et al. 2018, section 4): monotonic in every agent's value.

    Hypernetworks over the state make its weights, and an absolute value keeps them from being negative.
    Agents that are not there get weight 0.
    """

    weights: Linear
    bias: Linear
    out_weights: Linear
    out_bias: Mlp
    out_bias_head: Linear
    num_agents: int = eqx.field(static=True)

    def __init__(self, num_agents: int, state_size: int, width: int, key: PRNGKey):
        keys = jax.random.split(key, 5)
        self.num_agents = num_agents
        self.weights = Linear(state_size, num_agents * width, keys[0])
        self.bias = Linear(state_size, width, keys[1])
        self.out_weights = Linear(state_size, width, keys[2])
        self.out_bias = Mlp(state_size, (width,), keys[3])
        self.out_bias_head = Linear(width, 1, keys[4])

    def __call__(
        self, values: Float[Array, " N"], state: Float[Array, " S"], agent_mask: Bool[Array, " N"]
    ) -> Float[Array, ""]:
        """Q_tot of one environment."""
        state = jnp.sign(state) * jnp.log1p(jnp.abs(state))  # agents far outside must not make weights explode
        weights = jnp.abs(self.weights(state)).reshape(self.num_agents, -1)
        weights = jnp.where(agent_mask[:, None], weights, 0.0)
        hidden = jax.nn.elu(jnp.where(agent_mask, values, 0.0) @ weights + self.bias(state))
        out_bias = self.out_bias_head(self.out_bias(state))[0]
        return hidden @ jnp.abs(self.out_weights(state)) + out_bias
