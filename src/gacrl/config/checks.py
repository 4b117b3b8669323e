"""What settings are held to: a condition, two bounds, or names that are known. A leaf: it imports no jax."""

import difflib
from collections.abc import Iterable, Mapping
from types import MappingProxyType
from typing import Any

from gacrl.errors import ConfigError


def require(condition: bool, message: str) -> None:
    """Raises ConfigError with the message unless the condition holds."""
    if not condition:
        raise ConfigError(message)


def between(section: str, settings: object, low: int | float, high: int | float, *names: str) -> None:
    """Raises ConfigError for a named setting outside the bounds, or NaN; None is no number, and passes."""
    for name in names:
        value = getattr(settings, name)
        if value is not None:
            require(
                isinstance(value, int | float) and low <= value <= high,
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
    """The known name that is meant: by a synonym of its last part, by that part, or by its letters; None: nobody knows.

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
    """The sentence for a name that is not among the known ones, with the nearest of them."""
    near = nearest(name, known)
    mend = f"did you mean '{near}'?" if near else f"known: {', '.join(sorted(known))}"
    return f"unknown {kind} {name!r}: {mend}" + (f" ({hint})" if hint else "")


def _shown(bound: int | float) -> str:
    return str(bound) if isinstance(bound, int) else f"{bound:g}"
