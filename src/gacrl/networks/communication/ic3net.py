"""IC3Net: CommNet whose agents decide whether to speak."""

import jax
from jaxtyping import Array, Float

from gacrl.config.algorithms import NetworkConfig
from gacrl.envs.environment import Environment
from gacrl.networks.communication.base import Communication, Neighbourhood, Spoken
from gacrl.networks.communication.commnet import averaging_rounds
from gacrl.networks.layers import Linear
from gacrl.networks.messages import gumbel_sigmoid
from gacrl.types import PRNGKey


class Ic3net(Communication):
    """h ← tanh(H h + C mean of the neighbours' g h), where each agent's gate g is 0 or 1 (Singh et al. 2019).

    As in the paper the mean is over all neighbours, those that are silent included. An agent decides once in a step,
    for all its rounds. The paper learns the gate by REINFORCE, as an action of its own. Here it is a straight-through
    Gumbel-sigmoid: 0 or 1 when heard, with the gradient of the soft one. So it is learned from whatever a learner
    minimises, and Q-learning, which has no policy gradient, can use it like PPO.
    """

    gate: Linear
    own: tuple[Linear, ...]
    heard: tuple[Linear, ...]

    def __init__(self, env: Environment, config: NetworkConfig, key: PRNGKey, gain: float | None = None):
        gate_key, own_key, heard_key = jax.random.split(key, 3)
        width, rounds = config.width, config.rounds
        self.gate = Linear(width, 1, gate_key, gain)
        self.own = tuple(Linear(width, width, k, gain) for k in jax.random.split(own_key, rounds))
        self.heard = tuple(Linear(width, width, k, gain) for k in jax.random.split(heard_key, rounds))

    def speak(
        self,
        hidden: Float[Array, "N H"],
        near: Neighbourhood,
        key: PRNGKey | None,
        temperature: Float[Array, ""] | float,
        code: Float[Array, "N Z"] | None = None,
    ) -> Spoken:
        logit = self.gate(hidden)
        noise = None if key is None else jax.random.logistic(key, logit.shape)
        return averaging_rounds(hidden, near, self.own, self.heard, gumbel_sigmoid(logit, noise, temperature))
