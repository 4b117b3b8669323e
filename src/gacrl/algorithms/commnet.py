"""CommNet (Sukhbaatar et al. 2016): agents that average each other's hidden states, trained by PPO as IPPO is.

The messages are in `networks.communication.commnet`.
"""

from gacrl.algorithms import ppo
from gacrl.algorithms.contract import Algorithm
from gacrl.config.algorithms import CommnetConfig
from gacrl.config.run import TrainingConfig
from gacrl.envs.environment import Environment


def make(
    config: CommnetConfig, env: Environment, training: TrainingConfig, progress: str | None = None
) -> Algorithm:
    """Make PPO with a critic for each agent, through messages."""
    return ppo.make(config, env, training, progress, view="local")
