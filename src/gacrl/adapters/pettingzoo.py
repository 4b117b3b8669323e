"""Our tasks as PettingZoo's parallel environments, for programs that know nothing of JAX.

Who imports this module has them in PettingZoo's registry as well: `pettingzoo.make("parallel", "gacrl/spread-v0")`.
"""

import secrets
from collections.abc import Mapping
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.spaces import Box, Discrete, Space
from jaxtyping import Array, Float, Int, Key, UInt8
from pettingzoo import ParallelEnv, register
from pettingzoo.utils.conversions import parallel_to_aec

from gacrl import render, tasks
from gacrl.config import files as configuration
from gacrl.config.checks import require, unknown
from gacrl.envs.environment import Environment, EnvParams, EnvState, TimeStep
from gacrl.errors import ConfigError, UserError
from gacrl.evaluation.episodes import Episode, seen_of, sized
from gacrl.evaluation.references import look_of
from gacrl.rollout import measured
from gacrl.scene import Scene
from gacrl.tasks import own
from gacrl.tasks.task import Task
from gacrl.types import Observation

_MODES = ("human", "rgb_array")
_FPS = 10


def to_pettingzoo(task: Any = tasks.DEFAULT, render_mode: str | None = None, **settings: Any) -> "ParallelTask":
    """Make a task a PettingZoo `ParallelEnv`.

    task: as `gacrl.train` takes it: a name, `FILE.py:NAME`, a `Task` or an `Environment`. render_mode: None,
    "rgb_array" or "human". settings: those of the task. Raises ConfigError.

    >>> env = gacrl.to_pettingzoo("spread", num_agents=5, render_mode="rgb_array")
    >>> observations, infos = env.reset(seed=0)
    """
    name, base = own.bring(task)
    require(render_mode is None or render_mode in _MODES, unknown("render_mode", str(render_mode), list(_MODES)))
    return ParallelTask(tasks.find(name), configuration.changed(base, settings), render_mode)


class ParallelTask(ParallelEnv[str, np.ndarray, Any]):
    """A task of N agents, who act at once and stay up to the episode's end.

    An agent that is absent sees zeros, and `infos[agent]["present"]` says so where a task has absent agents. An agent
    that takes an action it does not have (`infos[agent]["action_mask"]`) takes its first available one instead.
    Measurements of the task stand in every agent's info.
    """

    def __init__(self, task: Task, settings: Any, render_mode: str | None = None):
        self.metadata = {
            "name": f"gacrl_{task.name}_v0",
            "render_modes": list(_MODES),
            "render_fps": _FPS,
            "is_parallelizable": True,
        }
        self.render_mode = render_mode
        self._task, self._settings = task, settings
        self._env: Environment = task.make(settings)
        self._params = task.numbers(settings, self._env)
        self.max_cycles = self._env.max_cycles
        self.possible_agents = [f"{task.words.agent}_{i}" for i in range(self._env.num_agents)]
        self.agents = []
        self.observation_spaces = {agent: self._seen() for agent in self.possible_agents}
        self.action_spaces = {agent: self._done() for agent in self.possible_agents}
        state = jax.eval_shape(lambda: _global(self._env.reset(jax.random.key(0), self._params)[1]))
        self.state_space = Box(-np.inf, np.inf, state.shape, np.float32)
        self._key: Key[Array, ""] | None = None
        self._now: tuple[EnvState, Observation] | None = None
        self._reel = None if render_mode is None else _Reel(task, settings, self._params)
        self._window: Any = None

    def _seen(self) -> Space[Any]:
        return Box(-np.inf, np.inf, (self._env.observation_size,), np.float32)

    def _done(self) -> Space[Any]:
        count = self._env.num_actions
        return Box(0.0, 1.0, (count,), np.float32) if self._env.continuous_actions else Discrete(count)

    def observation_space(self, agent: str) -> Space[Any]:
        """Return what this agent sees: the same object at every call."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> Space[Any]:
        """Return what this agent may do: the same object at every call."""
        return self.action_spaces[agent]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, dict[str, Any]]]:
        """Begin an episode. The same seed gives the same episodes from there on, this one and those that follow.

        options: PettingZoo hands them through; a task has none, and ignores them.
        """
        if seed is not None or self._key is None:
            self._key = jax.random.key(secrets.randbits(63) if seed is None else seed)
        self._key, state, seen = _reset(self._env, self._key, self._params)
        self.agents = list(self.possible_agents)
        self._now = state, seen
        if self._reel is not None:
            self._reel.begin(state, seen)
        if self.render_mode == "human":
            self.render()
        return self._observations(seen), self._infos(seen, {})

    def step(self, actions: Mapping[str, Any]) -> tuple[dict[str, Any], ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Let every agent act; returns observations, rewards, terminations, truncations and infos.

        Raises ConfigError for an action that is missing or out of range.
        """
        if not self.agents:
            return {}, {}, {}, {}, {}
        assert self._now is not None and self._key is not None
        state, seen = self._now
        action = self._checked(actions)
        self._key, state, after = _step(self._env, self._key, state, seen, action, self._params)
        self._now = state, after.observation
        if self._reel is not None:
            self._reel.add(state, after)
        rewards, terminated, truncated, measured = jax.device_get(
            (after.reward, after.terminated, after.truncated, after.info)
        )
        names = self.agents
        if terminated or truncated:
            self.agents = []
        if self.render_mode == "human":
            self.render()
        return (
            self._observations(after.observation),
            dict(zip(names, rewards.tolist(), strict=True)),
            dict.fromkeys(names, bool(terminated)),
            dict.fromkeys(names, bool(truncated)),
            self._infos(after.observation, {name: value.item() for name, value in measured.items()}),
        )

    def state(self) -> Float[np.ndarray, " S"]:
        """Return the state that central critics see; of a task that does not say it, all features side by side."""
        if self._now is None:
            raise ConfigError("there is no state before the first reset()")
        return np.asarray(_global(self._now[1]))

    def render(self) -> UInt8[np.ndarray, "height width 3"] | None:
        """Return a picture of where things are; with the mode "human" it is shown in a window instead.

        Raises UserError without a render mode, and for a task that does not say where things are.
        """
        if self._reel is None:
            raise UserError('make the environment with render_mode="rgb_array" to see it')
        if self._now is None:
            raise ConfigError("there is nothing to see before the first reset()")
        picture = self._reel.picture()
        if self.render_mode == "rgb_array":
            return picture
        self._show(picture)
        return None

    def close(self) -> None:
        """Close the window, where there is one."""
        if self._window is not None:
            import pygame

            pygame.display.quit()
            self._window = None

    def _checked(self, actions: Mapping[str, Any]) -> np.ndarray:
        """The agents' actions as an array."""
        missing = [agent for agent in self.agents if agent not in actions]
        require(
            not missing, f"there is no action for {missing[0] if missing else ''}: every agent acts in every step"
        )
        for agent in self.agents:
            if not self.action_spaces[agent].contains(actions[agent]):
                raise ConfigError(
                    f"the action of {agent} is {actions[agent]!r}: it must be in {self.action_spaces[agent]}"
                )
        kind = np.float32 if self._env.continuous_actions else np.int32
        return np.array([actions[agent] for agent in self.possible_agents], kind)

    def _observations(self, seen: Observation) -> dict[str, np.ndarray]:
        return dict(zip(self.possible_agents, np.asarray(seen.features), strict=True))

    def _infos(self, seen: Observation, measured: dict[str, float]) -> dict[str, dict[str, Any]]:
        masks, there = np.asarray(seen.action_mask).astype(np.int8), np.asarray(seen.agent_mask)
        infos = {
            agent: {"action_mask": mask, **measured}
            for agent, mask in zip(self.possible_agents, masks, strict=True)
        }
        if self._task.ragged(self._settings):
            for info, present in zip(infos.values(), there.tolist(), strict=True):
                info["present"] = present
        return infos

    def _show(self, picture: UInt8[np.ndarray, "height width 3"]) -> None:
        import pygame  # comes with MPE2

        height, width, _ = picture.shape
        if self._window is None:
            pygame.display.init()
            self._window = pygame.display.set_mode((width, height))
        self._window.blit(pygame.surfarray.make_surface(picture.swapaxes(0, 1)), (0, 0))
        pygame.event.pump()
        pygame.display.flip()


def _turn_based(task: str, **settings: Any) -> Any:
    return parallel_to_aec(to_pettingzoo(task, **settings))


for _name in (name for name in tasks.names() if tasks.brought(name) is None):
    register("parallel", f"gacrl/{_name}-v0", entry_point=partial(to_pettingzoo, _name))
    register("aec", f"gacrl/{_name}-v0", entry_point=partial(_turn_based, _name))


class _Reel:
    """The episode so far, as pictures need it."""

    def __init__(self, task: Task, settings: Any, params: EnvParams):
        self._task, self._params = task, params
        self._look = jax.jit(partial(seen_of, look_of(task, settings)))

    def begin(self, state: EnvState, seen: Observation) -> None:
        """Forget the episode before, and look at the first moment of this one."""
        self._scenes, self._steps, self._there = [self._seen(state, seen)], list[TimeStep](), [seen.agent_mask]

    def add(self, state: EnvState, after: TimeStep) -> None:
        """Look at the moment after a step."""
        self._scenes.append(self._seen(state, after.observation))
        self._steps.append(after)
        self._there.append(after.observation.agent_mask)

    def _seen(self, state: EnvState, seen: Observation) -> Scene:
        """Raises UserError where there is nothing to see."""
        one = jax.tree.map(lambda leaf: leaf[None], (state, seen))
        scene = self._look(*one, self._params)
        if scene is None:
            raise UserError(
                f"{self._task.name} does not say where things are: give its observations positions, or a scene"
            )
        return jax.device_get(scene)

    def picture(self) -> UInt8[np.ndarray, "height width 3"]:
        """Draw the newest moment; the first one as if nothing happened in a step before it."""
        scenes, there = self._scenes, self._there[:-1]
        rewards = [step.reward for step in self._steps]
        raw = [measured(step)["reward_raw"] for step in self._steps]
        if not rewards:
            scenes, there, rewards, raw = scenes * 2, self._there, [np.zeros(self._there[0].size)], [0.0]
        episode = Episode(
            actions=np.zeros((len(raw), there[0].size), np.int32),
            reward=np.array(rewards),
            reward_raw=np.array(raw),
            agent_mask=np.array(there),
            scene=sized(jax.tree.map(lambda *moments: np.concatenate(moments), *scenes)),
        )
        return np.array(render.frame(episode, len(self._steps), words=self._task.words))


def _global(seen: Observation) -> Float[Array, " S"]:
    return seen.features.reshape(-1) if seen.state is None else seen.state


@partial(jax.jit, static_argnums=0)
def _reset(
    env: Environment, key: Key[Array, ""], params: EnvParams
) -> tuple[Key[Array, ""], EnvState, Observation]:
    key, start = jax.random.split(key)
    return key, *env.reset(start, params)


@partial(jax.jit, static_argnums=0)
def _step(
    env: Environment,
    key: Key[Array, ""],
    state: EnvState,
    seen: Observation,
    action: Array,
    params: EnvParams,
) -> tuple[Key[Array, ""], EnvState, TimeStep]:
    action = action if env.continuous_actions else _available(action, seen)
    key, draw = jax.random.split(key)
    return key, *env.step(state, action, draw, params)


def _available(action: Int[Array, " N"], seen: Observation) -> Int[Array, " N"]:
    """Put its first available action in the place of one that an agent does not have."""
    there = jnp.take_along_axis(seen.action_mask, action[:, None], axis=1)[:, 0]
    return jnp.where(there, action, seen.action_mask.argmax(-1).astype(action.dtype))
