"""MAPPO (Yu et al. 2022): PPO whose critic sees the global state; the agents act on what they see themselves."""

from gacrl.algorithms import ppo
from gacrl.algorithms.contract import Algorithm
from gacrl.config.algorithms import MappoConfig
from gacrl.config.run import TrainingConfig
from gacrl.envs.environment import Environment


def make(
    config: MappoConfig, env: Environment, training: TrainingConfig, progress: str | None = None
) -> Algorithm:
    """Make PPO with a central critic."""
    return ppo.make(config, env, training, progress, view="central")
