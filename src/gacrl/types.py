"""The containers that pass between the rooms of the house, and the letters of their axes.

    E environments   T time   N agents   L landmarks   O observation   S global state
    Z latent   H hidden   V message symbols   A actions   B batch   M metrics

A container is written for one environment at one step; `rollout` puts [T, E] in front of every axis.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

from jaxtyping import Array, Bool, Float, Int, Key

PRNGKey: TypeAlias = Key[Array, ""]
Memory: TypeAlias = Any
"""A pytree: what a policy carries from step to step: `()` when feed-forward, a recurrent carry otherwise."""
Metrics: TypeAlias = dict[str, Float[Array, ""]]
"""Named scalars of one step or one update."""


class Observation(NamedTuple):
    """What one environment shows its agents before they act.

    Padded agents and landmarks are False in their mask: they never send, count or earn.
    """

    features: Float[Array, "*b N O"]
    positions: Float[Array, "*b N 2"] | None
    """Where the agents are, for graphs over distance; None where the task has no space."""
    agent_mask: Bool[Array, "*b N"]
    landmark_mask: Bool[Array, "*b L"]
    action_mask: Bool[Array, "*b N A"]
    adjacency: Bool[Array, "*b N N"] | None = None
    """A graph that the task itself prescribes; None leaves it to the algorithm."""
    state: Float[Array, "*b S"] | None = None
    """The global state for central critics; None means the agents' features side by side."""


class Entities(NamedTuple):
    """What an agent sees, taken apart into the things it sees: for networks over graphs of entities."""

    own: Float[Array, "*b N K"]
    """About the agent itself, nothing that depends on where the origin lies."""
    landmarks: Float[Array, "*b N L 2"]
    """From the agent to each landmark in sight; (0, 0) is padding."""
    agents: Float[Array, "*b N M 2"]
    """From the agent to each other agent in sight; (0, 0) is padding."""


class Decision(NamedTuple):
    """What the agents of one environment do, and how they came to it."""

    action: Int[Array, "*b N"] | Float[Array, "*b N A"]
    message: Float[Array, "*b N V"] | None = None
    """What each agent sent; rows of a padded agent are 0."""
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
    """The task's measurements after the step (names: `gacrl.evaluation.metrics`)."""


class Rollout(NamedTuple):
    """T steps of E environments, and the policy's memory before and after them."""

    transitions: Transition
    first_memory: Memory
    last_memory: Memory


class Channel(NamedTuple):
    """What happens to messages on their way. None, the default everywhere, leaves them as they were sent.

    The same mechanism silences, delays, scrambles and translates, in training, analysis and viewer.
    """

    edge_keep: Float[Array, "N N"] | None = None
    """Entry [i, j]: 1 lets j's messages reach i, 0 silences them."""
    symbol_map: Float[Array, "N V V"] | None = None
    """Entry [j, v]: the distribution over symbols that j's symbol v arrives as."""
    delay: Int[Array, ""] | None = None
    """Steps that a message is under way; needs a policy memory made by `networks.messages.mailbox`."""
    noise: Float[Array, ""] | None = None
    """Probability that a message is replaced by a random symbol."""


Policy: TypeAlias = Callable[[Memory, Observation, PRNGKey, Channel], tuple[Decision, Memory]]
"""(memory, observation, key, channel) -> (decision, memory), for one environment. Everything that acts uses it."""

Learner: TypeAlias = Any
"""Parameters, optimiser, replay, exploration, hyper: a pytree that only its algorithm looks into."""
