"""How agents that see and can do different things fit into arrays: padded, masked, and told apart by their role."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from gacrl.envs.environment import Environment
from gacrl.errors import ConfigError

MOST_CHOICES = 64
"""Of an agent whose action has several parts: the product of their sizes."""


@dataclass(frozen=True)
class Layout:
    """The agents of a team: what each sees and can do."""

    agents: tuple[str, ...]
    shapes: tuple[tuple[int, ...], ...]
    """Of what each sees; it is laid out in one row."""
    choices: tuple[tuple[int, ...], ...]
    """Sizes of the parts of each agent's action."""
    starts: tuple[tuple[int, ...], ...]
    """The smallest number of each part."""
    plain: tuple[bool, ...]
    """Its action is a single number."""
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
        """Which actions each agent has."""
        counts = np.array([int(np.prod(parts)) for parts in self.choices])
        return np.arange(counts.max()) < counts[:, None]

    def action(self, agent: int, choice: int) -> Any:
        """What an agent's choice is there: a number, or an array of several."""
        if self.plain[agent]:
            return choice + self.starts[agent][0]
        parts = np.unravel_index(choice, self.choices[agent])
        return np.array(parts, np.int64) + np.array(self.starts[agent])


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
    def observation_size(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        """O: the most that an agent sees, and its role."""
        return self.layout.observation_size


def lay_out(task: str, agents: Sequence[str], seen: Mapping[str, Any], does: Mapping[str, Any]) -> Layout:
    """Read Gymnasium's spaces of what agents see and do. Raises ConfigError for one that does not fit."""
    shapes = [_shape(task, agent, seen[agent]) for agent in agents]
    parts = [_parts(task, agent, does[agent]) for agent in agents]
    kinds = [
        (re.sub(r"_?\d+$", "", str(agent)), shape, part)
        for agent, shape, part in zip(agents, shapes, parts, strict=True)
    ]
    known = list(dict.fromkeys(kinds))
    return Layout(
        agents=tuple(agents),
        shapes=tuple(shapes),
        choices=tuple(sizes for sizes, _, _ in parts),
        starts=tuple(starts for _, starts, _ in parts),
        plain=tuple(plain for _, _, plain in parts),
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


def _parts(task: str, agent: str, space: Any) -> tuple[tuple[int, ...], tuple[int, ...], bool]:
    """Sizes and first numbers of the parts of an action, and whether it is a single number."""
    kind = type(space).__name__
    if kind == "Discrete":
        return (int(space.n),), (int(getattr(space, "start", 0)),), True
    if kind not in ("MultiDiscrete", "MultiBinary"):
        raise ConfigError(
            f"{agent} of {task} acts by a {kind}: gacrl's agents choose among actions (Discrete, MultiDiscrete, "
            "MultiBinary); offer them a choice in a wrapper of the environment"
        )
    sizes = [2] * int(np.prod(space.shape)) if kind == "MultiBinary" else np.ravel(space.nvec).tolist()
    starts = np.ravel(getattr(space, "start", np.zeros(len(sizes)))).astype(int).tolist()
    if np.prod(sizes) > MOST_CHOICES or len(space.shape) != 1:
        raise ConfigError(
            f"{agent} of {task} has {int(np.prod(sizes))} actions, {' × '.join(map(str, sizes))}, and at most "
            f"{MOST_CHOICES} are taken apart: offer it fewer in a wrapper of the environment"
        )
    return tuple(sizes), tuple(starts), False
