"""Episodes of PettingZoo's parallel environments, as arrays of a team; whatever they must not hand out is named."""

import contextlib
import math
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from gacrl.envs.environment import TimeStep
from gacrl.envs.hosted import Actions, Copies
from gacrl.errors import Faulty
from gacrl.tasks.foreign.layout import Layout
from gacrl.types import Observation

Scripted = Mapping[str, Callable[[Any], Any]]
"""What agents that learn nothing do, from what they see."""


class World:
    """One environment: where its episode stands."""

    def __init__(self, task: str, env: Any, layout: Layout, max_cycles: int, scripted: Scripted):
        self.task, self.env, self.layout = task, env, layout
        self.max_cycles, self.scripted = max_cycles, scripted
        count = len(layout.agents)
        self.features = np.zeros((count, layout.observation_size), np.float32)
        self.features[:, max(layout.sizes) :] = layout.role_rows
        self.mask = layout.mask.copy()
        self.there = np.zeros(count, bool)
        self.reward = np.zeros(count, np.float32)
        self.left = np.zeros(count, bool)
        self.terminated = self.truncated = False
        self.raw = 0.0
        self.clock = 0
        self._seen: Mapping[str, Any] = {}

    def begin(self, seed: int | None) -> None:
        """Begin an episode. Raises Faulty."""
        self.clock = 0
        with self._blamed("reset"):
            seen, infos = self.env.reset() if seed is None else self.env.reset(seed=seed)
        agents = set(self.env.agents)
        self.there = np.array([agent in agents for agent in self.layout.agents])
        if not self.there.any():
            raise Faulty(f"{self.task} begins an episode without an agent that learns")
        self.left[:] = False
        self.terminated = self.truncated = False
        self._see(seen, infos, self.there)

    def step(self, choices: Int[np.ndarray, " N"] | Float[np.ndarray, "N A"]) -> None:
        """Take a step. Raises Faulty."""
        acting = [(i, agent) for i, agent in enumerate(self.layout.agents) if self.there[i]]
        actions = {
            agent: self.layout.action(i, choice)
            for (i, agent), choice in zip(acting, choices[self.there].tolist(), strict=True)
        }
        known = set(self.env.agents)
        with self._blamed("step"):
            for agent in known & self.scripted.keys():
                actions[agent] = self.scripted[agent](self._seen[agent])
            seen, rewards, terminated, truncated, infos = self.env.step(actions)
        self.clock += 1
        agents = set(self.env.agents)
        self._require_no_newcomer(agents - known)
        self.reward[:] = 0.0
        self.left[:] = False
        ended, cut = list[int](), list[int]()
        for i, agent in acting:
            self.reward[i] = self._number(agent, rewards)
            if self._flag(agent, terminated):
                ended.append(i)
            elif self._flag(agent, truncated):
                cut.append(i)
            elif agent not in agents:
                raise Faulty(self._told(agent, "is gone, and was neither terminated nor truncated"))
        self.raw = float(self.reward.sum()) / len(acting)
        self._end(ended, cut, len(acting))
        self._see(seen, infos, self.there)

    def picture(self) -> UInt8[np.ndarray, "height width 3"] | None:
        """Draw where things are; None where the environment draws nothing. Raises Faulty."""
        if getattr(self.env, "render_mode", None) is None:
            return None
        with self._blamed("render"):
            drawn = self.env.render()
        return drawn if isinstance(drawn, np.ndarray) else None

    def _end(self, ended: list[int], cut: list[int], acting: int) -> None:
        """End the lives of these agents, who were terminated or truncated; with the last of them ends the episode."""
        over = len(ended) + len(cut) == acting or self.clock >= self.max_cycles
        self.terminated = over and len(ended) == acting
        self.truncated = over and not self.terminated
        if not self.terminated:
            self.left[ended if over else ended + cut] = True
        if not over and (ended or cut):
            self.there = self.there & ~self.left

    def _see(self, seen: Mapping[str, Any], infos: Mapping[str, Any], there: Bool[np.ndarray, " N"]) -> None:
        """Lay out what agents see; those that are gone see zeros."""
        self._seen = seen
        width = max(self.layout.sizes)
        for i, agent in enumerate(self.layout.agents):
            if not there[i]:
                self.features[i, :width] = 0.0
                continue
            if agent not in seen:
                raise Faulty(self._told(agent, "was shown nothing"))
            row, shape = seen[agent], self.layout.shapes[i]
            if np.shape(row) != shape:
                raise Faulty(
                    self._told(agent, f"saw the shape {list(np.shape(row))}, and its space says {list(shape)}")
                )
            self.features[i, : self.layout.sizes[i]] = row if len(shape) == 1 else np.ravel(row)
            self._allow(i, agent, infos)

    def require_finite(self) -> None:
        """Raise Faulty where an agent sees a number that is not finite."""
        bad = np.flatnonzero(~np.isfinite(self.features).all(1))
        if bad.size:
            raise Faulty(self._told(self.layout.agents[bad[0]], "saw a number that is not finite"))

    def _allow(self, i: int, agent: str, infos: Mapping[str, Any]) -> None:
        """Take the action mask of an agent's info, where there is one."""
        info = infos.get(agent)
        if not info or "action_mask" not in info:
            return
        allowed, count = np.ravel(info["action_mask"]).astype(bool), int(self.layout.mask[i].sum())
        if allowed.size != count or not allowed.any():
            raise Faulty(self._told(agent, f"has an action mask that allows none of its {count} actions"))
        self.mask[i, :count] = allowed

    def _number(self, agent: str, rewards: Mapping[str, Any]) -> float:
        if agent not in rewards:
            raise Faulty(self._told(agent, "got no reward"))
        try:
            reward = float(rewards[agent])
        except (TypeError, ValueError):
            raise Faulty(self._told(agent, f"got the reward {rewards[agent]!r}, which is no number")) from None
        if not math.isfinite(reward):
            raise Faulty(self._told(agent, f"got a reward that is not finite, {reward}"))
        return reward

    def _flag(self, agent: str, flags: Mapping[str, Any]) -> bool:
        if agent not in flags:
            raise Faulty(self._told(agent, "was not told whether its episode is over"))
        return bool(flags[agent])

    def _require_no_newcomer(self, late: set[str]) -> None:
        if late:
            raise Faulty(
                self._told(
                    sorted(late)[0], "came after the episode had begun: agents may leave early, not come late"
                )
            )

    def _told(self, agent: str, what: str) -> str:
        when = f"in step {self.clock} of an episode" if self.clock else "as an episode began"
        return f"{agent} of {self.task} {what}, {when}: mend the environment"

    @contextlib.contextmanager
    def _blamed(self, what: str) -> Generator[None]:
        """Raises Faulty, with one sentence, for what the environment raises."""
        try:
            yield
        except Exception as error:
            said = " ".join(str(error).split())[:300]
            raise Faulty(
                f"{self.task} raised {type(error).__name__} in {what}, after {self.clock} steps of an episode"
                f"{': ' if said else ''}{said}; mend the environment"
            ) from error


@dataclass(frozen=True)
class Recipe:
    """How copies of an environment are made, here or in another process."""

    task: str
    make: Callable[[bool], Any]
    """(whether pictures will be asked for) -> a new environment."""
    layout: Layout
    max_cycles: int
    scripted: Scripted

    def open(self, copies: int, seen: bool = False) -> "Worlds":
        """Make so many. Raises ConfigError."""
        return Worlds(
            [World(self.task, self.make(seen), self.layout, self.max_cycles, self.scripted) for _ in range(copies)]
        )


class Worlds(Copies):
    """Several environments, one after the other."""

    def __init__(self, worlds: Sequence[World]):
        self._worlds = worlds

    def begin(self, which: Sequence[int], seeds: Sequence[int] | None = None) -> Observation:
        """Begin episodes."""
        for k, copy in enumerate(which):
            self._worlds[copy].begin(None if seeds is None else seeds[k])
        return self._observation()

    def step(self, actions: Actions, going: Bool[np.ndarray, " C"] | None = None) -> TimeStep:
        """Step those that are going."""
        for k, world in enumerate(self._worlds):
            if going is None or going[k]:
                world.step(actions[k])
        return TimeStep(
            observation=self._observation(),
            reward=self._all("reward"),
            terminated=self._all("terminated"),
            truncated=self._all("truncated"),
            info={"reward_raw": self._all("raw").astype(np.float32)},  # pyright: ignore[reportArgumentType]
            left=self._all("left"),
        )

    def _observation(self) -> Observation:
        features = self._all("features")
        if not np.isfinite(features).all():
            for world in self._worlds:
                world.require_finite()
        return Observation(
            features=features,
            positions=None,
            agent_mask=self._all("there"),
            landmark_mask=None,
            action_mask=self._all("mask"),
        )

    def _all(self, what: str) -> Any:
        return np.array([getattr(world, what) for world in self._worlds])

    def pictures(self, width: int) -> list[UInt8[np.ndarray, "height width 3"]] | None:
        """Draw every environment; None where one draws nothing."""
        drawn = [picture for world in self._worlds if (picture := world.picture()) is not None]
        return [_at_most(picture, width) for picture in drawn] if len(drawn) == len(self._worlds) else None

    def close(self) -> None:
        """Close the environments."""
        for world in self._worlds:
            world.env.close()


def _at_most(picture: Float[np.ndarray, "h w 3"] | Any, width: int) -> UInt8[np.ndarray, "height width 3"]:
    from PIL import Image

    image = Image.fromarray(picture)
    if image.width <= width:
        return picture
    return np.asarray(image.resize((width, max(1, round(image.height * width / image.width)))))
