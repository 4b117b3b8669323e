"""VDN (Sunehag et al. 2018): the team's value is the sum of the agents' values. The learner is in `q_learning`."""

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from gacrl.algorithms import q_learning
from gacrl.algorithms.contract import Algorithm
from gacrl.algorithms.q_learner import Network, Parts
from gacrl.algorithms.shared import taken
from gacrl.config.algorithms import VdnConfig
from gacrl.config.run import TrainingConfig
from gacrl.envs.environment import Environment
from gacrl.networks.agent import AgentOutput
from gacrl.types import Observation


def summed(
    network: Network, output: AgentOutput, action: Int[Array, " N"], observation: Observation
) -> Float[Array, "1"]:
    """Return Q_tot = Σ_i Q_i over the real agents."""
    return jnp.where(observation.agent_mask, taken(output.head, action), 0.0).sum(keepdims=True)


def make(config: VdnConfig, env: Environment, training: TrainingConfig, progress: str | None = None) -> Algorithm:
    """Make Q-learning of the sum."""
    parts = Parts(q_learning.agents_alone(config, env), summed)
    return q_learning.make(config, env, training, progress, parts)
