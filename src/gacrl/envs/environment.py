"""What an environment is: pure functions over one copy, vmapped by whoever needs many."""

from typing import Any, NamedTuple, Protocol, TypeAlias, runtime_checkable

from jaxtyping import Array, Bool, Float

from gacrl.types import Metrics, Observation, PRNGKey

EnvState: TypeAlias = Any
EnvParams: TypeAlias = Any
"""A pytree of numbers (physics, difficulty): changing them never recompiles."""


class TimeStep(NamedTuple):
    """What a step brings. The observation is the one before any reset."""

    observation: Observation
    reward: Float[Array, " N"]
    terminated: Bool[Array, ""]
    """The task is over: nothing follows that could be bootstrapped from."""
    truncated: Bool[Array, ""]
    """The time limit was reached: the task would have gone on."""
    info: Metrics
    """Measurements after the step; `reward_raw` is always among them."""


@runtime_checkable
class Environment(Protocol):
    """A task for N agents. Write it for one copy; resets after an episode's end are the rollout's."""

    @property
    def num_agents(self) -> int: ...
    @property
    def num_landmarks(self) -> int: ...
    @property
    def num_actions(self) -> int: ...
    @property
    def observation_size(self) -> int: ...
    @property
    def max_cycles(self) -> int:
        """Steps until the time limit."""
        ...

    @property
    def continuous_actions(self) -> bool:
        """Actions are [N, A] numbers in [0, 1] instead of [N] indices."""
        ...

    def default_params(self) -> EnvParams: ...

    def reset(self, key: PRNGKey, params: EnvParams | None = None) -> tuple[EnvState, Observation]: ...

    def step(
        self, state: EnvState, action: Array, key: PRNGKey, params: EnvParams | None = None
    ) -> tuple[EnvState, TimeStep]: ...
