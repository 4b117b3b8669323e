"""JaxMARL's environments as tasks: compiled as our own are, with its rewards and its lengths of episodes."""

import inspect
from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import cache
from importlib import import_module
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int

from gacrl.envs.environment import EnvParams, EnvState, TimeStep, observe
from gacrl.errors import ConfigError
from gacrl.tasks import Own
from gacrl.tasks.foreign.arguments import as_settings, plain_arguments, version_of
from gacrl.tasks.foreign.layout import Choice, Layout, Padded, lay_out
from gacrl.tasks.task import Task
from gacrl.types import Observation, PRNGKey

SCHEME = "jaxmarl:"


def by_name(name: str) -> Own:
    """Return the task that `jaxmarl:NAME` names, as `--env` has it. Raises ConfigError."""
    plain = _made(name, {})
    arguments = plain_arguments(inspect.signature(type(plain).__init__))
    if "max_steps" not in arguments:
        arguments["max_steps"] = (int | None, None)

    @cache
    def make(settings: Any) -> JaxmarlTask:
        given = {entry.name: getattr(settings, entry.name) for entry in fields(settings)}
        changed = {key: value for key, value in given.items() if value != arguments[key][1]}
        if "max_steps" not in inspect.signature(type(plain).__init__).parameters:
            changed.pop("max_steps", None)
        return _task_of(name, _made(name, changed), given["max_steps"])

    settings = as_settings("JaxmarlSettings", arguments)
    task = Task(name, settings, make, ragged=lambda settings: True, summary="an environment of JaxMARL")
    return Own(task, settings(), digest=version_of("jaxmarl"))


def _made(name: str, arguments: dict[str, Any]) -> Any:
    try:
        return import_module("jaxmarl").make(name.removeprefix(SCHEME), **arguments)
    except ImportError as error:
        hint = "; install it with `pip install jaxmarl`" if error.name == "jaxmarl" else ""
        raise ConfigError(f"--env {name}: {error}{hint}") from error
    except Exception as error:
        raise ConfigError(f"--env {name}: {type(error).__name__}: {' '.join(str(error).split())}") from error


def _task_of(name: str, env: Any, max_steps: int | None) -> "JaxmarlTask":
    """Look an environment over."""
    agents = list(env.agents)
    shown = jax.eval_shape(env.reset, jax.random.key(0))[0]
    if not isinstance(shown, Mapping) or not set(agents) <= set(shown):
        raise ConfigError(
            f"{name} does not name its agents in what it shows: wrap it in an environment of your own"
        )
    seen = {agent: _space_of(shown[agent]) for agent in agents}
    layout = lay_out(name, agents, seen, {agent: env.action_space(agent) for agent in agents})
    if not all(isinstance(acts, Choice) and acts.plain for acts in layout.acts):
        raise ConfigError(
            f"{name} has continuous actions or several parts: gacrl takes those of JaxMARL that are Discrete"
        )
    steps = getattr(env, "max_steps", None) if max_steps is None else max_steps
    if not isinstance(steps, int | np.integer) or steps < 1:
        raise ConfigError(f"{name} does not say how long an episode is: give --env.max-steps 100")
    return JaxmarlTask(name, env, layout, int(steps) + 1, _masks(env))


class Box(NamedTuple):
    """What an agent sees; layers of ones and zeros are no picture."""

    shape: tuple[int, ...]
    dtype: Any = np.dtype(np.float32)


def _space_of(shown: Any) -> Any:
    """Read what an agent sees from what it is shown: its spaces do not always say it."""
    return Box(shown.shape) if hasattr(shown, "shape") else shown


def _masks(env: Any) -> bool:
    """Whether it says which actions are available."""

    def ask() -> Any:
        return env.get_avail_actions(env.reset(jax.random.key(0))[1])

    try:
        return jax.eval_shape(ask) is not None
    except (NotImplementedError, AttributeError):
        return False


@dataclass(frozen=True, eq=False)
class JaxmarlTask(Padded):
    """An environment of JaxMARL.

    Its episodes may have `max_steps` + 1 steps, where it looks at the clock before it counts. It does not tell a time
    limit from an end: an episode that is over after `max_steps` counts as truncated here.
    """

    task: str
    env: Any
    layout: Layout
    max_cycles: int
    masks: bool

    def reset(self, key: PRNGKey, params: EnvParams = ()) -> tuple[EnvState, Observation]:
        """Begin an episode."""
        seen, inner = self.env.reset(key)
        there = jnp.ones(self.num_agents, bool)
        return (inner, there, jnp.zeros((), jnp.int32)), self._observation(seen, inner, there)

    def step(
        self, state: EnvState, action: Array, key: PRNGKey, params: EnvParams = ()
    ) -> tuple[EnvState, TimeStep]:
        """Let every agent act once."""
        inner, there, clock = state
        agents = self.layout.agents
        actions = {agent: action[i] for i, agent in enumerate(agents)}
        seen, inner, rewards, dones, _ = self.env.step_env(key, inner, actions)
        clock = clock + 1
        reward = jnp.stack([jnp.asarray(rewards[agent], jnp.float32).reshape(()) for agent in agents])
        done = jnp.stack([jnp.asarray(dones[agent], bool).reshape(()) for agent in agents])
        over = jnp.asarray(dones["__all__"], bool).reshape(())
        limit = clock >= self.max_cycles - 1
        mean = jnp.where(there, reward, 0.0).sum() / jnp.maximum(there.sum(), 1)
        left = there & done & ~over
        still = there & ~left
        step = TimeStep(
            observation=self._observation(seen, inner, still),
            reward=jnp.where(there, reward, 0.0),
            terminated=over & ~limit,
            truncated=(over & limit) | (clock >= self.max_cycles),
            info={"reward_raw": mean},
            left=left,
        )
        return (inner, still, clock), step

    def _observation(self, seen: Any, inner: Any, there: Bool[Array, " N"]) -> Observation:
        rows = [
            jnp.pad(jnp.asarray(seen[agent], jnp.float32).reshape(-1), (0, max(self.layout.sizes) - size))
            for agent, size in zip(self.layout.agents, self.layout.sizes, strict=True)
        ]
        features = jnp.where(there[:, None], jnp.stack(rows), 0.0)
        features = jnp.concatenate([features, jnp.asarray(self.layout.role_rows, jnp.float32)], axis=1)
        available = jnp.asarray(self.layout.mask)
        if self.masks:
            told = self._available(inner)
            available = jnp.where((told & available).any(-1, keepdims=True), told & available, available)
        return observe(features, available=available, alive=there)

    def _available(self, inner: Any) -> Bool[Array, "N A"]:
        """What it says to be available; an agent that has nothing is given all."""
        told = self.env.get_avail_actions(inner)
        rows = [jnp.asarray(told[agent]).reshape(-1).astype(bool) for agent in self.layout.agents]
        return jnp.stack([jnp.pad(row, (0, self.num_actions - row.size)) for row in rows])

    def unstack(self, actions: Int[Array, " N"] | np.ndarray) -> list[Any]:
        """Return the agents' actions one by one."""
        return [int(action) for action in actions]
