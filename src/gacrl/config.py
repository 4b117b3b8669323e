"""The settings of a run: one frozen dataclass per part, the presets, and how they load and save.

A leaf: it imports no jax, so that `--help` and reports start at once. The algorithms' settings are in
`algorithm_config`.
"""

import dataclasses
import difflib
import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from gacrl.algorithm_config import (
    ALGORITHMS,
    AlgorithmConfig,
    GacrlConfig,
    GacrlPaperConfig,
    IppoConfig,
    MappoConfig,
    NetworkConfig,
    PpoConfig,
    QmixConfig,
)
from gacrl.checks import between, require
from gacrl.errors import ConfigError, reason


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


def _gacrl(name: str, env: EnvConfig, env_steps: int = 112_500, **network: Any) -> RunConfig:
    """GACRL as docs/design.md came to it."""
    return RunConfig(
        algorithm=GacrlConfig(
            network=NetworkConfig(
                torso="graph", width=32, latent="vae", communication="discrete", rounds=2, **network
            ),
            learning_rate=1e-3,
            learning_rate_end=1e-4,
            n_step=3,
            augment=True,
            symmetric_play=True,
            double_q=False,
            epsilon_end=0.02,
            replay_capacity=150_000,
            learning_starts=500,
            batch_size=64,
            updates=10,
        ),
        env=replace(env, reward="coverage"),
        training=TrainingConfig(env_steps=env_steps, num_envs=25, num_steps=1),
        evaluation=EvaluationConfig(interval=7_500),
        preset=name,
    )


_GACRL = _gacrl("gacrl", EnvConfig(), env_steps=150_000)
_GACRL_112K = _gacrl("gacrl-112k", EnvConfig(max_cycles=75))
# Entities as dense as in the standard task: the arena's side grows with the root of their number.
_GACRL_TEAMS = _gacrl(
    "gacrl-teams",
    EnvConfig(num_agents=5, arena_scale=1.291, max_cycles=75),
    env_steps=150_000,
    nearest_landmarks=8,
    nearest_agents=12,
)

PRESETS: Mapping[str, tuple[str, RunConfig]] = MappingProxyType(
    {
        "gacrl": ("GACRL that solves the task: episodes of 25 steps", _GACRL),
        "gacrl-112k": ("GACRL that solves the task, on the paper's budget of 112,500 steps", _GACRL_112K),
        "gacrl-teams": (
            "GACRL for teams of any size: trained with 5 agents, each sees what is near",
            _GACRL_TEAMS,
        ),
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


def fingerprint(settings: RunConfig | Mapping[str, Any]) -> str:
    """A hash of every setting but the run's length, which may be extended: what a checkpoint belongs to.

    Of plain data: of the settings that stand in it, whatever further ones there are by now, so that a run made before
    a setting was added can still go on.
    """
    plain = to_dict(settings) if isinstance(settings, RunConfig) else settings
    data = {**plain, "training": {k: v for k, v in plain.get("training", {}).items() if k != "env_steps"}}
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
        require(value in arguments, f"{where} must be one of {', '.join(map(str, arguments))}, not {value!r}")
        return value
    if origin is tuple and isinstance(value, list | tuple):
        inner = arguments[0]
        values: list[Any] = list(value)  # pyright: ignore[reportUnknownArgumentType]
        fixed = arguments[-1] is not Ellipsis
        require(
            not fixed or len(values) == len(arguments),
            f"{where} must be {len(arguments)} numbers, not {values!r}",
        )
        return tuple(_coerce(item, inner, where) for item in values)
    if origin is not None and type(None) in arguments:  # X | None
        return None if value is None else _coerce(value, Union[arguments[0]], where)  # noqa: UP007
    if hint is float and isinstance(value, int) and not isinstance(value, bool):
        return float(str(value))  # infinity where it is too large
    if origin is tuple:
        raise ConfigError(f"{where} must be a list, not {value!r}")
    wanted = {int: "a whole number", float: "a number", bool: "true or false", str: "a text"}.get(hint, str(hint))
    matches = isinstance(hint, type) and isinstance(value, hint) and isinstance(value, bool) == (hint is bool)
    require(matches, f"{where} must be {wanted}, not {value!r}")
    return value
