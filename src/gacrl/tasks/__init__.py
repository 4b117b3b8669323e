"""Tasks: `spread` and the probes, the scripted policies, and what every task must be."""

import dataclasses

from gacrl.config.run import EnvConfig
from gacrl.tasks.spread.environment import Spread, SpreadParams


def make(config: EnvConfig) -> Spread:
    """The task that the configuration names."""
    structure = {field.name for field in dataclasses.fields(Spread)} & {f.name for f in dataclasses.fields(config)}
    return Spread(
        **{name: getattr(config, name) for name in structure - {"num_landmarks"}},
        num_landmarks=config.landmarks,
        initial_params=SpreadParams(
            local_ratio=config.local_ratio,
            coverage_threshold=config.coverage_threshold,
            coverage_bonus=config.coverage_bonus,
            arena_scale=config.arena_scale,
            landmark_speed=config.landmark_speed,
            reset_distance=config.reset_distance,
        ),
    )
