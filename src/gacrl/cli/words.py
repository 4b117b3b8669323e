"""The words of a command, as the shell gives them."""

from collections.abc import Mapping
from types import MappingProxyType


class Words(list[str]):
    """The words of a command, without --env NAME and --use FILE; `task` is the name that --env gave."""

    task: str | None = None
    named: Mapping[str, list[str]] = MappingProxyType({})
    """What stood behind --env and --use."""
