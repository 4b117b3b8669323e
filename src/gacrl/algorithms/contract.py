"""The one contract between algorithms and the loop that trains them."""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

from gacrl.types import Learner, Memory, Metrics, Policy, PRNGKey, Rollout

Hyper: TypeAlias = Any
"""A pytree of numbers (learning rate, ε₀, …) kept in the learner: a grid of settings maps in one program."""


class Algorithm(NamedTuple):
    """A record of pure functions, as `optax.GradientTransformation` is."""

    init: Callable[[PRNGKey, Hyper], Learner]
    """Parameters, optimiser, replay, exploration and hyper, in a pytree that is opaque to the loop."""
    initial_memory: Callable[[int], Memory]
    """The policy's memory for this many agents: () when feed-forward."""
    policy: Callable[[Learner, bool], Policy]
    """(learner, explore) -> policy. Without exploring it is greedy and draws nothing."""
    update: Callable[[Learner, Rollout, PRNGKey], tuple[Learner, Metrics]]
    """Learn from a rollout [T, E, …]. The same metrics at every call, all scalars."""
    hyper: Hyper
    """The configured numbers, to hand to `init` as they are or varied."""
