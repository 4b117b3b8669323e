"""The presets: settings that work, by name."""

from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Any

from gacrl.config.algorithms import (
    AlgorithmConfig,
    CommnetConfig,
    DialConfig,
    GacrlConfig,
    GacrlPaperConfig,
    IppoConfig,
    IqlConfig,
    MappoConfig,
    NetworkConfig,
    PpoConfig,
    QLearningConfig,
    QmixConfig,
    VdnConfig,
)
from gacrl.config.checks import unknown
from gacrl.config.run import EvaluationConfig, RunConfig, TrainingConfig
from gacrl.errors import ConfigError
from gacrl.tasks.spread.settings import SpreadSettings

_PAPER = RunConfig(
    algorithm=GacrlPaperConfig(),
    env=SpreadSettings(max_cycles=75, reward="paper", local_ratio_end=0.1, coverage_threshold_end=0.2),
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


def _q(kind: type[QLearningConfig], sequence_length: int = 1, **network: Any) -> Any:
    """The tuned Q-learning of docs/results.md."""
    return kind(
        network=NetworkConfig(**network),
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
_QMIX = _baseline("qmix", _q(QmixConfig), _OFF_POLICY)
_VDN = _baseline("vdn", _q(VdnConfig), _OFF_POLICY)
_IQL = _baseline("iql", _q(IqlConfig), _OFF_POLICY)
_COMMNET = _baseline("commnet", _ppo(CommnetConfig, communication="commnet", rounds=2), _ON_POLICY)
_DIAL = _baseline("dial", _q(DialConfig, 8, communication="dial", recurrent=True, width=64), _OFF_POLICY)


GACRL_PARAMETERS = 15_893
"""Of the acting network of `gacrl`, for three agents."""
_LEARNER: dict[str, Any] = {
    "augment": True,
    "learning_rate": 3e-3,
    "learning_rate_end": 1e-4,
    "target_step": 0.004,
    "reward_norm": True,
    "n_step": 3,
    "double_q": False,
    "averaged": True,
    "epsilon_end": 0.02,
    "replay_capacity": 150_000,
    "learning_starts": 500,
    "batch_size": 64,
    "updates": 10,
}
"""Q-learning where environment steps are dear: an update of ten gradient steps after every 25 of them."""


def _dear(name: str, algorithm: AlgorithmConfig, env: SpreadSettings, training: TrainingConfig) -> RunConfig:
    """Few environment steps, rewarded with the coverage bonus."""
    env, evaluation = replace(env, reward="coverage"), EvaluationConfig(interval=7_500)
    return RunConfig(algorithm=algorithm, env=env, training=training, evaluation=evaluation, preset=name)


_GACRL_NETWORK = NetworkConfig(
    torso="graph",
    width=32,
    latent="vae",
    latent_use="mean",
    communication="discrete",
    rounds=2,
    vocabulary=16,
    symbols="soft",
    symbol_noise=0.0,
    second_look=True,
    seen_slope=0.1,
    heard_slope=0.1,
    logit_price=0.01,
)


def _gacrl(name: str, env: SpreadSettings, env_steps: int = 112_500, **changes: Any) -> RunConfig:
    """GACRL as docs/log.md came to it."""
    settings: dict[str, Any] = {
        "network": _GACRL_NETWORK,
        **_LEARNER,
        "epsilon": 0.3,
        "temperature": 0.1,
        "temperature_end": 0.02,
        "gamma": 0.9,
        **changes,
    }
    training = TrainingConfig(env_steps=env_steps, num_envs=25, num_steps=1)
    return _dear(name, GacrlConfig(**settings), env, training)


_GACRL = _gacrl("gacrl", SpreadSettings(), env_steps=150_000)
_GACRL_112K = _gacrl("gacrl-112k", SpreadSettings(max_cycles=75))
# Entities as dense as in the standard task: the arena's side grows with the root of their number.
_GACRL_TEAMS = _gacrl(
    "gacrl-teams",
    SpreadSettings(num_agents=5, arena_scale=1.291, max_cycles=75),
    env_steps=150_000,
    network=replace(_GACRL_NETWORK, nearest_landmarks=8, nearest_agents=12),
)

# GACRL's switches on the baselines, and its number of parameters: what is left is the algorithm, tuned in six trials
# (docs/tuning). QMIX, which has VDN's settings, collapses in some seeds with them as with those of its best trial.
_GRAPH = NetworkConfig(torso="graph", parameters=GACRL_PARAMETERS)


def _graph_q(name: str, kind: type[QLearningConfig]) -> RunConfig:
    algorithm = kind(network=_GRAPH, exploration_steps=13_000, **_LEARNER)
    return _dear(name, algorithm, SpreadSettings(), _GACRL.training)


def _graph_ppo(name: str, kind: type[PpoConfig], **tuned: Any) -> RunConfig:
    algorithm = replace(_ppo(kind), network=_GRAPH, augment=True, **tuned)
    return _dear(name, algorithm, SpreadSettings(), replace(_GACRL.training, num_envs=10, num_steps=25))


_GRAPH_VDN = _graph_q("graph-vdn", VdnConfig)
_GRAPH_QMIX = _graph_q("graph-qmix", QmixConfig)
_GRAPH_MAPPO = _graph_ppo(
    "graph-mappo", MappoConfig, learning_rate=2.3e-3, update_epochs=4, num_minibatches=5, gamma=0.97
)
_GRAPH_IPPO = _graph_ppo(
    "graph-ippo", IppoConfig, learning_rate=1.8e-3, update_epochs=9, num_minibatches=2, gamma=0.88
)

PRESETS: Mapping[str, tuple[str, RunConfig]] = MappingProxyType(
    {
        "gacrl": ("GACRL that solves the task: episodes of 25 steps", _GACRL),
        "gacrl-112k": ("GACRL that solves the task, on the paper's budget of 112,500 steps", _GACRL_112K),
        "gacrl-teams": (
            "GACRL for teams of any size: trained with 5 agents, each sees what is near",
            _GACRL_TEAMS,
        ),
        "graph-vdn": (
            "VDN with GACRL's switches: entity graph, symmetry, coverage bonus",
            _GRAPH_VDN,
        ),
        "graph-qmix": ("QMIX with GACRL's switches", _GRAPH_QMIX),
        "graph-mappo": ("MAPPO with GACRL's switches", _GRAPH_MAPPO),
        "graph-ippo": ("IPPO with GACRL's switches", _GRAPH_IPPO),
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


def label(config: RunConfig) -> str:
    """Return what a run of these settings is called: as its preset, or as its algorithm where it has another one."""
    known = PRESETS.get(config.preset)
    same = known is None or known[1].algorithm.name == config.algorithm.name
    return config.preset if same else config.algorithm.name


def preset(name: str = DEFAULT_PRESET) -> RunConfig:
    """Return the settings of a preset. Raises ConfigError with the nearest name for one there is not."""
    if name not in PRESETS:
        raise ConfigError(unknown("preset", name, PRESETS, "see `gacrl presets`"))
    return PRESETS[name][1]
