"""MAPPO (Yu et al. 2022): PPO whose critic sees the global state; the agents act on what they see themselves."""

from gacrl.algorithm_config import MappoConfig
from gacrl.algorithms import ppo
from gacrl.algorithms.algorithm import Algorithm
from gacrl.config import TrainingConfig
from gacrl.envs.environment import Environment


def make(config: MappoConfig, env: Environment, training: TrainingConfig) -> Algorithm:
    """PPO with a central critic."""
    return ppo.make(config, env, training, view="central")
