"""The one contract between algorithms and the loop that trains them."""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

from gacrl.algorithms.replay import Replay
from gacrl.networks.agent import AgentNetwork
from gacrl.types import Learner, Memory, Metrics, Policy, PRNGKey, Rollout

Hyper: TypeAlias = Any
"""A pytree of numbers (learning rate, ε₀, …) kept in the learner: a grid of settings maps in one program."""


class Algorithm(NamedTuple):
    """A record of pure functions, as `optax.GradientTransformation` is.

    A learner is opaque to everyone else: what is asked of it, the record says.
    """

    init: Callable[[PRNGKey, Hyper], Learner]
    """Parameters, optimiser, replay, exploration and hyper, in a pytree of named tuples."""
    initial_memory: Callable[[int], Memory]
    """The policy's memory for this many agents: () when feed-forward."""
    policy: Callable[[Learner, bool], Policy]
    """(learner, explore) -> policy. Without exploring it is greedy and draws nothing."""
    update: Callable[[Learner, Rollout, PRNGKey], tuple[Learner, Metrics]]
    """Learn from a rollout [T, E, …]. The same metrics at every call, all scalars."""
    hyper: Hyper
    """The configured numbers, to hand to `init` as they are or varied."""
    acting: Callable[[Learner], Learner] = lambda learner: learner
    """The same learner without what only learning needs, () in its place: `policy` takes it as well."""
    network: Callable[[Learner], AgentNetwork] | None = None
    """The network of the greedy policy, where that takes the largest available number of its head and no more."""
    draws: bool = False
    """The head of that network has logits, by which actions are drawn while learning; otherwise it has values."""
    parameters: Callable[[Learner], Any] = lambda learner: learner
    """The numbers that are learned."""
    learned: Callable[[Learner], Learner] = lambda learner: learner
    """The same learner with no more than another training can start from, () in place of the rest."""
    replay: Callable[[Learner], Replay[Any] | None] = lambda learner: None
    """What it remembers of past experience; None for one that learns on-policy."""
    batch_steps: int = 0
    """Remembered steps that a gradient step takes out of the replay."""
    splits_envs: bool = False
    """Whether the environments of a seed may be spread over several devices."""
    compiled_for_speed: bool = True
    """Whether its program is optimised as far as the compiler can, or compiled quickly where that runs as fast."""
    library_sums: bool = False
    """Whether the compiler hands sums, and not products alone, to its kernel library: it pays along long windows."""
