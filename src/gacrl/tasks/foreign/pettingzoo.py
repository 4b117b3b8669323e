"""PettingZoo's parallel environments as tasks: by a function that makes one, or by the module that has one."""

import contextlib
import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from functools import cache, partial
from importlib import import_module
from types import MappingProxyType
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from gacrl.config.checks import unknown
from gacrl.envs.environment import EnvParams, EnvState, TimeStep, as_floats
from gacrl.envs.hosted import Copies, Hosted
from gacrl.errors import ConfigError
from gacrl.tasks import Own
from gacrl.tasks.foreign.arguments import as_settings, plain_arguments, version_of
from gacrl.tasks.foreign.crew import Crew
from gacrl.tasks.foreign.layout import Layout, Padded, Reach, lay_out
from gacrl.tasks.foreign.worlds import Recipe, Scripted
from gacrl.tasks.task import Task
from gacrl.types import PRNGKey

SCHEME = "pettingzoo:"
_NOBODY: Scripted = MappingProxyType({})


def from_pettingzoo(
    make_env: Callable[..., Any],
    name: str | None = None,
    max_cycles: int | None = None,
    scripted: Scripted = _NOBODY,
) -> Task:
    """Make a task of PettingZoo parallel environments with vector observations.

    make_env: makes one, as `simple_spread_v3.parallel_env` does; its keyword arguments that are numbers and names are
    the task's settings, and with `render_mode` among them it can be seen. name: of the task; by default the
    environment's. max_cycles: after how many steps an episode is cut; by default what the environment says.
    scripted: agents that do not learn, each with a function from what it sees to its action.

    Raises ConfigError for an environment that does not fit.

    >>> task = gacrl.from_pettingzoo(simple_spread_v3.parallel_env)
    >>> gacrl.train("gacrl", env=task)
    """
    if not callable(make_env):
        raise ConfigError(
            f"from_pettingzoo needs a function that makes an environment, not {type(make_env).__name__}: give it "
            "`lambda: …`, every copy must be a new one"
        )
    maker = _Maker(make_env, inspect.signature(make_env), max_cycles)
    return _task(name or maker.own_name(), maker, dict(scripted))


def by_name(name: str) -> Own:
    """Return the task that `pettingzoo:MODULE` or `pettingzoo:ID` names, as `--env` has it. Raises ConfigError.

    An ID is one of PettingZoo's registry, which has a slash in it: `sisl/pursuit_v5`.
    """
    named = name.removeprefix(SCHEME)
    spec = _registered(name, named) if "/" in named else None
    if spec is not None and callable(spec.entry_point):
        task = _task(name, _Maker(spec.make, inspect.signature(spec.entry_point)), {})
        return Own(task, task.settings())
    module_name = named if spec is None else str(spec.entry_point).partition(":")[0]
    try:
        module = import_module(module_name)
    except ImportError as error:
        raise ConfigError(
            f"--env {name}: {error}; install it, or name a module that has `parallel_env`"
        ) from error
    make_env = getattr(module, "parallel_env", None) if spec is None else spec.make
    if make_env is None:
        turns = hasattr(module, "env") or hasattr(module, "raw_env")
        raise ConfigError(f"--env {name}: {_turn_based('the module') if turns else 'it has no `parallel_env`'}")
    signature = inspect.signature(getattr(module, "raw_env", make_env))  # parallel_env itself takes **kwargs
    task = _task(name, _Maker(make_env, signature), {})
    return Own(task, task.settings(), digest=version_of(module_name))


def _registered(name: str, named: str) -> Any:
    """Look an environment up in PettingZoo's registry. Raises ConfigError."""
    import pettingzoo
    from pettingzoo.env_registry.exceptions import PettingZooRegistryError

    try:
        return pettingzoo.spec("parallel", named)
    except PettingZooRegistryError as error:
        with contextlib.suppress(PettingZooRegistryError):
            pettingzoo.spec("aec", named)
            raise ConfigError(f"--env {name}: {_turn_based('the environment')}") from error
        known = list(pettingzoo.parallel_registry)
        raise ConfigError(f"--env {name}: {unknown('parallel environment', named, known)}") from error


def _turn_based(what: str) -> str:
    return (
        f"{what} is turn-based (AEC), and gacrl's agents act at once: wrap it by "
        "pettingzoo.utils.conversions.aec_to_parallel and give it to gacrl.from_pettingzoo"
    )


@dataclass(frozen=True, eq=False)
class _Maker:
    """Makes environments, from the settings that its signature has."""

    make_env: Callable[..., Any]
    signature: inspect.Signature
    max_cycles: int | None = None

    def settings(self) -> type:
        """Make a frozen dataclass of the arguments that are numbers and names, and of `max_cycles`."""
        known = plain_arguments(self.signature)
        known.pop("render_mode", None)
        if self.max_cycles is not None or "max_cycles" not in known:
            known["max_cycles"] = (int | None, self.max_cycles)
        return as_settings("ZooSettings", known)

    def takes(self, name: str) -> bool:
        """Return whether it has that argument."""
        parameters = self.signature.parameters
        return name in parameters or any(p.kind is p.VAR_KEYWORD for p in parameters.values())

    def make(self, settings: Any, seen: bool = False) -> Any:
        """Make an environment. Raises ConfigError, with what the environment says, where it cannot be."""
        given = {entry.name: getattr(settings, entry.name) for entry in fields(settings)}
        if not self.takes("max_cycles") or given["max_cycles"] is None:
            del given["max_cycles"]
        if seen and self.takes("render_mode"):
            given["render_mode"] = "rgb_array"
        try:
            return self.make_env(**given)
        except Exception as error:
            raise ConfigError(
                f"the environment cannot be made with {given}: {type(error).__name__}: {error}"
            ) from error

    def own_name(self) -> str:
        """Return what the environment calls itself."""
        env = self.make(self.settings()())
        told = getattr(env, "metadata", None)
        name = told.get("name") if isinstance(told, Mapping) else None
        return name if isinstance(name, str) else getattr(self.make_env, "__name__", "zoo")


def _task(name: str, maker: _Maker, scripted: Scripted) -> Task:
    @cache
    def make(settings: Any) -> Zoo:
        return Zoo.of(name, maker, settings, scripted)

    return Task(
        name=name,
        settings=maker.settings(),
        make=make,
        ragged=lambda settings: True,
        summary="a PettingZoo environment",
    )


@dataclass(frozen=True, eq=False)
class Zoo(Padded, Hosted):  # pyright: ignore[reportIncompatibleVariableOverride]
    """A PettingZoo environment for those of its agents that learn."""

    task: str
    maker: _Maker
    settings: Any
    layout: Layout
    max_cycles: int
    scripted: Scripted
    crew: Crew | None = None
    """The processes in which copies are opened; None: they are opened here."""

    @classmethod
    def of(cls, task: str, maker: _Maker, settings: Any, scripted: Scripted) -> "Zoo":
        """Look an environment over. Raises ConfigError where it does not fit."""
        env = maker.make(settings)
        _require_parallel(task, env)
        agents = list(env.possible_agents)
        strange = sorted(scripted.keys() - set(agents))
        if strange:
            raise ConfigError(f"{task} has no agent {strange[0]!r} to script: it has {', '.join(agents)}")
        learners = [agent for agent in agents if agent not in scripted]
        if not learners:
            raise ConfigError(f"all agents of {task} are scripted: nobody is left to learn")
        seen = {agent: env.observation_space(agent) for agent in learners}
        does = {agent: env.action_space(agent) for agent in learners}
        layout = lay_out(task, learners, seen, does)
        steps = _horizon(task, env, settings.max_cycles)
        env.close()
        return cls(task, maker, settings, layout, steps, scripted)

    def open(self, copies: int, seen: bool = False) -> Copies:
        """Make so many environments."""
        make = partial(self.maker.make, self.settings)
        recipe = Recipe(self.task, make, self.layout, self.max_cycles, dict(self.scripted))
        return recipe.open(copies, seen) if self.crew is None else self.crew.open(recipe, copies, seen)

    def over(self, crew: Crew) -> "Zoo":
        """Return the same whose copies are opened by a crew."""
        return replace(self, crew=crew)

    def close(self) -> None:
        """End the processes, where there are some."""
        if self.crew is not None:
            self.crew.close()

    def step(
        self, state: EnvState, action: Array, key: PRNGKey, params: EnvParams = ()
    ) -> tuple[EnvState, TimeStep]:
        """Return an outcome of zeros, the mean reward among its measurements: of those who acted."""
        state, after = super().step(state, action, key, params)
        return state, after._replace(info={"reward_raw": jnp.zeros(())})

    def stack(self, rows: Any) -> Float[np.ndarray, "N O"]:
        """Lay out what the agents see. Raises ConfigError where it does not fit."""
        rows = [as_floats(row).reshape(-1) for row in rows]
        found = tuple(row.size for row in rows)
        if found != self.layout.sizes:
            raise ConfigError(f"observations must hold {list(self.layout.sizes)} numbers, not {list(found)}")
        features = np.zeros((self.num_agents, self.observation_size), np.float32)
        for place, row in zip(features, rows, strict=True):
            place[: row.size] = row
        features[:, max(self.layout.sizes) :] = self.layout.role_rows
        return features

    def unstack(self, actions: Array | np.ndarray) -> list[Any]:
        """Return the agents' actions as the environment takes them."""
        return [self.layout.action(i, chosen) for i, chosen in enumerate(np.asarray(actions).tolist())]

    def idle(self) -> Float[np.ndarray, "N A"]:
        """Return the actions nearest to 0."""
        shares = np.zeros((self.num_agents, self.num_actions), np.float32)
        for place, acts in zip(shares, self.layout.acts, strict=True):
            if isinstance(acts, Reach):
                place[: acts.count] = acts.idle()
        return shares


def _require_parallel(task: str, env: Any) -> None:
    from pettingzoo import AECEnv

    if isinstance(env, AECEnv):
        raise ConfigError(_turn_based(task))
    lacking = [name for name in ("possible_agents", "reset", "step") if not hasattr(env, name)]
    if lacking:
        raise ConfigError(f"{task} is no PettingZoo parallel environment: it has no `{lacking[0]}`")


def _horizon(task: str, env: Any, asked: int | None) -> int:
    """Steps of an episode: as asked for, or as the environment says."""
    bare = getattr(env, "unwrapped", env)
    inner = getattr(bare, "env", None)  # as the environments of SISL keep theirs
    told = [getattr(of, "max_cycles", None) for of in (env, bare, inner)]
    steps = next((steps for steps in (asked, *told) if steps is not None), None)
    if steps is None:
        raise ConfigError(
            f"{task} does not say how long an episode is: give max_cycles, by which it is cut (--env.max_cycles 100)"
        )
    if not isinstance(steps, int | np.integer) or steps < 1:
        raise ConfigError(f"max_cycles of {task} must be a whole number above 0, not {steps!r}")
    return int(steps)
