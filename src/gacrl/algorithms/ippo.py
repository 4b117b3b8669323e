"""IPPO (de Witt et al. 2020): PPO whose critic sees no more than its agent does."""

from gacrl.algorithms import ppo
from gacrl.algorithms.contract import Algorithm
from gacrl.config.algorithms import IppoConfig
from gacrl.config.run import TrainingConfig
from gacrl.envs.environment import Environment


def make(config: IppoConfig, env: Environment, training: TrainingConfig, progress: str | None = None) -> Algorithm:
    """Make PPO with a critic for each agent."""
    return ppo.make(config, env, training, progress, view="local")
