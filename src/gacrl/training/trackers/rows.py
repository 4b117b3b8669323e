"""What a row of `metrics.jsonl` holds, without its nesting."""

from collections.abc import Mapping
from typing import Any


def flat(row: Mapping[str, Any], before: str = "", joint: str = ".") -> dict[str, Any]:
    """Return the same values under joined names: `greedy.return_agent_mean`."""
    found: dict[str, Any] = {}
    for name, value in row.items():
        if isinstance(value, Mapping):
            found |= flat(value, f"{before}{name}{joint}", joint)
        else:
            found[before + name] = value
    return found
