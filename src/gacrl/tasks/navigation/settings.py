"""The settings and metrics of the navigation tasks. A leaf: it imports no jax."""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal, NamedTuple, TypeAlias

from gacrl.config.checks import between, require, take_types
from gacrl.tasks.task import Metric

Talk: TypeAlias = Literal["messages", "actions"]


class Rules(NamedTuple):
    """What makes one of these tasks: who moves, who seeks a goal, who knows it, and who hears whom."""

    num_agents: int
    landmarks: int
    moves: tuple[bool, ...]
    """Per agent."""
    seeks: tuple[bool, ...]
    """Who has a goal of its own."""
    knows: tuple[int, ...]
    """Whose goal each agent sees; −1: nobody's."""
    hears: tuple[tuple[int, ...], ...]
    """Whom each agent hears."""
    words: int = 0
    """Utterances of an agent that has some among its actions; 0: none have."""
    speaks: tuple[bool, ...] = ()
    """Who has them."""
    colours: tuple[float, float] = (0.0, 1.0)
    """What a goal is shown as: the low number for each landmark that it is not, and the high one for the one that it
    is."""
    bodies: bool = False
    """Whether agents see each other."""
    squared: bool = False
    """Whether the distance to the goal is squared in the reward."""
    named: bool = True
    """Whether everyone sees the landmarks in one order; if not, everyone in an order of its own."""


@dataclass(frozen=True)
class SpeakerListenerSettings:
    """One agent knows the goal and cannot move, the other one moves: MPE2's simple_speaker_listener_v4."""

    max_cycles: int = 25
    """Steps of an episode."""
    talk: Talk = "messages"
    """Symbols that arrive in the same step, or MPE2's own utterance actions, which are heard a step later."""
    goal_bonus: float = 1.0
    """What a step on the own goal (within 0.1) adds to what is learned from; not in MPE2, nor in the metrics."""
    identity: bool = True
    """Whether each agent sees which one it is; not in MPE2."""

    def __post_init__(self) -> None:
        _check(self)

    @property
    def rules(self) -> Rules:
        """Agent 0 speaks, agent 1 listens."""
        return Rules(
            num_agents=2,
            landmarks=3,
            moves=(False, True),
            seeks=(False, True),
            knows=(1, -1),
            hears=((), (0,)),
            words=3,
            speaks=(True, False),
            colours=(0.15, 0.65),
            squared=True,
        )


@dataclass(frozen=True)
class ReferenceSettings:
    """Two agents, and each knows the goal of the other one: MPE2's simple_reference_v3."""

    max_cycles: int = 25
    """Steps of an episode."""
    talk: Talk = "messages"
    """Symbols that arrive in the same step, or MPE2's own utterance actions, which are heard a step later."""
    local_ratio: float = 0.5
    """Weight of one distance in an agent's reward; the mean of both has the rest."""
    goal_bonus: float = 1.0
    """What a step on the own goal (within 0.1) adds to what is learned from; not in MPE2, nor in the metrics."""
    identity: bool = True
    """Whether each agent sees which one it is; not in MPE2."""

    def __post_init__(self) -> None:
        _check(self)
        between("env", self, 0.0, 1.0, "local_ratio")

    @property
    def rules(self) -> Rules:
        """Everyone moves, seeks and speaks."""
        both = (True, True)
        return Rules(
            num_agents=2,
            landmarks=3,
            moves=both,
            seeks=both,
            knows=(1, 0),
            hears=((1,), (0,)),
            words=10,
            speaks=both,
            colours=(0.25, 0.75),
        )


@dataclass(frozen=True)
class ColoursSettings:
    """Each agent must stand on its own landmark, which only the agent before it knows."""

    num_agents: int = 3
    """Agents in the ring; agent i knows the goal of agent i + 1."""
    num_landmarks: int = 3
    """Landmarks; goals are independent, so that two agents may have the same."""
    graph: Literal["ring", "full"] = "ring"
    """Agent i hears the agent before it alone, or everyone: then it must tell who spoke."""
    named: bool = True
    """Landmarks have colours that all agree on; or none, and everyone sees them in an order of its own: then one must
    tell a place."""
    max_cycles: int = 25
    """Steps of an episode."""
    talk: Talk = "messages"
    """Symbols that arrive in the same step; this task has no utterance actions."""
    goal_bonus: float = 1.0
    """What a step on the own goal (within 0.1) adds to what is learned from; not in the metrics."""
    identity: bool = True
    """Whether each agent sees which one it is, and which one each other agent is."""

    def __post_init__(self) -> None:
        _check(self)
        between("env", self, 2, 10, "num_agents", "num_landmarks")

    @property
    def rules(self) -> Rules:
        """Agents in a ring."""
        everyone = range(self.num_agents)
        return Rules(
            num_agents=self.num_agents,
            landmarks=self.num_landmarks,
            moves=(True,) * self.num_agents,
            seeks=(True,) * self.num_agents,
            knows=tuple((i + 1) % self.num_agents for i in everyone),
            hears=tuple(
                ((i - 1) % self.num_agents,) if self.graph == "ring" else tuple(j for j in everyone if j != i)
                for i in everyone
            ),
            bodies=True,
            named=self.named,
        )


NavigationSettings: TypeAlias = SpeakerListenerSettings | ReferenceSettings | ColoursSettings


def _check(settings: NavigationSettings) -> None:
    take_types("env", settings)
    between("env", settings, 1, 1_000_000, "max_cycles")
    between("env", settings, 0.0, 1000.0, "goal_bonus")
    require(
        settings.talk == "messages" or settings.rules.words > 0,
        f"env.talk must be messages, not {settings.talk}: this task has no utterances among its actions",
    )


RADII = ("0.1", "0.2")
"""Arena units within which an agent stands on its goal."""

METRICS: Mapping[str, Metric] = MappingProxyType(
    {
        # MPE2's own reward, the mean over agents: summed, and per step.
        "return_agent_mean": Metric("reward_raw", "sum", label="return"),
        "reward_raw": Metric("reward_raw", "mean"),
        # Whether all who seek a goal stand on it at the end, and which share of them does.
        **{f"success_final_{r}": Metric(f"success_{r}", "last", label=f"success {r}") for r in RADII},
        **{f"reached_final_{r}": Metric(f"reached_{r}", "last") for r in RADII},
        "distance_goal": Metric("distance_goal", "mean", "arena units", False, "distance"),
    }
)
