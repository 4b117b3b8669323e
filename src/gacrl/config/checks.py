"""What settings are held to: a condition, a type, two bounds, or names that are known. A leaf: it imports no jax."""

import difflib
import functools
import reprlib
from collections.abc import Iterable, Mapping
from dataclasses import fields, is_dataclass
from types import MappingProxyType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from gacrl.errors import ConfigError


def require(condition: bool, message: str) -> None:
    """Raise ConfigError with the message unless the condition holds."""
    if not condition:
        raise ConfigError(message)


def typed(value: Any, hint: Any, name: str) -> Any:
    """Return the value as the type that `hint` names, in Python's own numbers. Raises ConfigError with `name`.

    NumPy's integers are whole numbers and its floats are numbers; lists and arrays are tuples, as JSON has no tuples.
    A text, True, or 4.0 is no whole number.
    """
    value = value.tolist() if hasattr(value, "tolist") else value  # of NumPy, JAX or PyTorch
    origin, arguments = get_origin(hint), get_args(hint)
    if hint is Any:
        return value
    if origin is Literal:
        require(value in arguments, f"{name} must be one of {', '.join(map(str, arguments))}, not {_told(value)}")
        return value
    if origin is tuple:
        return _typed_tuple(value, arguments, name)
    if origin is not None and type(None) in arguments:  # X | None
        return None if value is None else typed(value, Union[arguments[0]], name)  # noqa: UP007
    if hint is float and isinstance(value, int) and not isinstance(value, bool):
        return float(str(value))  # infinity where it is too large
    wanted = {int: "a whole number", float: "a number", bool: "true or false", str: "a text"}.get(hint, str(hint))
    wanted = f"of the class {getattr(hint, '__name__', hint)}" if is_dataclass(hint) else wanted
    matches = isinstance(hint, type) and isinstance(value, hint) and isinstance(value, bool) == (hint is bool)
    require(matches, f"{name} must be {wanted}, not {_told(value)}")
    return value


def _typed_tuple(value: Any, arguments: tuple[Any, ...], name: str) -> tuple[Any, ...]:
    require(isinstance(value, list | tuple), f"{name} must be a list, not {_told(value)}")
    values: list[Any] = list(value)
    fixed = arguments[-1] is not Ellipsis
    require(
        not fixed or len(values) == len(arguments), f"{name} must be {len(arguments)} numbers, not {_told(values)}"
    )
    return tuple(typed(item, arguments[0], name) for item in values)


def whole(value: Any, name: str, low: int | None = None) -> int:
    """Return a whole number that a function was given, as Python's int. Raises ConfigError with the argument's name."""
    number: int = typed(value, int, name)
    require(low is None or number >= low, f"{name} must be at least {low}, not {number}")
    return number


def require_kind(name: str, value: Any, kinds: tuple[type, ...], expected: str) -> None:
    """Raise ConfigError, with the value and its type, for an argument of another type than these."""
    kind = type(value).__name__
    require(isinstance(value, kinds), f"{name} must be {expected}, not {reprlib.repr(value)} (of type {kind})")


def take_types(section: str, settings: Any) -> None:
    """Give every field of a frozen dataclass the type that it declares. Call it first in `__post_init__`.

    Raises ConfigError for a value that has another type.
    """
    hints = _hints(type(settings))
    for field in fields(settings):
        before = getattr(settings, field.name)
        value = typed(before, hints[field.name], f"{section}.{field.name}")
        if value is not before:
            object.__setattr__(settings, field.name, value)


@functools.cache
def _hints(kind: type) -> dict[str, Any]:
    return get_type_hints(kind)


def _told(value: Any) -> str:
    """A value in a sentence: on one line, and not long."""
    return f"the string {reprlib.repr(value)}" if isinstance(value, str) else reprlib.repr(value)


def between(section: str, settings: object, low: int | float, high: int | float, *names: str) -> None:
    """Raise ConfigError for a named setting outside the bounds, or NaN; None is no number, and passes.

    The settings have taken their types.
    """
    for name in names:
        value = getattr(settings, name)
        if value is not None:
            require(
                low <= value <= high,
                f"{section}.{name} must be between {_shown(low)} and {_shown(high)}, not {value}",
            )


SYNONYMS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        **dict.fromkeys(("lr", "alpha", "step_size"), ("learning_rate",)),
        **dict.fromkeys(("discount", "discount_factor"), ("gamma",)),
        **dict.fromkeys(("lambda", "lam", "gae"), ("gae_lambda",)),
        **dict.fromkeys(("ent", "entropy", "entropy_coef", "ent_weight", "beta"), ("ent_coef",)),
        **dict.fromkeys(("vf", "value_coef", "critic_coef"), ("vf_coef", "critic_weight")),
        **dict.fromkeys(("eps", "epsilon_start"), ("epsilon", "clip_eps")),
        **dict.fromkeys(("clip", "clip_range", "clip_coef", "clip_ratio"), ("clip_eps",)),
        **dict.fromkeys(("temp", "tau_start"), ("temperature",)),
        **dict.fromkeys(("tau", "polyak", "target_update"), ("target_step", "temperature")),
        **dict.fromkeys(("grad_clip", "grad_norm", "clip_grad", "max_norm"), ("max_grad_norm",)),
        **dict.fromkeys(("n_envs", "envs", "nenvs"), ("num_envs",)),
        **dict.fromkeys(("n_steps", "nsteps", "rollout_length", "rollout_steps", "unroll_length"), ("num_steps",)),
        **dict.fromkeys(("steps", "timesteps", "total_timesteps", "num_env_steps", "t_max"), ("env_steps",)),
        **dict.fromkeys(("n_episodes", "num_train_episodes"), ("episodes",)),
        **dict.fromkeys(("bs", "batch", "minibatch_size"), ("batch_size", "num_minibatches")),
        **dict.fromkeys(("n_minibatches", "minibatches", "num_mini_batch"), ("num_minibatches",)),
        **dict.fromkeys(("epochs", "n_epochs", "num_epochs", "ppo_epoch"), ("update_epochs",)),
        **dict.fromkeys(("buffer", "buffer_size", "memory_size"), ("replay_capacity",)),
        **dict.fromkeys(("warmup", "warmup_steps", "start_steps"), ("learning_starts",)),
        **dict.fromkeys(("hidden", "hidden_size", "hidden_dim", "units"), ("width",)),
        **dict.fromkeys(("layers", "num_layers", "n_layers"), ("depth",)),
        **dict.fromkeys(("n_agents", "agents"), ("num_agents",)),
        **dict.fromkeys(("n_seeds", "seeds"), ("num_seeds",)),
        **dict.fromkeys(("max_steps", "episode_length", "episode_limit", "horizon"), ("max_cycles",)),
    }
)
"""What the field calls our settings, by the last part of a name; the likeliest stands first."""


def nearest(name: str, known: Iterable[str]) -> str | None:
    """Return the known name that is meant: by a synonym of its last part, by that part, or by its letters; None: nobody
    knows.

    Names may be settings (`algorithm.learning_rate`) or flags (`--algorithm.learning-rate`).
    """
    known = list(known)
    last = _last_part(name)
    for meant in (*SYNONYMS.get(last, ()), last):
        same = [other for other in known if _last_part(other) == meant]
        if same:
            return max(same, key=lambda other: difflib.SequenceMatcher(None, name, other).ratio())
    letters = {other.lstrip("-"): other for other in known}
    near = difflib.get_close_matches(name.lstrip("-"), letters, n=1, cutoff=0.4)
    return letters[near[0]] if near else None


def _last_part(name: str) -> str:
    return name.rpartition(".")[2].lstrip("-").replace("-", "_").lower()


def unknown(kind: str, name: str, known: Mapping[str, Any] | set[str] | list[str], hint: str = "") -> str:
    """Return the sentence for a name that is not among the known ones, with the nearest of them."""
    near = nearest(name, known)
    mend = f"did you mean '{near}'?" if near else f"known: {', '.join(sorted(known))}"
    return f"unknown {kind} {name!r}: {mend}" + (f" ({hint})" if hint else "")


def _shown(bound: int | float) -> str:
    return str(bound) if isinstance(bound, int) else f"{bound:g}"
