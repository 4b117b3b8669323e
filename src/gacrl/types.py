"""The containers that pass between the rooms of the house, and the letters of their axes.

    E environments   T time   N agents   L landmarks   O observation   S global state
    Z latent   H hidden   V message symbols   R rounds of messages   A actions   B batch   M metrics

A container is written for one environment at one step; `rollout` puts [T, E] in front of every axis.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

from jaxtyping import Array, Bool, Float, Int, Key, UInt32

PRNGKey: TypeAlias = Key[Array, ""] | UInt32[Array, "_"]
"""A key of `jax.random.key`, or the numbers of one, as `jax.random.PRNGKey` makes them (`environment.typed_keys`)."""
Memory: TypeAlias = Any
"""A pytree that a policy carries from step to step: `()` when feed-forward, a recurrent carry otherwise.

Its arrays have the agents in front; a scalar belongs to the whole team."""
Metrics: TypeAlias = dict[str, Float[Array, ""]]
"""Named scalars of one step or one update."""


class Arrives(NamedTuple):
    """What reaches the listeners of a step, where that is not what was said. Empty, the default: all arrives as sent.

    One primitive for everything that can happen to messages: silence, loss, delay, noise, other agents' words, words of
    another episode, of another program or of a human. Losses hear what was heard when the agents acted.
    """

    values: Float[Array, "*b R N V"] | None = None
    """What arrives of agent j in round r, to everyone who hears j, where `replaced` says so."""
    replaced: Bool[Array, "*b R N"] | None = None
    """Whose words of which round are replaced; None with values: all are."""
    kept: Bool[Array, "*b N N"] | None = None
    """Entry [i, j]: i still hears j. A cut edge counts nowhere, neither in attention nor in means."""


class Observation(NamedTuple):
    """What one environment shows its agents before they act; `gacrl.envs.environment.observe` fills the masks.

    Absent agents and landmarks are False in their mask: they never send, count or earn.
    """

    features: Float[Array, "*b N O"]
    positions: Float[Array, "*b N 2"] | None
    """Where the agents are, for graphs over distance; None where the task has no space."""
    agent_mask: Bool[Array, "*b N"]
    landmark_mask: Bool[Array, "*b L"] | None
    """None where the task has no landmarks, or where all are always there."""
    action_mask: Bool[Array, "*b N A"]
    adjacency: Bool[Array, "*b N N"] | None = None
    """A graph that the task itself prescribes; None leaves it to the algorithm."""
    state: Float[Array, "*b S"] | None = None
    """The global state for central critics; None means the agents' features side by side."""
    arrives: Arrives = Arrives()
    """What reaches the agents of what is said in this step; the rollout fills it where somebody intervenes."""


class Entities(NamedTuple):
    """What an agent sees, taken apart into the things it sees: for networks over graphs of entities.

    Landmarks are places and things, agents are the other ones. Features tell apart what stands at the same place.
    """

    own: Float[Array, "*b N K"]
    """About the agent itself, nothing that depends on where the origin lies."""
    landmarks: Float[Array, "*b N L 2"]
    """From the agent to each landmark."""
    agents: Float[Array, "*b N M 2"]
    """From the agent to each other agent."""
    landmark_mask: Bool[Array, "*b N L"]
    """Which of the landmarks are in sight."""
    agent_mask: Bool[Array, "*b N M"]
    """Which of the other agents are in sight."""
    landmark_features: Float[Array, "*b N L F"] | None = None
    """What is known of each landmark besides: its colour, or that it is marked."""
    agent_features: Float[Array, "*b N M G"] | None = None
    """What is known of each other agent besides."""


class Decision(NamedTuple):
    """What the agents of one environment do, and how they came to it."""

    action: Int[Array, "*b N"] | Float[Array, "*b N A"]
    messages: Float[Array, "*b R N V"] | None = None
    """What each agent sent in each round; rows of an absent agent are 0. None for a policy that says nothing."""
    adjacency: Bool[Array, "*b N N"] | None = None
    """Entry [i, j]: j's message reaches i."""
    extras: Any = ()
    """The algorithm's own, any pytree: value, log-probability, the noise that shaped the decision."""


class Transition(NamedTuple):
    """One step of one environment.

    `next_observation` is taken before any reset, so that a learner can bootstrap at the time limit
    (`truncated`) and not past the end of the task (`terminated`).
    """

    observation: Observation
    decision: Decision
    reward: Float[Array, "*b N"]
    terminated: Bool[Array, "*b"]
    truncated: Bool[Array, "*b"]
    first: Bool[Array, "*b"]
    """This step opened an episode; the policy's memory was fresh."""
    next_observation: Observation
    info: Metrics
    """The task's measurements after the step; `reward_raw` is always among them."""
    left: Bool[Array, "*b N"] | None = None
    """This agent's life ended with the step: nothing that follows in its slot is its own. None: lives are episodes."""


class Rollout(NamedTuple):
    """T steps of E environments, and the policy's memory before them."""

    transitions: Transition
    first_memory: Memory


Policy: TypeAlias = Callable[[Memory, Observation, PRNGKey], tuple[Decision, Memory]]
"""(memory, observation, key) -> (decision, memory), for one environment. Everything that acts uses it."""


class Actor(NamedTuple):
    """A policy that learns nothing, and its memory at an episode's start, both for one environment."""

    policy: Policy
    initial_memory: Memory


Words: TypeAlias = Float[Array, "E R N V"]
"""What the agents of E environments say in the R rounds of a step."""


class Intervention(NamedTuple):
    """What somebody does to the messages of E environments side by side; `gacrl.messages.interventions` has them."""

    name: str
    arrives: Callable[[Any, Callable[[Arrives], Words], Bool[Array, " E"], PRNGKey], Arrives]
    """(state, say, first, key) -> what arrives in this step. `say` asks the agents what they say if this arrives;
    `first` marks environments that begin an episode."""
    init: Callable[[Any], Any] = lambda words: ()
    """What it carries from step to step, for words of this shape: an array, or jax.ShapeDtypeStruct. Raises ConfigError
    for a team it does not fit."""
    follow: Callable[[Any, Words, Bool[Array, " E"]], Any] = lambda state, said, first: state
    """(state, what was said, first) -> what it carries on."""
    told: str = ""
    """What it does, in words that stand beside results."""


Learner: TypeAlias = Any
"""Parameters, optimiser, replay, exploration, hyper: a pytree that only its algorithm looks into."""
