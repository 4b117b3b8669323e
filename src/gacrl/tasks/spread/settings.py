"""The settings and metrics of `spread`. A leaf: it imports no jax."""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import ClassVar, Literal, TypeAlias

from gacrl.config.checks import between, require, take_types
from gacrl.tasks.task import Metric

RewardKind: TypeAlias = Literal["mpe2", "paper", "coverage", "potential"]
CollisionReset: TypeAlias = Literal["off", "truncate", "in_place"]
CollisionTerm: TypeAlias = Literal["per_agent", "once"]


@dataclass(frozen=True)
class SpreadSettings:
    """Agents must stand on landmarks without touching each other: MPE2's simple_spread_v3."""

    num_agents: int = 3
    """Agents."""
    num_landmarks: int | None = None
    """Landmarks; none: as many as agents."""
    max_cycles: int = 25
    """Steps of an episode."""
    local_ratio: float = 0.5
    """Weight of an agent's own collisions in its reward; the shared distance has the rest."""
    continuous_actions: bool = False
    """Five pushes in [0, 1] an agent, instead of one of five actions."""
    num_agent_neighbors: int | None = None
    """Agents see only this many nearest others; none: all."""
    num_landmark_neighbors: int | None = None
    """Agents see only this many nearest landmarks; none: all."""
    terminate_on_success: bool = False
    """End the episode when every landmark is covered."""
    arena_scale: float = 1.0
    """Starts are uniform in [-scale, scale] squared."""
    landmark_speed: float = 0.0
    """Speed of the landmarks, as a share of an agent's top speed."""
    coverage_threshold: float = 0.5
    """θ of the paper: its coverage bonus, and the coverage that its exploration follows."""
    reward: RewardKind = "mpe2"
    """What the learner earns: MPE2's reward, the paper's shaped one (equation 1), MPE2's and a bonus for every step in
    which a landmark is covered within 0.1, or MPE2's and the change of a potential, the distance left to walk in the
    best assignment, which leaves the optimal policy as it is. Metrics are always of MPE2's."""
    coverage_bonus: float = 1.0
    """Of reward coverage: what a step with every landmark covered adds."""
    collision_term: CollisionTerm = "per_agent"
    """Equation (1)'s collision term inside the sum over agents, or once."""
    collision_distance: float = 0.2
    """Equation (1)'s collision distance; the discs touch at 0.3."""
    reset_on_collision: CollisionReset = "off"
    """The paper's "resets if agents collide": never, as an episode's end, or new places mid-episode."""
    reset_distance: float = 0.2
    """Agents this close have collided, for reset_on_collision."""
    local_ratio_end: float | None = None
    """Local ratio at the end of the curriculum; none: constant."""
    coverage_threshold_end: float | None = None
    """θ at the end of the curriculum; none: constant."""
    arena_scale_start: float | None = None
    """Arena at the start of the curriculum, from which it changes to arena_scale; none: constant."""
    num_agents_start: int | None = None
    """Agents at the start of the curriculum; more join, and landmarks in proportion, until all are there."""

    FORMERLY: ClassVar[Mapping[str, str]] = MappingProxyType(
        {
            f"curriculum.{name}": f"env.{name}"
            for name in ("local_ratio_end", "coverage_threshold_end", "arena_scale_start", "num_agents_start")
        }
    )
    """Where files of version 0.1.0 have settings that are the task's."""

    def __post_init__(self) -> None:
        take_types("env", self)
        between("env", self, 1, 10_000, "num_agents", "num_landmarks", "num_agents_start")
        between("env", self, 1, 1_000_000, "max_cycles")
        between("env", self, 1, 10_000, "num_agent_neighbors", "num_landmark_neighbors")
        between("env", self, 0.0, 1.0, "local_ratio", "local_ratio_end")
        between("env", self, 0.001, 1000.0, "arena_scale", "arena_scale_start")
        between("env", self, 0.001, 1000.0, "coverage_threshold", "coverage_threshold_end")
        between("env", self, 0.0, 10.0, "landmark_speed", "collision_distance", "reset_distance")
        between("env", self, 0.0, 1000.0, "coverage_bonus")

    @property
    def landmarks(self) -> int:
        """How many landmarks there are."""
        return self.num_agents if self.num_landmarks is None else self.num_landmarks

    @property
    def resets_within(self) -> float | None:
        """The distance at which agents count as collided for a reset; None where there is none."""
        return None if self.reset_on_collision == "off" else self.reset_distance


@dataclass(frozen=True)
class ScoutsSettings(SpreadSettings):
    """The same, where some agents see no landmarks: the others must tell them where to go."""

    reward: RewardKind = "coverage"
    """What the learner earns; see `spread`. Metrics are always of MPE2's."""
    num_blind: int = 1
    """So many agents, the first ones, see no landmarks."""

    def __post_init__(self) -> None:
        super().__post_init__()
        between("env", self, 1, 10_000, "num_blind")
        require(
            self.num_blind < self.num_agents,
            f"env.num_blind must be below env.num_agents, {self.num_agents}, not {self.num_blind}: somebody must see",
        )

    @property
    def blind(self) -> tuple[bool, ...]:
        """Who sees no landmarks."""
        return tuple(agent < self.num_blind for agent in range(self.num_agents))


COMPARABLE = (
    *("num_agents", "landmarks", "arena_scale", "landmark_speed", "terminate_on_success"),
    *("reset_on_collision", "resets_within"),
)
"""What makes another task, in which every number means something else."""

_RADII = ("0.1", "0.2", "0.5")
_SHAPED_BY = ("local_ratio", "coverage_threshold", "collision_term", "collision_distance")
_SHARE = "share of landmarks"
_LABELS = {"0.1": "coverage 0.1", "0.2": "coverage 0.2", "0.5": ""}

METRICS: Mapping[str, Metric] = MappingProxyType(
    {
        # MPE2's own reward at local ratio 0.5, the mean over agents: summed, and per step.
        "return_agent_mean": Metric("reward_raw", "sum", "reward per agent and episode", label="return"),
        "reward_raw": Metric("reward_raw", "mean"),
        # The paper's equation (1), the team's reward per step.
        "reward_shaped": Metric("reward_shaped", "mean", defined_by=_SHAPED_BY),
        # Fraction of landmarks with an agent within the radius.
        **{f"coverage_mean_{r}": Metric(f"coverage_{r}", "mean", _SHARE) for r in _RADII},
        **{f"coverage_final_{r}": Metric(f"coverage_{r}", "last", _SHARE, label=_LABELS[r]) for r in _RADII},
        "coverage_mean_theta": Metric("coverage_theta", "mean", _SHARE, defined_by=("coverage_threshold",)),
        "success_final_0.1": Metric("success_0.1", "last", "share of episodes", label="all covered"),
        # Arena units.
        "distance_agent_landmark": Metric("distance_agent_landmark", "mean", "arena units", False),
        "distance_landmark_agent": Metric("distance_landmark_agent", "mean", "arena units", False, "distance"),
        "distance_agent_agent": Metric("distance_agent_agent", "mean", "arena units"),
        # Touching pairs, summed over the steps; and the paper's column: agents with a neighbour within 0.2.
        "collisions": Metric("collisions", "sum", "touching pairs", False, "collisions"),
        "near_agents": Metric("near_agents", "mean", "agents", False),
    }
)

SCOUTS_METRICS: Mapping[str, Metric] = MappingProxyType(
    {**METRICS, "success_final_0.2": Metric("success_0.2", "last", label="within 0.2")}
)
