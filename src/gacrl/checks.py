"""What settings are held to: a condition, or two bounds. A leaf: it imports no jax."""

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


def _shown(bound: int | float) -> str:
    return str(bound) if isinstance(bound, int) else f"{bound:g}"
