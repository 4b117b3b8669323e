"""What an environment is: pure functions over one copy, vmapped by whoever needs many."""

from typing import Any, NamedTuple, Protocol, TypeAlias, runtime_checkable

from jaxtyping import Array, Bool, Float, Int, Key

from gacrl.types import Entities, Metrics, Observation, PRNGKey

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


@runtime_checkable
class BatchEnvironment(Environment, Protocol):
    """A task that knows a quicker way to step many copies than mapping its step."""

    def step_many(
        self, state: EnvState, action: Array, keys: Key[Array, " E"], params: EnvParams | None = None
    ) -> tuple[EnvState, TimeStep]: ...

    def observe_many(self, state: EnvState, params: EnvParams | None = None) -> Observation:
        """What is seen in each copy's state."""
        ...


@runtime_checkable
class SpatialEnvironment(Environment, Protocol):
    """A task in the plane: what graph networks and symmetry augmentation need besides."""

    @property
    def own_size(self) -> int:
        """K of `Entities.own`."""
        ...

    @property
    def num_symmetries(self) -> int:
        """Rotations and reflections under which the task is the same; 0 is the identity."""
        ...

    def entities(self, observation: Observation) -> Entities: ...

    def turn(self, observation: Observation, symmetry: Int[Array, ""]) -> Observation:
        """The observation of the turned world."""
        ...

    def turn_action(self, action: Array, symmetry: Int[Array, ""]) -> Array:
        """The action that does in the turned world what this one does here."""
        ...
