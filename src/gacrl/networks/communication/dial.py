"""DIAL: messages that are noisy units while learning and bits when played, heard a step later."""

from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from gacrl.config.algorithms import NetworkConfig
from gacrl.envs.environment import Environment
from gacrl.networks.arrives import arriving
from gacrl.networks.communication.base import Communication, Neighbourhood, Spoken, neighbour_mean
from gacrl.networks.layers import Linear
from gacrl.types import PRNGKey


class Dial(Communication):
    """Messages of V numbers that are noisy sigmoids while learning and bits when not (Foerster et al. 2016).

    What is said at a step is heard at the next one, and gradients flow back through it from hearer to speaker.
    """

    heard_late: ClassVar[bool] = True
    bits_of_number: ClassVar[float] = 1.0

    encode: Linear
    decode: Linear
    noise: float = eqx.field(static=True)

    def __init__(self, env: Environment, config: NetworkConfig, key: PRNGKey, gain: float | None = None):
        encode_key, decode_key = jax.random.split(key)
        self.encode = Linear(config.width, config.vocabulary, encode_key, gain)
        self.decode = Linear(config.vocabulary, config.width, decode_key, gain)
        self.noise = config.dial_noise

    def empty_inbox(self, num_agents: int) -> Any:
        return jnp.zeros((num_agents, self.encode.bias.shape[0]))

    def hear(self, hidden: Array, inbox: Any, near: Neighbourhood, key: PRNGKey | None) -> Array:
        heard = neighbour_mean(near.hear(inbox), near.adjacency)
        return hidden + jax.nn.relu(self.decode(heard))

    def speak(
        self,
        hidden: Float[Array, "N H"],
        near: Neighbourhood,
        key: PRNGKey | None,
        temperature: Float[Array, ""] | float,
        code: Float[Array, "N Z"] | None = None,
    ) -> Spoken:
        message = discretise_regularise(self.encode(hidden), key, self.noise)
        return Spoken(hidden, message[None], arriving(message, near.arrives))


def discretise_regularise(message: Float[Array, "N V"], key: PRNGKey | None, noise: float) -> Float[Array, "N V"]:
    """Apply DIAL's DRU: σ(m + noise · N(0, 1)) while learning (with a key), 1{m > 0} when not."""
    if key is None:
        return (message > 0).astype(message.dtype)
    return jax.nn.sigmoid(message + noise * jax.random.normal(key, message.shape))
