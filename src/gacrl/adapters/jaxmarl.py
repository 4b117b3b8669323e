"""Our tasks under JaxMARL's API, for its baselines: `reset(key)`, `step(key, state, actions)`, dictionaries."""

from importlib import import_module
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from gacrl import tasks
from gacrl.config import files as configuration
from gacrl.envs.environment import Environment, EnvState
from gacrl.errors import ConfigError
from gacrl.rollout import measured
from gacrl.tasks import own
from gacrl.tasks.task import Task
from gacrl.types import Observation, PRNGKey


class State(NamedTuple):
    """Where an episode stands."""

    inner: EnvState
    seen: Observation
    step: Array
    """Steps taken."""


def to_jaxmarl(task: Any = tasks.DEFAULT, **settings: Any) -> "JaxmarlEnv":
    """Make a task an environment of JaxMARL's kind. It needs JaxMARL for its spaces.

    task: as `gacrl.train` takes it. settings: those of the task. Raises ConfigError, also where JaxMARL is missing.

    >>> env = gacrl.to_jaxmarl("reference")
    >>> observations, state = env.reset(jax.random.key(0))
    """
    name, base = own.bring(task)
    found, chosen = tasks.find(name), configuration.changed(base, settings)
    env: Environment = found.make(chosen)
    if env.hosted or env.continuous_actions:
        what = "lives in Python" if env.hosted else "has continuous actions"
        raise ConfigError(
            f"{name} {what}, and JaxMARL's baselines need discrete actions in JAX: take another task"
        )
    return JaxmarlEnv(found, env, chosen)


class JaxmarlEnv:
    """A task of N agents, who stay up to the episode's end: an absent one sees zeros and earns nothing."""

    def __init__(self, task: Task, env: Environment, settings: Any):
        try:
            spaces = import_module("jaxmarl.environments.spaces")
        except ImportError as error:
            raise ConfigError(
                "to_jaxmarl needs JaxMARL's spaces: install it with `pip install jaxmarl`"
            ) from error
        self.name, self.num_agents, self.max_steps = task.name, env.num_agents, env.max_cycles
        self.agents = [f"agent_{i}" for i in range(env.num_agents)]
        seen, does = spaces.Box(-jnp.inf, jnp.inf, (env.observation_size,)), spaces.Discrete(env.num_actions)
        self.observation_spaces = dict.fromkeys(self.agents, seen)
        self.action_spaces = dict.fromkeys(self.agents, does)
        self._env, self._params = env, task.numbers(settings, env)

    @property
    def agent_classes(self) -> dict[str, list[str]]:
        """All agents are of one class."""
        return {"agents": self.agents}

    def observation_space(self, agent: str) -> Any:
        """Return what this agent sees."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> Any:
        """Return what this agent may do."""
        return self.action_spaces[agent]

    def reset(self, key: PRNGKey) -> tuple[dict[str, Array], State]:
        """Begin an episode."""
        inner, seen = self._env.reset(key, self._params)
        return self._named(seen.features), State(inner, seen, jnp.zeros((), jnp.int32))

    def step(
        self, key: PRNGKey, state: State, actions: dict[str, Array], reset_state: State | None = None
    ) -> tuple[dict[str, Array], State, dict[str, Array], dict[str, Array], dict[str, Array]]:
        """Let every agent act; where the episode ends, return the opening of the next one.

        reset_state: what opens it; drawn by default.
        """
        key, fresh = jax.random.split(key)
        _, after, rewards, dones, infos = self.step_env(key, state, actions)
        opening = self.reset(fresh)[1] if reset_state is None else reset_state
        again = jax.tree.map(lambda new, old: jnp.where(dones["__all__"], new, old), opening, after)
        return self._named(again.seen.features), again, rewards, dones, infos

    def step_env(
        self, key: PRNGKey, state: State, actions: dict[str, Array]
    ) -> tuple[dict[str, Array], State, dict[str, Array], dict[str, Array], dict[str, Array]]:
        """Let every agent act: observations, state, rewards, dones (with `__all__`) and the task's measurements."""
        action = jnp.stack([jnp.asarray(actions[agent], jnp.int32).reshape(()) for agent in self.agents])
        inner, after = self._env.step(state.inner, action, key, self._params)
        over = after.terminated | after.truncated
        dones = dict.fromkeys([*self.agents, "__all__"], over)
        state = State(inner, after.observation, state.step + 1)
        infos = {name: jnp.full(self.num_agents, value) for name, value in measured(after).items()}
        return self._named(after.observation.features), state, self._named(after.reward), dones, infos

    def get_obs(self, state: State) -> dict[str, Array]:
        """Return what is seen in this state."""
        return self._named(state.seen.features)

    def get_avail_actions(self, state: State) -> dict[str, Array]:
        """Return which actions each agent has."""
        return self._named(state.seen.action_mask)

    def _named(self, rows: Float[Array, "N ..."] | Any) -> dict[str, Array]:
        return {agent: rows[i] for i, agent in enumerate(self.agents)}
