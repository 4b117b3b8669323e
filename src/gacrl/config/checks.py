"""What settings are held to: a condition, two bounds, or names that are known. A leaf: it imports no jax."""

import difflib
from collections.abc import Mapping
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


def unknown(kind: str, name: str, known: Mapping[str, Any] | set[str] | list[str], hint: str = "") -> str:
    """The sentence for a name that is not among the known ones, with the nearest of them."""
    near = difflib.get_close_matches(name, list(known), n=1, cutoff=0.4)
    mend = f"did you mean '{near[0]}'?" if near else f"known: {', '.join(sorted(known))}"
    return f"unknown {kind} {name!r}: {mend}" + (f" ({hint})" if hint else "")


def _shown(bound: int | float) -> str:
    return str(bound) if isinstance(bound, int) else f"{bound:g}"
