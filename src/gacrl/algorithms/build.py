"""From an algorithm's settings to its functions."""

from gacrl.algorithms.contract import Algorithm
from gacrl.config.algorithms import ALGORITHMS, AlgorithmConfig
from gacrl.config.kinds import resolve
from gacrl.config.run import TrainingConfig
from gacrl.envs.environment import Environment


def make(
    config: AlgorithmConfig, env: Environment, training: TrainingConfig, progress: str | None = None
) -> Algorithm:
    """Build the algorithm that the configuration names, for the shapes of this task.

    training: its planned length is what schedules run over; how experience is gathered shapes a replay. progress: the
    task's measure that exploration may follow.
    """
    return resolve(ALGORITHMS[config.name].make)(config, env, training, progress)
