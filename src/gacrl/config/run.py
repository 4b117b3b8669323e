"""The settings of a run: one frozen dataclass for each part of it; those of a task are the task's."""

from dataclasses import dataclass, field
from typing import Any

from gacrl import tasks
from gacrl.config.algorithms import AlgorithmConfig, GacrlConfig
from gacrl.config.checks import between, require, take_types
from gacrl.tasks.spread.settings import SpreadSettings


@dataclass(frozen=True)
class CurriculumConfig:
    """How the task grows harder while training, where its settings say that it does: linearly over episodes.

    It is always evaluated as `env` has it."""

    episodes: int = 1500
    """Episodes that the change takes."""
    gate: float | None = None
    """Only episodes count after which the task's progress is this far, in a running mean over episodes; none: all
    count."""

    def __post_init__(self) -> None:
        take_types("curriculum", self)
        between("curriculum", self, 0.0, 1.0, "gate")
        between("curriculum", self, 1, 1e9, "episodes")


@dataclass(frozen=True)
class TrainingConfig:
    """How long, and how experience is gathered."""

    env_steps: int = 112_500
    """Environment steps of each seed; one step moves every agent of one environment once."""
    num_envs: int = 1
    """Environments side by side."""
    num_steps: int = 1
    """Steps of each environment between two updates."""
    env_processes: int = 1
    """Processes over which the environments of a seed are spread, where they live in Python (PettingZoo). Their number
    changes no result."""
    intervention: str = ""
    """What happens to messages on their way, in training and in its evaluations: silence [AGENT …], swap AGENT AGENT,
    scramble, drop PROBABILITY, delay STEPS or noise PROBABILITY; nothing by default."""

    def __post_init__(self) -> None:
        take_types("training", self)
        between("training", self, 1, 1e12, "env_steps")
        between("training", self, 1, 1_000_000, "num_envs", "num_steps", "env_processes")
        require(
            self.env_processes <= self.num_envs,
            f"training.env_processes is {self.env_processes}, and there is no more than training.num_envs "
            f"{self.num_envs} to spread over them: raise the latter",
        )


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
        take_types("evaluation", self)
        between("evaluation", self, 1, 1e12, "interval")
        between("evaluation", self, 1, 100_000, "num_episodes", "final_episodes")
        between("evaluation", self, 1, 1_000_000, "horizon")


@dataclass(frozen=True)
class RunConfig:
    """Everything that determines a run."""

    algorithm: AlgorithmConfig = field(default_factory=GacrlConfig)
    task: str = tasks.DEFAULT
    """The name of the task."""
    env: Any = field(default_factory=SpreadSettings)
    """The settings of the task."""
    curriculum: CurriculumConfig = field(default_factory=CurriculumConfig)
    training: TrainingConfig = field(default_factory=TrainingConfig)
    evaluation: EvaluationConfig = field(default_factory=EvaluationConfig)
    preset: str = "gacrl"
    """The preset that these settings start from (`gacrl presets`)."""
    seed: int = 0
    """The random seed; of several, the first."""
    num_seeds: int = 1
    """Independent trainings side by side, with the seeds seed, seed + 1, …"""

    def __post_init__(self) -> None:
        take_types("run", self)
        between("run", self, 0, 2**31 - 1, "seed")
        between("run", self, 1, 10_000, "num_seeds")

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
