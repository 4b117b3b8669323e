"""The settings of the algorithms and of the network that they share: one frozen dataclass each.

Every default has its home here; what the presets set is in `presets`.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal, NamedTuple, TypeAlias

from gacrl.config.checks import between, require, take_types, unknown
from gacrl.config.kinds import COMMUNICATION, EXPLORATION


@dataclass(frozen=True)
class GacrlPaperConfig:
    """The paper's algorithm, as printed (docs/algorithm.md)."""

    name: ClassVar[str] = "gacrl_paper"
    fixed_team: ClassVar[bool] = True

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
        take_types("algorithm", self)
        between("algorithm", self, 0.0, 1.0, "learning_rate", "learning_rate_end", "epsilon", "epsilon_end")
        between("algorithm", self, 0.0, 1.0, "epsilon_bonus")
        require(
            max(self.epsilon, self.epsilon_end) + self.epsilon_bonus <= 1.0,
            "algorithm.epsilon plus algorithm.epsilon_bonus must not exceed 1, a probability",
        )
        between("algorithm", self, 0.01, 100.0, "temperature", "temperature_end")
        between("algorithm", self, 0.0, 100.0, "temperature_bonus", "critic_weight", "kl_weight")
        between("algorithm", self, 0.0, 1e6, "radius")
        between("algorithm", self, 1, 1_000_000, "batch_size", "replay_capacity", "schedule_episodes")
        between("algorithm", self, 1, 100_000, "latent_size", "vocabulary", "message_hidden")
        for name in ("encoder_hidden", "policy_hidden", "critic_hidden"):
            sizes = getattr(self, name)
            require(
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
    latent_use: Literal["sample", "mean"] = "sample"
    """What agents act and speak on while learning: a sample of the Gaussian code, as in the paper, or its mean."""
    communication: str = "none"
    """What agents send: none, commnet (averages of hidden states), ic3net (the same, through a gate), tarmac (values
    that receivers ask for), dial (regularised units), discrete or soft (Gumbel-Softmax symbols, one-hot when played or
    not), told (all that they see), or a kind of your own (examples/own_messages.py)."""
    rounds: int = 1
    """Rounds of messages within a step (CommNet, IC3Net, TarMAC, symbols)."""
    vocabulary: int = 8
    """Symbols of a message; units of a DIAL message."""
    symbols: Literal["straight_through", "soft"] = "straight_through"
    """Discrete symbols while learning: one-hot with the gradient of the soft sample, or soft; one-hot when played."""
    symbol_noise: float = 1.0
    """Scale of the noise on symbols, and on their gate, while learning."""
    gate: bool = False
    """Agents may say nothing in a round instead of a symbol (discrete, soft)."""
    word_price: float = 0.0
    """A loss for each symbol that is said, so that agents with a gate speak where it pays."""
    signature_size: int = 16
    """Numbers of a TarMAC message by which receivers choose whom to attend to."""
    value_size: int = 32
    """And its numbers that are taken in."""
    speaker_identity: bool = False
    """A listener is told which agent a message comes from; ties the network to the number of agents."""
    second_look: bool = False
    """After the messages, attend once more to the landmarks in sight, by what was heard (graph torso)."""
    look_sharpness: float = 4.0
    """Factor of the second look's attention scores."""
    logit_price: float = 0.0
    """A loss on the mean square of the symbols' logits: who says one word whatever it sees can still change it."""
    seen_slope: float = 0.0
    """What the ReLUs over landmarks let pass of negative numbers (graph torso). At 0 they can lose sight of one
    colour."""
    heard_slope: float = 0.0
    """What the ReLUs of the layers that hear, and of the second look, let pass of negative numbers. At 0 they can fall
    silent before words mean anything, and never hear again (discrete, soft, told)."""
    dial_noise: float = 2.0
    """Standard deviation of the noise on DIAL's units while learning."""
    radius: float = 1.5
    """Agents nearer than this hear each other, where the task has positions."""
    nearest_landmarks: int | None = None
    """The graph torso looks at this many nearest landmarks; none: all in sight."""
    nearest_agents: int | None = None
    """And at this many nearest other agents; symbols are heard from as many."""
    parameters: int | None = None
    """Choose the width so that the acting network has about this many parameters; none: take the width."""

    def __post_init__(self) -> None:
        take_types("algorithm.network", self)
        between("algorithm.network", self, 1, 65_536, "width", "vocabulary", "latent_size")
        between("algorithm.network", self, 1, 65_536, "signature_size", "value_size")
        between("algorithm.network", self, 1, 65_536, "nearest_landmarks", "nearest_agents")
        between("algorithm.network", self, 1, 100, "depth", "rounds")
        between("algorithm.network", self, 0.0, 1.0, "seen_slope", "heard_slope")
        between("algorithm.network", self, 0.0, 100.0, "dial_noise", "symbol_noise", "look_sharpness")
        between("algorithm.network", self, 0.0, 1e6, "radius", "word_price", "logit_price")
        between("algorithm.network", self, 1, 1_000_000_000, "parameters")
        require(
            self.torso == "graph" or not self.second_look,
            "algorithm.network.second_look needs algorithm.network.torso graph, which tells landmarks apart",
        )
        kind = self.communication
        require(kind in COMMUNICATION, unknown("algorithm.network.communication", kind, COMMUNICATION))
        require(
            kind in ("discrete", "soft") or not self.gate,
            f"algorithm.network.gate needs algorithm.network.communication discrete or soft, not {kind}",
        )
        require(
            self.gate or not self.word_price,
            "algorithm.network.word_price needs algorithm.network.gate: agents without it cannot say less",
        )


@dataclass(frozen=True)
class LearningConfig:
    """Set what every learner has: its network, its horizon, its step size, and the symmetry of the task."""

    learns_code: ClassVar[bool] = False
    """Whether there is a loss for the network's code."""
    fixed_team: ClassVar[bool] = False
    """Whether no agent may be absent, and no other number of agents can be played with."""

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
    """Turn what is learned from by a random one of the task's symmetries; a memory then starts empty."""
    symmetric_play: bool = False
    """Play greedily by the mean over the task's symmetries, eight for spread: eight times the messages."""
    reward: Literal["team", "own"] = "team"
    """Every agent earns the team's mean reward, or its own. Values of the team (GACRL, QMIX, VDN) are learned from
    the mean in any case."""
    exploration: str = "linear"
    """The rule by which random actions and the temperature of messages fall: none (no random actions), linear in time,
    fixed at their end, adaptive (as the task's progress rises), yoked (as the progress of another training rose), or
    one of your own (examples/own_exploration.py)."""
    epsilon: float = 1.0
    """Share of random actions at the start, or while no progress is made."""
    epsilon_end: float = 0.05
    """And at the end, or when all is done."""
    temperature: float = 1.0
    """Gumbel-Softmax temperature of the symbols at the start, or while no progress is made."""
    temperature_end: float = 1.0
    """And at the end, or when all is done."""
    exploration_steps: int = 50_000
    """Environment steps over which both fall, where they follow time."""
    greedy_share: float = 0.2
    """Share of the training episodes that are played greedily, to see the progress that is made without exploring."""
    yoked_progress: tuple[float, ...] = ()
    """The progress to follow, at even spaces over the planned environment steps."""

    def __post_init__(self) -> None:
        take_types("algorithm", self)
        between("algorithm", self, 0.0, 1.0, "learning_rate", "learning_rate_end", "gamma")
        between("algorithm", self, 0, 1_000, "n_step")
        between("algorithm", self, 1e-6, 1e6, "max_grad_norm")
        between("algorithm", self, 0.0, 1.0, "epsilon", "epsilon_end", "greedy_share")
        between("algorithm", self, 0.01, 100.0, "temperature", "temperature_end")
        between("algorithm", self, 0, 1_000_000_000, "exploration_steps")
        rule = self.exploration
        require(rule in EXPLORATION, unknown("algorithm.exploration", rule, EXPLORATION))
        require(
            all(0.0 <= progress <= 1.0 for progress in self.yoked_progress),
            "algorithm.yoked_progress must be shares between 0 and 1",
        )
        require(
            self.network.latent == "none" or self.learns_code,
            "algorithm.network.latent needs a learner that trains the code, which gacrl does: leave it none",
        )


@dataclass(frozen=True)
class PpoConfig(LearningConfig):
    """Proximal policy optimisation of a team with shared weights; MAPPO and IPPO differ by the critic's view."""

    n_step: int = 0
    """Rewards in a target before it bootstraps; 0 leaves it to gae_lambda."""
    exploration: str = "none"
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
        between("algorithm", self, 0.0, 1.0, "gae_lambda")
        between("algorithm", self, 1, 10_000, "update_epochs", "num_minibatches")
        between("algorithm", self, 1e-6, 1e6, "clip_eps", "huber_delta")
        between("algorithm", self, 0.0, 1e6, "ent_coef", "ent_coef_end", "vf_coef")


@dataclass(frozen=True)
class MappoConfig(PpoConfig):
    """MAPPO (Yu et al. 2022): the critic sees the global state besides the agent's observation."""

    name: ClassVar[str] = "mappo"


@dataclass(frozen=True)
class IppoConfig(PpoConfig):
    """IPPO (de Witt et al. 2020): the critic sees what its agent sees."""

    name: ClassVar[str] = "ippo"


@dataclass(frozen=True)
class CommnetConfig(PpoConfig):
    """CommNet (Sukhbaatar et al. 2016): IPPO whose agents average each other's hidden states, in two rounds."""

    name: ClassVar[str] = "commnet"

    network: NetworkConfig = field(default_factory=lambda: NetworkConfig(communication="commnet", rounds=2))


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
    monotonic mixer's units saturate far below it). Once an episode has ended by itself the mean stays where it is."""
    double_q: bool = True
    """The online network chooses the action that the target network values."""
    averaged: bool = False
    """Play greedily with the target network, a running mean of the parameters."""

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self.n_step >= 1, "algorithm.n_step must be at least 1 where there is no gae_lambda")
        between("algorithm", self, 1, 10_000_000, "replay_capacity", "batch_size", "sequence_length")
        between("algorithm", self, 0, 1_000_000_000, "learning_starts")
        between("algorithm", self, 1, 1_000_000, "updates")
        between("algorithm", self, 0.0, 1.0, "target_step")


@dataclass(frozen=True)
class QmixConfig(QLearningConfig):
    """QMIX (Rashid et al. 2018): the team's value is a monotonic network of the agents' values."""

    name: ClassVar[str] = "qmix"

    mixer_width: int = 32
    """Units of the mixing network."""

    def __post_init__(self) -> None:
        super().__post_init__()
        between("algorithm", self, 1, 10_000, "mixer_width")


@dataclass(frozen=True)
class VdnConfig(QLearningConfig):
    """VDN (Sunehag et al. 2018): the team's value is the sum of the agents' values."""

    name: ClassVar[str] = "vdn"


@dataclass(frozen=True)
class IqlConfig(QLearningConfig):
    """IQL (Tan 1993): each agent learns its value by itself."""

    name: ClassVar[str] = "iql"


@dataclass(frozen=True)
class DialConfig(QLearningConfig):
    """DIAL (Foerster et al. 2016): VDN through messages that are noisy units while learning and bits when played."""

    name: ClassVar[str] = "dial"

    network: NetworkConfig = field(default_factory=lambda: NetworkConfig(communication="dial", recurrent=True))
    sequence_length: int = 8


@dataclass(frozen=True)
class GacrlConfig(QLearningConfig):
    """GACRL that solves the task: the paper's four ideas on a learner that uses them (docs/algorithm.md)."""

    name: ClassVar[str] = "gacrl"
    learns_code: ClassVar[bool] = True

    critic: Literal["told", "central", "sum"] = "central"
    """Q_tot is a central value plus the agents' advantages, or the sum of their values (as VDN); told: central, of
    agents who are told what the others see, and from whom those who act learn what each action loses."""
    teacher_rounds: int = 1
    """Rounds in which those are told (critic told): after the first each hears what the others made of it."""
    latent_weight: float = 1e-3
    """Weight of the code's loss: reconstruction and KL divergence."""
    exploration: str = "adaptive"
    temperature: float = 2.0
    temperature_end: float = 0.5
    exploration_steps: int = 12_000
    averaged: bool = True

    def __post_init__(self) -> None:
        super().__post_init__()
        between("algorithm", self, 0.0, 1e6, "latent_weight")
        between("algorithm", self, 1, 100, "teacher_rounds")


AlgorithmConfig: TypeAlias = Any
"""Any algorithm's settings: a frozen dataclass with a `name`."""


class Kind(NamedTuple):
    """An algorithm that can be chosen by name."""

    settings: type
    """A frozen dataclass; usually a `LearningConfig`."""
    make: str | Callable[..., Any]
    """(settings, environment, TrainingConfig, measure of progress) -> Algorithm; or where that function is."""


ALGORITHMS: dict[str, Kind] = {
    "gacrl_paper": Kind(GacrlPaperConfig, "gacrl.algorithms.gacrl_paper:make"),
    "gacrl": Kind(GacrlConfig, "gacrl.algorithms.gacrl:make"),
    "mappo": Kind(MappoConfig, "gacrl.algorithms.mappo:make"),
    "ippo": Kind(IppoConfig, "gacrl.algorithms.ippo:make"),
    "commnet": Kind(CommnetConfig, "gacrl.algorithms.commnet:make"),
    "qmix": Kind(QmixConfig, "gacrl.algorithms.qmix:make"),
    "vdn": Kind(VdnConfig, "gacrl.algorithms.vdn:make"),
    "iql": Kind(IqlConfig, "gacrl.algorithms.iql:make"),
    "dial": Kind(DialConfig, "gacrl.algorithms.dial:make"),
}
"""One line adds another (examples/own_algorithm.py)."""
