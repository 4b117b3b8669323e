"""The settings and metrics of `traffic_junction`. A leaf: it imports no jax."""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal, NamedTuple, TypeAlias

from gacrl.config.checks import between, require, take_types, unknown
from gacrl.tasks.task import Metric

LevelName: TypeAlias = Literal["easy", "medium", "hard"]


class Level(NamedTuple):
    """The numbers of a level, as CommNet and IC3Net have them."""

    grid: int
    """Cells along each side."""
    cars: int
    """Slots: no more cars are on the roads at once."""
    arrival: float
    """Probability that a car arrives at an entry in a step."""
    steps: int
    """Steps of an episode."""


LEVELS: Mapping[str, Level] = MappingProxyType(
    {"easy": Level(7, 5, 0.3, 20), "medium": Level(14, 10, 0.2, 40), "hard": Level(18, 20, 0.05, 80)}
)


@dataclass(frozen=True)
class TrafficSettings:
    """Cars must cross junctions without a crash: IC3Net's Traffic Junction."""

    level: LevelName = "easy"
    """Two one-way roads and 5 cars, one junction of two-way roads and 10 cars, or four of them and 20 cars."""
    vision: int = 0
    """Cars count the cars in the square of cells up to this far away; 0: in their own cell."""
    max_cycles: int | None = None
    """Steps of an episode; none: those of the level, 20, 40 or 80."""
    arrival_start: float | None = None
    """Probability of an arrival at the start of the curriculum, which ends at that of the level, 0.3, 0.2 or 0.05;
    none: constant."""

    def __post_init__(self) -> None:
        take_types("env", self)
        require(self.level in LEVELS, unknown("env.level", self.level, LEVELS))
        between("env", self, 0, LEVELS[self.level].grid - 1, "vision")
        between("env", self, 1, 1_000_000, "max_cycles")
        between("env", self, 0.0, 1.0, "arrival_start")

    @property
    def steps(self) -> int:
        """Steps of an episode."""
        return LEVELS[self.level].steps if self.max_cycles is None else self.max_cycles


COMPARABLE = ("level",)
"""Settings that make another task. Vision does not: who sees more is compared with who hears more."""

METRICS: Mapping[str, Metric] = MappingProxyType(
    {
        "success": Metric("success", "last", label="success"),
        # IC3Net's reward, the mean over all slots: summed, and per step.
        "return_agent_mean": Metric("reward_raw", "sum", label="return"),
        "reward_raw": Metric("reward_raw", "mean"),
        # Each car counts in every step that it spends in a cell with another one, as it is punished.
        "crashes": Metric("crashes", "sum", "car steps", False, "crashes"),
    }
)
