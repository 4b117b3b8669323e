"""The settings of a run: one frozen dataclass per part, the presets, and how they load and save.

A leaf: it imports no jax, so that `--help` and reports start at once. Every default has its home here.
"""

import dataclasses
import difflib
import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, ClassVar, Literal, TypeAlias, Union, get_args, get_origin, get_type_hints

from gacrl.errors import UserError, reason


class ConfigError(UserError, ValueError):
    """A setting that cannot be: one sentence that names the thing and the mend."""


def _require(condition: bool, message: str) -> None:
    if not condition:
        raise ConfigError(message)


def _between(section: str, settings: object, low: int | float, high: int | float, *names: str) -> None:
    for name in names:
        value = getattr(settings, name)
        if value is not None:
            _require(
                isinstance(value, int | float) and low <= value <= high,
                f"{section}.{name} must be between {_shown(low)} and {_shown(high)}, not {value}",
            )


def _shown(bound: int | float) -> str:
    return str(bound) if isinstance(bound, int) else f"{bound:g}"


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
    reward: Literal["mpe2", "paper", "coverage"] = "mpe2"
    """What the learner earns: MPE2's reward, the paper's shaped one (equation 1), or MPE2's and a bonus for every
    step in which a landmark is covered within 0.1. Metrics are always of MPE2's."""
    coverage_bonus: float = 0.5
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
        _between("env", self, 1, 10_000, "num_agents", "num_landmarks")
        _between("env", self, 1, 1_000_000, "max_cycles")
        _between("env", self, 1, 10_000, "num_agent_neighbors", "num_landmark_neighbors")
        _between("env", self, 0.0, 1.0, "local_ratio")
        _between("env", self, 0.001, 1000.0, "arena_scale", "coverage_threshold")
        _between("env", self, 0.0, 10.0, "landmark_speed", "collision_distance", "reset_distance")
        _between("env", self, 0.0, 1000.0, "coverage_bonus")

    @property
    def landmarks(self) -> int:
        return self.num_agents if self.num_landmarks is None else self.num_landmarks


@dataclass(frozen=True)
class CurriculumConfig:
    """How the task changes while training: linearly over episodes, from its value in env to the value here."""

    local_ratio_end: float | None = None
    """Local ratio after the last episode; none: constant."""
    coverage_threshold_end: float | None = None
    """θ after the last episode; none: constant."""
    episodes: int = 1500
    """Episodes that the change takes."""

    def __post_init__(self) -> None:
        _between("curriculum", self, 0.0, 1.0, "local_ratio_end")
        _between("curriculum", self, 0.001, 1000.0, "coverage_threshold_end")
        _between("curriculum", self, 1, 1e9, "episodes")


@dataclass(frozen=True)
class GacrlPaperConfig:
    """The paper's algorithm, as printed (docs/algorithm.md)."""

    name: ClassVar[str] = "gacrl_paper"

    learning_rate: float = 5e-4
    """Adam's step size at the start."""
    learning_rate_end: float = 1e-4
    """And at the end of the schedule."""
    epsilon: float = 0.3
    """Share of random actions at the start, equation (15)."""
    epsilon_end: float = 0.1
    epsilon_bonus: float = 0.2
    """Added to epsilon at coverage 0, equation (13)."""
    temperature: float = 2.0
    """Gumbel-Softmax temperature at the start, equation (16)."""
    temperature_end: float = 0.7
    temperature_bonus: float = 0.5
    """Added to the temperature at coverage 0, equation (14)."""
    schedule_episodes: int = 1500
    """Episodes over which learning rate, epsilon and temperature decay."""
    coverage_signal: Literal["episode_so_far", "last_episode"] = "episode_so_far"
    """c of (13) and (14): mean coverage of the episode so far, or of the last finished one."""
    batch_size: int = 64
    """Replayed steps in a gradient step, B."""
    replay_capacity: int = 10_000
    """Steps that the replay remembers."""
    critic_weight: float = 0.1
    """Weight of the critic's loss, equation (17)."""
    kl_weight: float = 0.05
    """Weight of the KL divergence, equation (17)."""
    kl_reduction: Literal["sum", "mean"] = "sum"
    """Equation (20) over the latent dimensions."""
    messages: Literal["soft", "straight_through"] = "soft"
    """Gumbel-Softmax samples as printed, or one-hot with the soft gradient."""
    radius: float = 1.5
    """Agents nearer than this share an edge, equation (4)."""
    latent_size: int = 16
    vocabulary: int = 8
    """Symbols of a message."""
    encoder_hidden: tuple[int, ...] = (64, 32)
    message_hidden: int = 32
    policy_hidden: tuple[int, int] = (64, 32)
    critic_hidden: tuple[int, int] = (128, 64)

    def __post_init__(self) -> None:
        _between("algorithm", self, 0.0, 1.0, "learning_rate", "learning_rate_end", "epsilon", "epsilon_end")
        _between("algorithm", self, 0.0, 1.0, "epsilon_bonus")
        _require(
            max(self.epsilon, self.epsilon_end) + self.epsilon_bonus <= 1.0,
            "algorithm.epsilon plus algorithm.epsilon_bonus must not exceed 1, a probability",
        )
        _between("algorithm", self, 0.01, 100.0, "temperature", "temperature_end")
        _between("algorithm", self, 0.0, 100.0, "temperature_bonus", "critic_weight", "kl_weight")
        _between("algorithm", self, 0.0, 1e6, "radius")
        _between("algorithm", self, 1, 1_000_000, "batch_size", "replay_capacity", "schedule_episodes")
        _between("algorithm", self, 1, 100_000, "latent_size", "vocabulary", "message_hidden")
        for name in ("encoder_hidden", "policy_hidden", "critic_hidden"):
            sizes = getattr(self, name)
            _require(
                len(sizes) > 0 and all(1 <= size <= 100_000 for size in sizes),
                f"algorithm.{name} must be layer sizes between 1 and 100000, not {list(sizes)}",
            )


@dataclass(frozen=True)
class NetworkConfig:
    """The agents' network: torso, memory and communication, the same choices for every algorithm."""

    torso: Literal["mlp", "graph"] = "mlp"
    """Layers over the observation vector, or a graph of the entities in sight by relative position."""
    width: int = 128
    """Units of a hidden layer."""
    depth: int = 2
    """Hidden layers of the mlp torso."""
    recurrent: bool = False
    """A GRU after the torso."""
    latent: Literal["none", "deterministic", "vae"] = "none"
    """A narrow code of what the agent sees, which its symbols are made of: none, a code, or a Gaussian."""
    latent_size: int = 16
    """Numbers of the code."""
    communication: Literal["none", "commnet", "dial", "discrete", "soft"] = "none"
    """CommNet's averages, DIAL's regularised units, or Gumbel-Softmax symbols: hard or soft."""
    rounds: int = 1
    """Rounds of messages within a step (CommNet, symbols)."""
    vocabulary: int = 8
    """Symbols of a message; units of a DIAL message."""
    dial_noise: float = 2.0
    """Standard deviation of the noise on DIAL's units while learning."""
    radius: float = 1.5
    """Agents nearer than this hear each other, where the task has positions."""
    nearest_landmarks: int | None = None
    """The graph torso looks at this many nearest landmarks; none: all in sight."""
    nearest_agents: int | None = None
    """And at this many nearest other agents."""
    parameters: int | None = None
    """Choose the width so that the acting network has about this many parameters; none: take the width."""

    def __post_init__(self) -> None:
        _between("algorithm.network", self, 1, 65_536, "width", "vocabulary", "latent_size")
        _between("algorithm.network", self, 1, 65_536, "nearest_landmarks", "nearest_agents")
        _between("algorithm.network", self, 1, 100, "depth", "rounds")
        _between("algorithm.network", self, 0.0, 100.0, "dial_noise")
        _between("algorithm.network", self, 0.0, 1e6, "radius")
        _between("algorithm.network", self, 1, 1_000_000_000, "parameters")


@dataclass(frozen=True)
class LearningConfig:
    """What every learner has: its network, its horizon, its step size, and the symmetry of the task."""

    network: NetworkConfig = field(default_factory=NetworkConfig)
    learning_rate: float = 1e-3
    """Adam's step size at the start."""
    learning_rate_end: float = 0.0
    """And after the planned environment steps; linear in between."""
    gamma: float = 0.95
    """Discount of a step."""
    n_step: int = 1
    """Rewards in a target before it bootstraps (PPO: 0 leaves it to gae_lambda)."""
    max_grad_norm: float = 10.0
    """Longer gradients are shortened to this norm."""
    augment: bool = False
    """Turn what is learned from by a random one of the task's symmetries."""
    reward: Literal["team", "own"] = "team"
    """Every agent earns the team's mean reward, or its own."""

    def __post_init__(self) -> None:
        _between("algorithm", self, 0.0, 1.0, "learning_rate", "learning_rate_end", "gamma")
        _between("algorithm", self, 0, 1_000, "n_step")
        _between("algorithm", self, 1e-6, 1e6, "max_grad_norm")


@dataclass(frozen=True)
class PpoConfig(LearningConfig):
    """Proximal policy optimisation of a team with shared weights; MAPPO and IPPO differ by the critic's view."""

    n_step: int = 0
    """Rewards in a target before it bootstraps; 0 leaves it to gae_lambda."""
    gae_lambda: float = 0.95
    """Of generalised advantage estimation."""
    update_epochs: int = 6
    """Passes over a rollout."""
    num_minibatches: int = 2
    """Gradient steps of a pass; a minibatch takes environments and times, never single agents."""
    clip_eps: float = 0.2
    """Bound of the policy's ratio around 1."""
    ent_coef: float = 0.01
    """Weight of the policy's entropy."""
    ent_coef_end: float = 0.0
    """And after the planned environment steps."""
    vf_coef: float = 0.5
    """Weight of the critic's loss."""
    huber_delta: float = 10.0
    """The critic's loss is linear beyond this error, in standard deviations of the returns."""
    value_norm: bool = True
    """The critic predicts returns in units of their running mean and standard deviation."""

    def __post_init__(self) -> None:
        super().__post_init__()
        _between("algorithm", self, 0.0, 1.0, "gae_lambda")
        _between("algorithm", self, 1, 10_000, "update_epochs", "num_minibatches")
        _between("algorithm", self, 1e-6, 1e6, "clip_eps", "huber_delta")
        _between("algorithm", self, 0.0, 1e6, "ent_coef", "ent_coef_end", "vf_coef")


@dataclass(frozen=True)
class MappoConfig(PpoConfig):
    """MAPPO (Yu et al. 2022): the critic sees the global state besides the agent's observation."""

    name: ClassVar[str] = "mappo"


@dataclass(frozen=True)
class IppoConfig(PpoConfig):
    """IPPO (de Witt et al. 2020): the critic sees what its agent sees."""

    name: ClassVar[str] = "ippo"


@dataclass(frozen=True)
class QLearningConfig(LearningConfig):
    """Q-learning of a team from replay."""

    replay_capacity: int = 50_000
    """Environment steps that the replay remembers."""
    learning_starts: int = 1_000
    """Environment steps before the first gradient step."""
    batch_size: int = 128
    """Windows of replayed steps in a gradient step."""
    sequence_length: int = 1
    """Steps learned from in a window; a recurrent network is unrolled over them."""
    updates: int = 2
    """Gradient steps after each rollout."""
    target_step: float = 0.01
    """The target network moves this far towards the online one after each gradient step."""
    reward_norm: bool = False
    """Learn from rewards in units of their running mean and standard deviation, which keeps values around 0 (a
    monotonic mixer's units saturate far below it). Leaves the optimum where episodes have a fixed length."""
    double_q: bool = True
    """The online network chooses the action that the target network values."""

    def __post_init__(self) -> None:
        super().__post_init__()
        _require(self.n_step >= 1, "algorithm.n_step must be at least 1 where there is no gae_lambda")
        _between("algorithm", self, 1, 10_000_000, "replay_capacity", "batch_size", "sequence_length")
        _between("algorithm", self, 0, 1_000_000_000, "learning_starts")
        _between("algorithm", self, 1, 1_000_000, "updates")
        _between("algorithm", self, 0.0, 1.0, "target_step")


@dataclass(frozen=True)
class QmixConfig(QLearningConfig):
    """QMIX, and with other mixers VDN and IQL."""

    name: ClassVar[str] = "qmix"

    mixer: Literal["qmix", "vdn", "iql"] = "qmix"
    """A monotonic network of the agents' values, their sum, or each for itself."""
    mixer_width: int = 32
    """Units of QMIX's mixing network."""
    epsilon: float = 1.0
    """Share of random actions at the start."""
    epsilon_end: float = 0.05
    epsilon_steps: int = 50_000
    """Environment steps over which the share falls."""

    def __post_init__(self) -> None:
        super().__post_init__()
        _between("algorithm", self, 1, 10_000, "mixer_width")
        _between("algorithm", self, 0, 1_000_000_000, "epsilon_steps")
        _between("algorithm", self, 0.0, 1.0, "epsilon", "epsilon_end")


@dataclass(frozen=True)
class GacrlConfig(QLearningConfig):
    """GACRL that solves the task: the paper's four ideas on a learner that uses them (docs/algorithm.md)."""

    name: ClassVar[str] = "gacrl"

    critic: Literal["central", "sum"] = "central"
    """Q_tot is a central value plus the agents' advantages, or the sum of their values (as VDN)."""
    latent_weight: float = 1e-3
    """Weight of the code's loss: reconstruction and KL divergence."""
    exploration: Literal["adaptive", "linear", "fixed"] = "adaptive"
    """The level of exploration follows the coverage that greedy episodes reach, or time, or stays at its end."""
    epsilon: float = 1.0
    """Share of random actions while nothing is covered."""
    epsilon_end: float = 0.05
    """And when everything is."""
    temperature: float = 2.0
    """Gumbel-Softmax temperature of the symbols while nothing is covered."""
    temperature_end: float = 0.5
    """And when everything is."""
    exploration_steps: int = 12_000
    """Environment steps over which the levels fall, where they follow time."""
    greedy_share: float = 0.2
    """Share of the training episodes that are played greedily, to see what is covered without exploring."""
    coverage_radius: Literal["0.1", "0.2", "0.5"] = "0.2"
    """Radius of the coverage that exploration follows."""
    averaged: bool = True
    """Play greedily with the target network, a running mean of the parameters."""

    def __post_init__(self) -> None:
        super().__post_init__()
        _between("algorithm", self, 0.0, 1e6, "latent_weight")
        _between("algorithm", self, 0.0, 1.0, "epsilon", "epsilon_end", "greedy_share")
        _between("algorithm", self, 0.01, 100.0, "temperature", "temperature_end")
        _between("algorithm", self, 1, 1_000_000_000, "exploration_steps")


AlgorithmConfig: TypeAlias = GacrlPaperConfig | GacrlConfig | MappoConfig | IppoConfig | QmixConfig
"""Any algorithm's settings."""

ALGORITHMS: Mapping[str, type[AlgorithmConfig]] = MappingProxyType(
    {kind.name: kind for kind in (GacrlPaperConfig, GacrlConfig, MappoConfig, IppoConfig, QmixConfig)}
)


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
        _between("training", self, 1, 1e12, "env_steps")
        _between("training", self, 1, 1_000_000, "num_envs", "num_steps")


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
        _between("evaluation", self, 1, 1e12, "interval")
        _between("evaluation", self, 1, 100_000, "num_episodes", "final_episodes")
        _between("evaluation", self, 1, 1_000_000, "horizon")


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
        _between("run", self, 0, 2**31 - 1, "seed")
        _between("run", self, 1, 10_000, "num_seeds")
        _require(
            not (self.env.continuous_actions and self.algorithm.name == GacrlPaperConfig.name),
            f"{self.algorithm.name} needs discrete actions: leave env.continuous_actions at False",
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


_PAPER = RunConfig(
    algorithm=GacrlPaperConfig(),
    env=EnvConfig(max_cycles=75, reward="paper"),
    curriculum=CurriculumConfig(local_ratio_end=0.1, coverage_threshold_end=0.2),
    training=TrainingConfig(env_steps=112_500),
    evaluation=EvaluationConfig(interval=50 * 75),
    preset="paper",
)


def _baseline(name: str, algorithm: AlgorithmConfig, training: TrainingConfig) -> RunConfig:
    """A baseline on the standard task: MPE2's reward, 25 steps."""
    return RunConfig(
        algorithm=algorithm,
        training=training,
        evaluation=EvaluationConfig(interval=max(training.env_steps // 20, 1)),
        preset=name,
    )


def _ppo(kind: type[PpoConfig], **network: Any) -> Any:
    """The tuned PPO of docs/results.md."""
    return kind(
        network=NetworkConfig(width=64, **network),
        learning_rate=3e-3,
        gamma=0.9,
        gae_lambda=0.8,
        clip_eps=0.3,
        ent_coef=0.001,
        num_minibatches=4,
        reward="own",
    )


def _q(mixer: Literal["qmix", "vdn", "iql"], sequence_length: int = 1, **network: Any) -> QmixConfig:
    """The tuned Q-learning of docs/results.md."""
    return QmixConfig(
        network=NetworkConfig(**network),
        mixer=mixer,
        n_step=3,
        updates=16,
        reward_norm=True,
        max_grad_norm=1.0,
        sequence_length=sequence_length,
    )


_ON_POLICY = TrainingConfig(env_steps=2_500_000, num_envs=64, num_steps=25)
_OFF_POLICY = TrainingConfig(env_steps=1_000_000, num_envs=32, num_steps=8)
_MAPPO = _baseline("mappo", _ppo(MappoConfig), _ON_POLICY)
_IPPO = _baseline("ippo", _ppo(IppoConfig), _ON_POLICY)
_QMIX = _baseline("qmix", _q("qmix"), _OFF_POLICY)
_VDN = _baseline("vdn", _q("vdn"), _OFF_POLICY)
_IQL = _baseline("iql", _q("iql"), _OFF_POLICY)
_COMMNET = _baseline("commnet", _ppo(IppoConfig, communication="commnet", rounds=2), _ON_POLICY)
_DIAL = _baseline("dial", _q("vdn", 8, communication="dial", recurrent=True, width=64), _OFF_POLICY)

_GACRL_112K = RunConfig(
    algorithm=GacrlConfig(
        network=NetworkConfig(torso="graph", width=32, latent="vae", communication="discrete"),
        learning_rate=1e-3,
        learning_rate_end=1e-4,
        n_step=3,
        augment=True,
        epsilon_end=0.02,
        replay_capacity=120_000,
        learning_starts=500,
        updates=10,
    ),
    env=EnvConfig(max_cycles=75, reward="coverage"),
    training=TrainingConfig(env_steps=112_500, num_envs=5, num_steps=5),
    evaluation=EvaluationConfig(interval=7_500),
    preset="gacrl-112k",
)
_GACRL = replace(_GACRL_112K, env=replace(_GACRL_112K.env, max_cycles=25), preset="gacrl")

PRESETS: Mapping[str, tuple[str, RunConfig]] = MappingProxyType(
    {
        "gacrl": ("GACRL that solves the task: episodes of 25 steps", _GACRL),
        "gacrl-112k": ("GACRL that solves the task, on the paper's budget of 112,500 steps", _GACRL_112K),
        "qmix": ("QMIX: replay, double Q, a monotonic mixer", _QMIX),
        "vdn": ("VDN: the same learner, values summed", _VDN),
        "iql": ("IQL: the same learner, each agent for itself", _IQL),
        "mappo": ("MAPPO: PPO with a central critic", _MAPPO),
        "ippo": ("IPPO: PPO with a critic for each agent", _IPPO),
        "commnet": ("CommNet: PPO whose agents average each other's hidden states", _COMMNET),
        "dial": ("DIAL: Q-learning through messages that are bits when played", _DIAL),
        "paper": ("the paper's GACRL as printed: 1,500 episodes of 75 steps, an update every step", _PAPER),
    }
)
DEFAULT_PRESET = "gacrl"


def preset(name: str = DEFAULT_PRESET) -> RunConfig:
    """The settings of a preset. Raises ConfigError with the nearest name for one there is not."""
    if name not in PRESETS:
        raise ConfigError(unknown("preset", name, PRESETS, "see `gacrl presets`"))
    return PRESETS[name][1]


def unknown(kind: str, name: str, known: Mapping[str, Any] | set[str] | list[str], hint: str = "") -> str:
    """The sentence for a name that is not among the known ones, with the nearest of them."""
    near = difflib.get_close_matches(name, list(known), n=1, cutoff=0.4)
    mend = f"did you mean '{near[0]}'?" if near else f"known: {', '.join(sorted(known))}"
    return f"unknown {kind} {name!r}: {mend}" + (f" ({hint})" if hint else "")


def to_dict(config: RunConfig) -> dict[str, Any]:
    """The settings as plain data, complete; the algorithm's name stands among its settings."""
    data = dataclasses.asdict(config)
    return {**data, "algorithm": {"name": config.algorithm.name, **data["algorithm"]}}


def from_dict(data: Mapping[str, Any], base: RunConfig | None = None) -> RunConfig:
    """Settings from plain data over a base (the preset that the data names, else the default one).

    Raises ConfigError for an unknown key (with the nearest known one) or a value of the wrong type.
    """
    named = preset(_text(data.get("preset", DEFAULT_PRESET), "preset"))
    base = named if base is None else base
    data = dict(data)
    if isinstance(data.get("algorithm"), Mapping) and "name" in data["algorithm"]:
        settings = dict(data["algorithm"])
        name = _text(settings.pop("name"), "algorithm.name")
        if name not in ALGORITHMS:
            raise ConfigError(unknown("algorithm", name, ALGORITHMS))
        if name != base.algorithm.name:
            base = replace(base, algorithm=ALGORITHMS[name]())
        data["algorithm"] = settings
    return _merge(base, data, "")


def load(path: Path, base: RunConfig | None = None) -> RunConfig:
    """Read settings from a JSON file (as `config.json` of a run folder, or a part of it) over a base.

    Without a base: over the preset that the file names. Raises ConfigError.
    """
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        mend = "`gacrl config` prints one to start from"
        raise ConfigError(f"cannot read the configuration {path}: {reason(error)}; {mend}") from error
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"{path} is not JSON: {error}") from error
    if not isinstance(data, dict):
        raise ConfigError(f"{path} must hold a JSON object of settings")
    try:
        return from_dict(data, base)  # pyright: ignore[reportUnknownArgumentType]
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error


def dumps(config: RunConfig) -> str:
    """The settings as the text of a loadable file."""
    return json.dumps(to_dict(config), indent=2) + "\n"


def fingerprint(config: RunConfig) -> str:
    """A hash of every setting but the run's length, which may be extended: what a checkpoint belongs to."""
    data = to_dict(config)
    del data["training"]["env_steps"]
    return hashlib.sha256(json.dumps(data, sort_keys=True).encode()).hexdigest()[:16]


def _text(value: Any, where: str) -> str:
    if not isinstance(value, str):
        raise ConfigError(f"{where} must be a name, not {value!r}")
    return value


def _merge(settings: Any, data: Mapping[str, Any], where: str) -> Any:
    """`settings`, a dataclass, with the values that `data` names."""
    hints = get_type_hints(type(settings))
    fields = {f.name for f in dataclasses.fields(settings)}
    changes: dict[str, Any] = {}
    for key, value in data.items():
        if key not in fields:
            raise ConfigError(unknown("setting", where + key, {where + name for name in fields}))
        current = getattr(settings, key)
        if dataclasses.is_dataclass(current):
            if not isinstance(value, Mapping):
                raise ConfigError(f"{where}{key} must be an object of settings, not {value!r}")
            changes[key] = _merge(current, value, f"{where}{key}.")  # pyright: ignore[reportUnknownArgumentType]
        else:
            changes[key] = _coerce(value, hints[key], where + key)
    return replace(settings, **changes)


def _coerce(value: Any, hint: Any, where: str) -> Any:
    """The value as the type that the setting has; JSON has no tuples, and writes 1 for 1.0."""
    origin, arguments = get_origin(hint), get_args(hint)
    if origin is Literal:
        _require(value in arguments, f"{where} must be one of {', '.join(map(str, arguments))}, not {value!r}")
        return value
    if origin is tuple and isinstance(value, list | tuple):
        inner = arguments[0]
        values: list[Any] = list(value)  # pyright: ignore[reportUnknownArgumentType]
        fixed = arguments[-1] is not Ellipsis
        _require(
            not fixed or len(values) == len(arguments),
            f"{where} must be {len(arguments)} numbers, not {values!r}",
        )
        return tuple(_coerce(item, inner, where) for item in values)
    if origin is not None and type(None) in arguments:  # X | None
        return None if value is None else _coerce(value, Union[arguments[0]], where)  # noqa: UP007
    if hint is float and isinstance(value, int) and not isinstance(value, bool):
        return float(str(value))  # infinity where it is too large
    if origin is tuple:
        raise ConfigError(f"{where} must be a list of whole numbers, not {value!r}")
    wanted = {int: "a whole number", float: "a number", bool: "true or false", str: "a text"}.get(hint, str(hint))
    matches = isinstance(hint, type) and isinstance(value, hint) and isinstance(value, bool) == (hint is bool)
    _require(matches, f"{where} must be {wanted}, not {value!r}")
    return value
