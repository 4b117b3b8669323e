"""How agents that see and can do different things fit into arrays: padded, masked, and told apart by their role."""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from gacrl.envs.environment import Environment, observe
from gacrl.errors import ConfigError
from gacrl.types import Observation

MOST_CHOICES = 64
"""Of an agent whose action has several parts: the product of their sizes."""


@dataclass(frozen=True)
class Choice:
    """An action that is one of so many: Discrete, or several numbers taken apart."""

    sizes: tuple[int, ...]
    """Of its parts."""
    starts: tuple[int, ...]
    """The smallest number of each part."""
    plain: bool
    """It is a single number."""

    @property
    def count(self) -> int:
        """How many there are."""
        return math.prod(self.sizes)

    def taken(self, choice: int) -> Any:
        """Return what a choice is there: a number, or an array of several."""
        if self.plain:
            return choice + self.starts[0]
        return np.array(np.unravel_index(choice, self.sizes), np.int64) + np.array(self.starts)


@dataclass(frozen=True)
class Reach:
    """An action of numbers between bounds: Box."""

    low: tuple[float, ...]
    high: tuple[float, ...]
    shape: tuple[int, ...]
    dtype: str

    @property
    def count(self) -> int:
        """How many numbers it has."""
        return len(self.low)

    @cached_property
    def _bounds(self) -> Float[np.ndarray, "2 A"]:
        return np.array([self.low, self.high])

    def taken(self, shares: Sequence[float]) -> np.ndarray:
        """Return the numbers that these shares of the way from low to high are."""
        low, high = self._bounds
        numbers = low + np.array(shares[: self.count]) * (high - low)
        return np.minimum(np.maximum(numbers, low), high).astype(self.dtype).reshape(self.shape)

    def idle(self) -> Float[np.ndarray, " A"]:
        """Return the shares of the way at which the numbers are nearest to 0."""
        low, high = self._bounds
        return (np.clip(0.0, low, high) - low) / np.where(high > low, high - low, 1.0)


@dataclass(frozen=True)
class Layout:
    """The agents of a team: what each sees and can do."""

    agents: tuple[str, ...]
    shapes: tuple[tuple[int, ...], ...]
    """Of what each sees; it is laid out in one row."""
    acts: tuple[Choice | Reach, ...]
    """What each can do: all choose, or all have numbers to set."""
    roles: tuple[int, ...]
    """Which agents are alike: those of one name (without its number), who see and can do the same."""

    @cached_property
    def sizes(self) -> tuple[int, ...]:
        """Numbers that each agent sees."""
        return tuple(int(np.prod(shape)) for shape in self.shapes)

    @cached_property
    def role_rows(self) -> Float[np.ndarray, "N R"]:
        """A one-hot of each agent's role; of a team that is all alike, nothing."""
        count = max(self.roles) + 1
        return np.eye(count, dtype=np.float32)[list(self.roles)] if count > 1 else np.zeros((len(self.roles), 0))

    @cached_property
    def observation_size(self) -> int:
        """O: the most that an agent sees, and its role."""
        return max(self.sizes) + self.role_rows.shape[1]

    @cached_property
    def mask(self) -> Bool[np.ndarray, "N A"]:
        """Which actions each agent has, or which numbers its action has."""
        counts = np.array([acts.count for acts in self.acts])
        return np.arange(counts.max()) < counts[:, None]

    @property
    def continuous(self) -> bool:
        """Whether actions are numbers between bounds."""
        return isinstance(self.acts[0], Reach)

    def action(self, agent: int, chosen: Any) -> Any:
        """Return what an agent's action is there."""
        return self.acts[agent].taken(chosen)


class Padded(Environment):
    """An environment whose agents are laid out: its sizes."""

    layout: Layout

    @property
    def num_agents(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        """N: those that learn."""
        return len(self.layout.agents)

    @property
    def num_actions(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        """A: the most that an agent has."""
        return self.layout.mask.shape[1]

    @property
    def continuous_actions(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Whether actions are numbers."""
        return self.layout.continuous

    @property
    def observation_size(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        """O: the most that an agent sees, and its role."""
        return self.layout.observation_size

    def from_features(self, features: Float[Array, "N O"]) -> Observation:
        """Return the observation around bare feature vectors; each agent may do what it can."""
        return observe(features, available=jnp.asarray(self.layout.mask))


def lay_out(task: str, agents: Sequence[str], seen: Mapping[str, Any], does: Mapping[str, Any]) -> Layout:
    """Read Gymnasium's spaces of what agents see and do. Raises ConfigError for one that does not fit."""
    shapes = [_shape(task, agent, seen[agent]) for agent in agents]
    acts = [_acts(task, agent, does[agent]) for agent in agents]
    odd = next((k for k, one in enumerate(acts) if type(one) is not type(acts[0])), None)
    if odd is not None:
        raise ConfigError(
            f"{agents[odd]} of {task} acts by a {type(does[agents[odd]]).__name__} and {agents[0]} by a "
            f"{type(does[agents[0]]).__name__}: in a team that learns together all choose or all set numbers; offer "
            "the one or the other in a wrapper of the environment"
        )
    kinds = [
        (re.sub(r"_?\d+$", "", str(agent)), shape, act)
        for agent, shape, act in zip(agents, shapes, acts, strict=True)
    ]
    known = list(dict.fromkeys(kinds))
    return Layout(
        agents=tuple(agents),
        shapes=tuple(shapes),
        acts=tuple(acts),
        roles=tuple(known.index(kind) for kind in kinds),
    )


def _shape(task: str, agent: str, space: Any) -> tuple[int, ...]:
    kind = type(space).__name__
    if kind != "Box":
        raise ConfigError(
            f"{agent} of {task} sees a {kind}, and gacrl reads vectors (Box): flatten it in a wrapper of the "
            "environment, and hand its action mask out as infos[agent]['action_mask']"
        )
    if np.issubdtype(space.dtype, np.integer) and len(space.shape) > 1:
        raise ConfigError(
            f"{agent} of {task} sees an image of the shape {list(space.shape)}: gacrl has no network for images; "
            "hand out features"
        )
    if 0 in space.shape:
        raise ConfigError(f"{agent} of {task} sees nothing: its space has the shape {list(space.shape)}")
    return tuple(space.shape)


def _acts(task: str, agent: str, space: Any) -> Choice | Reach:
    """What an agent can do."""
    kind = type(space).__name__
    if kind == "Discrete":
        return Choice((int(space.n),), (int(getattr(space, "start", 0)),), True)
    if kind == "Box":
        return _reach(task, agent, space)
    if kind not in ("MultiDiscrete", "MultiBinary"):
        raise ConfigError(
            f"{agent} of {task} acts by a {kind}: gacrl's agents choose among actions (Discrete, MultiDiscrete, "
            "MultiBinary) or set numbers (Box); offer them one of these in a wrapper of the environment"
        )
    sizes = [2] * int(np.prod(space.shape)) if kind == "MultiBinary" else np.ravel(space.nvec).tolist()
    starts = np.ravel(getattr(space, "start", np.zeros(len(sizes)))).astype(int).tolist()
    choice = Choice(tuple(sizes), tuple(starts), False)
    if choice.count > MOST_CHOICES or len(space.shape) != 1:
        raise ConfigError(
            f"{agent} of {task} has {choice.count} actions, {' × '.join(map(str, sizes))}, and at most "
            f"{MOST_CHOICES} are taken apart: offer it fewer in a wrapper of the environment"
        )
    return choice


def _reach(task: str, agent: str, space: Any) -> Reach:
    low, high = np.ravel(space.low).astype(float), np.ravel(space.high).astype(float)
    if not (np.isfinite(low).all() and np.isfinite(high).all() and low.size):
        raise ConfigError(
            f"{agent} of {task} acts by a Box without bounds, {space}: bound it in a wrapper of the environment"
        )
    return Reach(tuple(low.tolist()), tuple(high.tolist()), tuple(space.shape), str(space.dtype))
