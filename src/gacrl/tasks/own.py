"""A task that a user brings: from `FILE.py:NAME`, or as a Python object; looked over before it is played.

NAME is a `Task`, a subclass of `Environment` (the fields of a dataclass are its settings) or an instance of one. A
file runs only because whoever calls names it.
"""

import contextlib
import hashlib
import importlib.util
import sys
import traceback
from collections.abc import Generator, Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gacrl import tasks
from gacrl.config.checks import unknown
from gacrl.envs.environment import Environment, TimeStep
from gacrl.errors import ConfigError, UserError, reason
from gacrl.scene import Scene
from gacrl.tasks import Own
from gacrl.tasks.foreign import jaxmarl, pettingzoo
from gacrl.tasks.task import RETURN, Task
from gacrl.types import Observation

_SCHEMES = {pettingzoo.SCHEME: pettingzoo.by_name, jaxmarl.SCHEME: jaxmarl.by_name}
"""Environments of other libraries, by how their names begin."""
_SIZES = ("num_agents", "num_actions", "observation_size", "max_cycles")


@dataclass(frozen=True)
class NoSettings:
    """Of a task that has none."""


def bring(env: Any) -> tuple[str, Any]:
    """Have a task at hand; returns its name, and the settings that stand where none are said.

    env: the name of a task, `FILE.py:NAME`, `pettingzoo:MODULE`, `jaxmarl:NAME`, a `Task`, a subclass of `Environment`
    or an instance of one. Raises ConfigError, with one sentence, for what is none of these, or for a task that does not
    keep its word.
    """
    if isinstance(env, str):
        name = _by_name(env)
        return name, tasks.default_settings(name)
    ours = tasks.ours(env)
    if ours is not None:
        return ours
    own = _with_plain_numbers(_record(env, getattr(env, "__name__", type(env).__name__)))
    examine(own)
    tasks.bring(own)
    return own.task.name, own.settings


def _by_name(name: str) -> str:
    scheme = next((scheme for scheme in _SCHEMES if name.startswith(scheme)), None)
    if scheme is not None:
        own = _SCHEMES[scheme](name)
        examine(own)
        tasks.bring(own)
        return name
    path, colon, attribute = name.rpartition(":")
    if not colon or not path.endswith(".py"):
        tasks.find(name)
        return name
    source = Path(path).absolute()  # wherever the process goes later
    with blamed(source):
        thing = _load(source, attribute)
        own = _with_plain_numbers(_record(thing, attribute))
    own = replace(own, source=source, given=Path(path), digest=hashlib.sha256(source.read_bytes()).hexdigest())
    with blamed(source):
        examine(own)
    tasks.bring(own)
    return own.task.name


def _load(source: Path, attribute: str) -> Any:
    """What the file has under that name."""
    module = run_file(source)
    if not hasattr(module, attribute):
        found = [name for name, thing in vars(module).items() if _is_task(thing)]
        raise ConfigError(unknown(f"task of {source}", attribute, found or ["none: the file has no task"]))
    return getattr(module, attribute)


def run_file(source: Path) -> Any:
    """Run a Python file and return it as a module. Raises ConfigError where there is none."""
    try:
        source.read_bytes()
    except OSError as error:
        raise ConfigError(f"cannot read {source}: {reason(error)}") from error
    name = f"{tasks.OWN_FILE}{hashlib.sha256(str(source.resolve()).encode()).hexdigest()[:12]}"
    spec = importlib.util.spec_from_file_location(name, source.absolute())
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


def _is_task(thing: Any) -> bool:
    if isinstance(thing, type):
        return issubclass(thing, Environment) and thing is not Environment
    return isinstance(thing, Task | Environment)


def _record(thing: Any, name: str) -> Own:
    """The record of what was brought, and the settings that stand where none are said."""
    if isinstance(thing, Task):
        settings: Any = thing.settings
        _require(isinstance(settings, type), f"{name}.settings must be a class, not {settings!r}")
        return Own(thing, _default(thing.settings, name))
    if isinstance(thing, type) and issubclass(thing, Environment):
        missing = sorted(getattr(thing, "__abstractmethods__", ()))
        _require(not missing, f"`{name}` has no `{missing[0] if missing else ''}`: a task needs reset and step")
        return _of_environment(thing, _default(thing, name))
    if isinstance(thing, Environment):
        return _of_environment(type(thing), thing)
    lacking = next((size for size in (*_SIZES, "reset", "step") if not hasattr(thing, size)), None)
    why = f"it has no `{lacking}`" if lacking else "it does not inherit from gacrl.Environment"
    raise ConfigError(
        f"`{name}` is no task, {why}: make it a gacrl.Task, or a subclass of gacrl.Environment or an instance of one"
    )


def _of_environment(kind: type[Environment], instance: Environment) -> Own:
    """A task from an environment: it has the name of its class, and its fields are its settings."""
    name, is_set = kind.__name__, is_dataclass(kind)
    task = Task(
        name=name,
        settings=kind if is_set else NoSettings,
        make=(lambda settings: settings) if is_set else (lambda settings: instance),
        summary=" ".join((kind.__doc__ or "").split("\n\n")[0].split()) if kind.__doc__ else "",
    )
    return Own(task, instance if is_set else NoSettings())


def _with_plain_numbers(own: Own) -> Own:
    """The same, with Python's numbers in place of NumPy's among the settings, as a file can hold them."""
    if not is_dataclass(own.settings):
        return own
    numpy = {field.name: getattr(own.settings, field.name) for field in fields(own.settings) if field.init}
    plain = {name: value.item() for name, value in numpy.items() if isinstance(value, np.generic)}
    return replace(own, settings=replace(own.settings, **plain)) if plain else own  # pyright: ignore[reportArgumentType]


def _default(kind: type, name: str) -> Any:
    try:
        return kind()
    except (TypeError, ConfigError) as error:
        raise ConfigError(
            f"`{name}` cannot be made without arguments ({error}): give its settings defaults"
        ) from error


@contextlib.contextmanager
def blamed(source: Path | None) -> Generator[None]:
    """Raise ConfigError, with file, line and message, for what code of that file raises."""
    file = None if source is None else source.resolve()
    try:
        yield
    except (UserError, KeyboardInterrupt, GeneratorExit):
        raise
    except BaseException as error:
        if source is None:
            raise
        if isinstance(error, SyntaxError) and error.filename and Path(error.filename).resolve() == file:
            raise ConfigError(f"{source}:{error.lineno}: {error.msg}") from error
        frames = traceback.extract_tb(error.__traceback__)
        mine = [frame for frame in frames if Path(frame.filename).resolve() == file]
        if not mine:
            raise
        said = " ".join(str(error).split()).partition(". ")[0]
        raise ConfigError(f"{source}:{mine[-1].lineno}: {type(error).__name__}: {said[:300]}") from error


def examine(own: Own) -> None:
    """Raise ConfigError for a task that does not keep its word: sizes, shapes, kinds of numbers, names of measures.

    Nothing is computed, except for one reset and step of what can be.
    """
    task = own.task
    _require_settings(task, own.settings)
    env: Environment = task.make(own.settings)
    for size in _SIZES:
        value = getattr(env, size, None)
        _require(value is not None, f"`{task.name}` has no `{size}`")
        whole = isinstance(value, int | np.integer) and not isinstance(value, bool) and int(value) >= 1
        _require(whole, f"`{task.name}.{size}` must be a whole number above 0, not {value!r}")
    try:
        hash(env)
    except TypeError as error:
        raise ConfigError(
            f"`{task.name}` cannot be hashed ({error}): make it a frozen dataclass of numbers, strings and tuples"
        ) from error
    params = task.numbers(own.settings, env)
    key, shape = jax.random.key(0), (env.num_agents, env.num_actions)
    action = jnp.zeros(shape) if env.continuous_actions else jnp.zeros(shape[0], jnp.int32)
    state, seen = jax.eval_shape(env.reset, key, params)
    _check_observation(task.name, "reset", env, seen)
    after_state, after = jax.eval_shape(env.step, state, action, key, params)
    _check_step(task, env, after)
    _check_same(task.name, "state", state, after_state)
    _check_same(task.name, "observation", seen, after.observation)
    _check_records(task, own.settings, env, state, params)


def _require(condition: bool, sentence: str) -> None:
    if not condition:
        raise ConfigError(sentence)


def _require_settings(task: Task, settings: Any) -> None:
    _require(
        is_dataclass(settings), f"the settings of {task.name} must be a dataclass, not {type(settings).__name__}"
    )
    for field in fields(settings):
        value = getattr(settings, field.name)
        plain = value is None or isinstance(value, bool | int | float | str | tuple)
        _require(
            plain,
            f"{task.name}.{field.name} is a {type(value).__name__}: settings are numbers, strings and tuples; arrays "
            "belong into default_params",
        )


def _check_observation(task: str, method: str, env: Environment, seen: Any) -> None:
    where = f"{task}.{method}"
    _require(
        isinstance(seen, Observation),
        f"{where} must give (state, observation), the latter made by gacrl.envs.observe, not {type(seen).__name__}",
    )
    agents, actions, size = env.num_agents, env.num_actions, env.observation_size
    _expect(f"{where}: what an agent sees", seen.features, (agents, size), float, agents)
    _expect(f"{where}: positions", seen.positions, (agents, 2), float, agents)
    _expect(f"{where}: alive", seen.agent_mask, (agents,), bool, agents)
    _expect(f"{where}: available actions", seen.action_mask, (agents, actions), bool, agents)
    _expect(f"{where}: adjacency", seen.adjacency, (agents, agents), bool, agents)
    if seen.state is not None:
        _require(seen.state.ndim == 1, f"{where}: state must have the shape [S], not {list(seen.state.shape)}")


def _check_step(task: Task, env: Environment, after: Any) -> None:
    where = f"{task.name}.step"
    _require(isinstance(after, TimeStep), f"{where} must give (state, gacrl.TimeStep), not {type(after).__name__}")
    _check_observation(task.name, "step", env, after.observation)
    agents = env.num_agents
    _expect(f"{where}: reward", after.reward, (agents,), float, agents)
    _expect(f"{where}: left", after.left, (agents,), bool, agents)
    for name in ("terminated", "truncated"):
        _expect(f"{where}: {name}", getattr(after, name), (), bool, agents)
    _require(
        isinstance(after.info, Mapping), f"{where}: info must be a dictionary, not {type(after.info).__name__}"
    )
    for name, value in after.info.items():
        _expect(f"{where}: info[{name!r}]", value, (), None, agents)
    measured = {*after.info, "reward_raw"}
    for name, metric in task.metrics.items():
        _require(
            metric.measure in measured,
            f"the metric {name} of {task.name} is made of {metric.measure!r}, which step does not measure: "
            f"it measures {', '.join(sorted(measured))}",
        )
    _require(
        task.progress is None or task.progress in measured,
        f"{task.name}.progress is {task.progress!r}, which step does not measure",
    )
    known = {*task.metrics, *RETURN, *measured}
    _require(task.headline in known, f"{task.name}.headline is {task.headline!r}, which is no metric of it")


def _expect(what: str, value: Any, shape: tuple[int, ...], kind: type | None, agents: int) -> None:
    """Raises ConfigError unless the array has that shape, and numbers of that kind; None passes."""
    if value is None:
        return
    found = tuple(jnp.shape(value))
    whose = " of each agent" if shape[:1] == (agents,) and found[:1] == (agents,) else ""
    asked, got = (list(shape[1:]), list(found[1:])) if whose else (list(shape), list(found))
    _require(found == shape, f"{what}{whose} must have the shape {asked}, not {got}" + _late(shape, found))
    dtype = jnp.result_type(value)
    fits = {float: jnp.issubdtype(dtype, jnp.floating), bool: dtype == jnp.bool_, None: dtype.kind in "biuf"}[kind]
    wanted = {float: "numbers with a fraction (float32)", bool: "True or False", None: "numbers"}[kind]
    _require(fits, f"{what} must be {wanted}, not {dtype}")


def _late(shape: tuple[int, ...], found: tuple[int, ...]) -> str:
    """Names the first agent that is missing, or too many."""
    if len(shape) and len(found) == len(shape) and shape[0] != found[0]:
        return f" (agent {min(shape[0], found[0])} {'has none' if found[0] < shape[0] else 'is one too many'})"
    return ""


def _check_same(task: str, what: str, first: Any, later: Any) -> None:
    """What is carried from step to step keeps its structure and its shapes."""
    before, after = jax.tree.structure(first), jax.tree.structure(later)
    _require(before == after, f"the {what} of {task} has another structure after step than after reset")
    paths = jax.tree_util.tree_leaves_with_path(first)
    for (path, old), new in zip(paths, jax.tree.leaves(later), strict=True):
        same = old.shape == new.shape and old.dtype == new.dtype
        name = jax.tree_util.keystr(path) or what
        _require(
            same,
            f"{name} in the {what} of {task} is {old.dtype}{list(old.shape)} after reset and "
            f"{new.dtype}{list(new.shape)} after step: both must be alike",
        )


def _check_records(task: Task, settings: Any, env: Environment, state: Any, params: Any) -> None:
    """What the record says besides: its scene, its difficulty."""
    if task.scene is not None:
        seen = jax.eval_shape(lambda state, params: task.scene(settings, state, params), state, params)  # pyright: ignore[reportOptionalCall]
        _require(isinstance(seen, Scene), f"{task.name}.scene must give a gacrl.scene.Scene")
        shown = seen.agents.positions.shape[0]
        _require(
            shown == env.num_agents, f"{task.name}.scene shows {shown} agents, and there are {env.num_agents}"
        )
    share = jax.ShapeDtypeStruct((), jnp.float32)
    moved = jax.eval_shape(lambda params, share: task.difficulty(settings, params, share), params, share)
    _check_same(task.name, "params", jax.eval_shape(lambda params: params, params), moved)
