"""The settings of a run: one frozen dataclass for each part of it.

A leaf: it imports no jax, so that `--help` and reports start at once. The algorithms' settings are in
`algorithm_config`, the presets in `presets`; `config` loads and saves them.
"""

from dataclasses import dataclass, field
from typing import Literal

from gacrl.config.algorithms import AlgorithmConfig, GacrlConfig, GacrlPaperConfig
from gacrl.config.checks import between, require


@dataclass(frozen=True)
class EnvConfig:
    """The task."""

    name: Literal["spread"] = "spread"
    """Which task."""
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
    """θ of the paper: its coverage bonus, and the coverage that exploration follows."""
    reward: Literal["mpe2", "paper", "coverage", "potential"] = "mpe2"
    """What the learner earns: MPE2's reward, the paper's shaped one (equation 1), MPE2's and a bonus for every step in
    which a landmark is covered within 0.1, or MPE2's and the change of a potential, the distance left to walk in the
    best assignment, which leaves the optimal policy as it is. Metrics are always of MPE2's."""
    coverage_bonus: float = 1.0
    """Of reward coverage: what a step with every landmark covered adds."""
    collision_term: Literal["per_agent", "once"] = "per_agent"
    """Equation (1)'s collision term inside the sum over agents, or once."""
    collision_distance: float = 0.2
    """Equation (1)'s collision distance; the discs touch at 0.3."""
    reset_on_collision: Literal["off", "truncate", "in_place"] = "off"
    """The paper's "resets if agents collide": never, as an episode's end, or new places mid-episode."""
    reset_distance: float = 0.2
    """Agents this close have collided, for reset_on_collision."""

    def __post_init__(self) -> None:
        between("env", self, 1, 10_000, "num_agents", "num_landmarks")
        between("env", self, 1, 1_000_000, "max_cycles")
        between("env", self, 1, 10_000, "num_agent_neighbors", "num_landmark_neighbors")
        between("env", self, 0.0, 1.0, "local_ratio")
        between("env", self, 0.001, 1000.0, "arena_scale", "coverage_threshold")
        between("env", self, 0.0, 10.0, "landmark_speed", "collision_distance", "reset_distance")
        between("env", self, 0.0, 1000.0, "coverage_bonus")

    @property
    def landmarks(self) -> int:
        return self.num_agents if self.num_landmarks is None else self.num_landmarks


@dataclass(frozen=True)
class CurriculumConfig:
    """How the task grows harder while training: linearly over episodes. It is always evaluated as `env` has it."""

    local_ratio_end: float | None = None
    """Local ratio after the last episode; none: constant."""
    coverage_threshold_end: float | None = None
    """θ after the last episode; none: constant."""
    arena_scale_start: float | None = None
    """Arena of the first episode, from which it changes to env's; none: constant."""
    num_agents_start: int | None = None
    """Agents of the first episode; more join, and landmarks in proportion, until all of env's are there."""
    episodes: int = 1500
    """Episodes that the change takes."""
    gate: float | None = None
    """Only episodes count at whose end this share of the landmarks is covered within θ, in a running mean over
    episodes; none: all count."""

    def __post_init__(self) -> None:
        between("curriculum", self, 0.0, 1.0, "local_ratio_end", "gate")
        between("curriculum", self, 0.001, 1000.0, "coverage_threshold_end", "arena_scale_start")
        between("curriculum", self, 1, 10_000, "num_agents_start")
        between("curriculum", self, 1, 1e9, "episodes")
        require(
            self.gate is None or self.changes,
            "curriculum.gate has nothing to hold back: set one of curriculum's ends or starts, or leave it",
        )

    @property
    def changes(self) -> bool:
        """Something about the task moves."""
        moving = self.local_ratio_end, self.coverage_threshold_end, self.arena_scale_start, self.num_agents_start
        return any(value is not None for value in moving)


@dataclass(frozen=True)
class TrainingConfig:
    """How long, and how experience is gathered."""

    env_steps: int = 112_500
    """Environment steps of each seed; one step moves every agent of one environment once."""
    num_envs: int = 1
    """Environments side by side."""
    num_steps: int = 1
    """Steps of each environment between two updates."""

    def __post_init__(self) -> None:
        between("training", self, 1, 1e12, "env_steps")
        between("training", self, 1, 1_000_000, "num_envs", "num_steps")


@dataclass(frozen=True)
class EvaluationConfig:
    """Evaluation on fixed episodes that training never sees."""

    interval: int = 3_750
    """Environment steps between evaluations; also between checkpoints, and lines of the log."""
    num_episodes: int = 32
    """Episodes of each evaluation."""
    final_episodes: int = 320
    """Episodes of the evaluation that ends the run."""
    horizon: int | None = None
    """Steps of an evaluation episode; none: as in training."""

    def __post_init__(self) -> None:
        between("evaluation", self, 1, 1e12, "interval")
        between("evaluation", self, 1, 100_000, "num_episodes", "final_episodes")
        between("evaluation", self, 1, 1_000_000, "horizon")


@dataclass(frozen=True)
class RunConfig:
    """Everything that determines a run."""

    algorithm: AlgorithmConfig = field(default_factory=GacrlConfig)
    env: EnvConfig = field(default_factory=EnvConfig)
    curriculum: CurriculumConfig = field(default_factory=CurriculumConfig)
    training: TrainingConfig = field(default_factory=TrainingConfig)
    evaluation: EvaluationConfig = field(default_factory=EvaluationConfig)
    preset: str = "gacrl"
    """The preset that this started from."""
    seed: int = 0
    """Seed of the first member."""
    num_seeds: int = 1
    """Members: independent runs with the seeds seed, seed + 1, …"""

    def __post_init__(self) -> None:
        between("run", self, 0, 2**31 - 1, "seed")
        between("run", self, 1, 10_000, "num_seeds")
        require(
            not (self.env.continuous_actions and self.algorithm.name == GacrlPaperConfig.name),
            f"{self.algorithm.name} needs discrete actions: leave env.continuous_actions at False",
        )
        start = self.curriculum.num_agents_start
        require(
            start is None or self.algorithm.name != GacrlPaperConfig.name,
            f"{self.algorithm.name} knows teams of one size only: leave curriculum.num_agents_start",
        )
        require(
            start is None or start <= self.env.num_agents,
            f"curriculum.num_agents_start must be at most env.num_agents, {self.env.num_agents}, not {start}",
        )

    @property
    def seeds(self) -> tuple[int, ...]:
        return tuple(range(self.seed, self.seed + self.num_seeds))

    @property
    def steps_per_update(self) -> int:
        """Environment steps that one update consumes."""
        return self.training.num_envs * self.training.num_steps

    @property
    def num_updates(self) -> int:
        """Updates of the whole run; a started one is finished."""
        return -(-self.training.env_steps // self.steps_per_update)

    @property
    def updates_per_chunk(self) -> int:
        """Updates between two evaluations."""
        return min(self.num_updates, -(-self.evaluation.interval // self.steps_per_update))
