"""Environments that live in Python: no program is compiled of them, the host steps their copies one by one."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar, TypeAlias

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt8

from gacrl.envs.environment import Environment, EnvParams, EnvState, TimeStep
from gacrl.types import Observation, PRNGKey

Actions: TypeAlias = Int[np.ndarray, "C N"] | Float[np.ndarray, "C N A"]
"""What the agents of C copies do."""


class Copies(ABC):
    """C copies of an environment, in which episodes are under way.

    What it hands out is never written to again: JAX may still be reading it.
    """

    @abstractmethod
    def begin(self, which: Sequence[int], seeds: Sequence[int] | None = None) -> Observation:
        """Begin an episode in these copies; returns what is seen in all of them [C, …].

        seeds: one for each of them; None: each goes on with its own random numbers. Raises Faulty.
        """

    @abstractmethod
    def step(self, actions: Actions, going: Bool[np.ndarray, " C"] | None = None) -> TimeStep:
        """Step the copies and return what it brought, [C, …] in each of its arrays.

        Of copies that are not `going` the last outcome stands. Raises Faulty.
        """

    @abstractmethod
    def pictures(self, width: int) -> list[UInt8[np.ndarray, "height width 3"]] | None:
        """Draw every copy, at most so many pixels wide; None where the environment cannot be seen."""

    @abstractmethod
    def close(self) -> None:
        """Let go of what the copies hold."""


class Hosted(Environment):
    """An environment that lives in Python. Its `reset` and `step` have the right shapes and nothing in them.

    So whatever asks for shapes (memory, checkpoints, metrics) asks as ever. Whoever plays opens copies instead;
    `rollout.act` refuses to compile a step.
    """

    hosted: ClassVar[bool] = True

    @abstractmethod
    def open(self, copies: int, seen: bool = False) -> Copies:
        """Make so many copies. seen: pictures of them will be asked for."""

    @abstractmethod
    def over(self, crew: Any) -> "Hosted":
        """Return the same environment whose copies are opened in the processes of a crew, until it is closed."""

    @abstractmethod
    def close(self) -> None:
        """Let go of what all copies share."""

    def reset(self, key: PRNGKey, params: EnvParams = ()) -> tuple[EnvState, Observation]:
        """Return an observation of zeros."""
        return (), self.from_features(jnp.zeros((self.num_agents, self.observation_size)))

    def step(
        self, state: EnvState, action: Array, key: PRNGKey, params: EnvParams = ()
    ) -> tuple[EnvState, TimeStep]:
        """Return an outcome of zeros."""
        nobody, never = jnp.zeros(self.num_agents, bool), jnp.zeros((), bool)
        seen = self.reset(key, params)[1]
        return (), TimeStep(seen, jnp.zeros(self.num_agents), never, never, left=nobody)
