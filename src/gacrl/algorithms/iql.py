"""IQL (Tan 1993): each agent learns its value by itself. The learner is in `q_learning`."""

from jaxtyping import Array, Float, Int

from gacrl.algorithms import q_learning
from gacrl.algorithms.contract import Algorithm
from gacrl.algorithms.q_learner import Network, Parts
from gacrl.algorithms.shared import taken
from gacrl.config.algorithms import IqlConfig
from gacrl.config.run import TrainingConfig
from gacrl.envs.environment import Environment
from gacrl.networks.agent import AgentOutput
from gacrl.types import Observation


def independent(
    network: Network, output: AgentOutput, action: Int[Array, " N"], observation: Observation
) -> Float[Array, " N"]:
    """Return Q_i of each agent's own action."""
    return taken(output.head, action)


def make(config: IqlConfig, env: Environment, training: TrainingConfig, progress: str | None = None) -> Algorithm:
    """Make Q-learning of each agent's value."""
    parts = Parts(q_learning.agents_alone(config, env), independent, own_values=True)
    return q_learning.make(config, env, training, progress, parts)
