"""From an algorithm's settings to its functions."""

from collections.abc import Callable
from typing import Any

from gacrl.algorithms import gacrl, gacrl_paper, ippo, mappo, qmix
from gacrl.algorithms.contract import Algorithm
from gacrl.config.algorithms import (
    AlgorithmConfig,
    GacrlConfig,
    GacrlPaperConfig,
    IppoConfig,
    MappoConfig,
    QmixConfig,
)
from gacrl.config.run import TrainingConfig
from gacrl.envs.environment import Environment


def make(config: AlgorithmConfig, env: Environment, training: TrainingConfig) -> Algorithm:
    """Build the algorithm that the configuration names, for the shapes of this task.

    training: its planned length is what schedules run over; how experience is gathered shapes a replay.
    """
    builders: dict[type[AlgorithmConfig], Callable[[Any, Environment, TrainingConfig], Algorithm]] = {
        GacrlPaperConfig: gacrl_paper.make,
        GacrlConfig: gacrl.make,
        MappoConfig: mappo.make,
        IppoConfig: ippo.make,
        QmixConfig: qmix.make,
    }
    return builders[type(config)](config, env, training)
