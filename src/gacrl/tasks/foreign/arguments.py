"""The arguments of a function that makes environments, as the settings of a task."""

import inspect
import typing
from collections.abc import Mapping
from dataclasses import field, make_dataclass
from importlib import metadata
from typing import Any

_PLAIN = (bool, int, float, str, bool | None, int | None, float | None, str | None)


def plain_arguments(signature: inspect.Signature) -> dict[str, tuple[Any, Any]]:
    """Return the type and default of each argument that is a number or a name."""
    kinds = {parameter.name: (_kind(parameter), parameter.default) for parameter in signature.parameters.values()}
    return {name: (kind, default) for name, (kind, default) in kinds.items() if kind is not None}


def _kind(parameter: inspect.Parameter) -> Any:
    """Return the type of an argument that can be a setting; None of any other."""
    if parameter.default is inspect.Parameter.empty:
        return None
    hint = parameter.annotation
    if isinstance(hint, str):
        try:
            hint = typing.get_type_hints(type("_", (), {"__annotations__": {"_": hint}}))["_"]
        except (NameError, TypeError, SyntaxError):
            hint = None
    if hint in _PLAIN:
        return hint
    return type(parameter.default) if type(parameter.default) in _PLAIN else None


def as_settings(name: str, arguments: Mapping[str, tuple[Any, Any]]) -> type:
    """Make a frozen dataclass of these arguments."""
    rows = [(argument, kind, field(default=default)) for argument, (kind, default) in arguments.items()]
    return make_dataclass(name, rows, frozen=True)


def version_of(module: str) -> str | None:
    """Return what tells one version of an environment from another."""
    package = module.partition(".")[0]
    try:
        return f"{package} {metadata.version(package)}"
    except metadata.PackageNotFoundError:
        return None
