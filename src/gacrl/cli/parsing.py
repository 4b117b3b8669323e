"""How the words of a command become its arguments, and the sentence for words that cannot."""

import contextlib
import inspect
import io
import re
import sys
from collections.abc import Callable, Generator, Iterable
from dataclasses import dataclass, fields, is_dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path
from types import NoneType
from typing import Any, TypeVar, get_args, get_type_hints

import tyro
from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

from gacrl.config import presets
from gacrl.config.checks import nearest, unknown
from gacrl.errors import UserError
from gacrl.report.screen import folded, terminal_width

Arguments = TypeVar("Arguments")

_NONE = "none"
"""What stands for nothing, on the command line and in its help."""
_MOST_DIGITS = 30
_DESCRIPTION = "DESCRIPTION"
"""Stands in the parser's help for ours, whose lines it would join."""
_MARKERS = (tyro.conf.AvoidSubcommands, tyro.conf.PositionalMetavarFromFieldName)


def parse(kind: type[Arguments], words: list[str], command: str, default: Arguments | None = None) -> Arguments:
    """Return the arguments by their dataclass. Raises UserError with one sentence for what cannot be understood."""
    asked, rest = _parsed(kind, words, command, default)
    if rest:
        raise UserError(_unrecognized(rest[0], _flags(kind, default), command))
    return asked


def parse_known(kind: type[Arguments], words: list[str], command: str) -> tuple[Arguments, list[str]]:
    """Return the same, and the words that are none of its flags."""
    return _parsed(kind, words, command, None)


@contextlib.contextmanager
def called(flag: str, setting: str) -> Generator[None]:
    """Call a setting that is out of range by the flag that set it."""
    try:
        yield
    except UserError as error:
        raise UserError(str(error).replace(setting, flag)) from error


def whole_number(text: str) -> int:
    """Read a whole number, which may be written 1e5. Raises ValueError with half a sentence."""
    try:
        return int(text)
    except ValueError:
        pass
    try:
        number = Decimal(text)
    except InvalidOperation:
        number = Decimal("nan")
    if number.is_finite() and number.adjusted() > _MOST_DIGITS:
        raise ValueError(f"must be smaller than {text}")
    if not number.is_finite() or number != number.to_integral_value():
        raise ValueError(f"must be a whole number, not {text}")
    return int(number)


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise ValueError(f"must be a number, not {text}") from None


def _numbers(words: list[str]) -> tuple[int, ...] | None:
    """Read whole numbers, or `none`; behind a flag that takes any number of them, other words are easily caught."""
    try:
        return None if words == [_NONE] else tuple(map(whole_number, words))
    except ValueError as error:
        raise ValueError(f"{error}; other words stand before it") from None


_VALUES: dict[Any, tuple[str, Callable[[str], Any]]] = {
    int: ("N", whole_number),
    float: ("X", _number),
    str: ("NAME", str),
    Path: ("PATH", Path),
}
"""What help calls the value of a flag, by its type, and how a word becomes one."""


def _registry() -> ConstructorRegistry:
    """How words become values. An optional value is written as the value is, and nothing as `none`."""
    registry = ConstructorRegistry()

    @registry.primitive_rule
    def plain(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:  # pyright: ignore[reportUnusedFunction]
        if info.type not in _VALUES:
            return None
        name, read = _VALUES[info.type]
        return PrimitiveConstructorSpec(
            nargs=1,
            metavar=name,
            instance_from_str=lambda words: read(words[0]),
            is_instance=lambda value: isinstance(value, info.type),
            str_from_instance=lambda value: [str(value)],
        )

    @registry.primitive_rule
    def optional(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:  # pyright: ignore[reportUnusedFunction]
        inner = [kind for kind in get_args(info.type) if kind is not NoneType]
        if NoneType not in get_args(info.type) or len(inner) != 1 or inner[0] not in _VALUES:
            return None
        name, read = _VALUES[inner[0]]
        return PrimitiveConstructorSpec(
            nargs=1,
            metavar=name,
            instance_from_str=lambda words: None if words[0].lower() == _NONE else read(words[0]),
            is_instance=lambda value: value is None or isinstance(value, inner[0]),
            str_from_instance=lambda value: [_NONE if value is None else str(value)],
        )

    @registry.primitive_rule
    def several(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:  # pyright: ignore[reportUnusedFunction]
        if info.type != tuple[int, ...] | None:
            return None
        return PrimitiveConstructorSpec(
            nargs="*",
            metavar="[N …]",
            instance_from_str=_numbers,
            is_instance=lambda value: value is None or isinstance(value, tuple),
            str_from_instance=lambda value: [_NONE] if value is None else list(map(str, value)),
        )

    return registry


class _Shown(io.StringIO):
    """Holds what help prints for a screen, with its colours and letters."""

    def __init__(self, screen: Any) -> None:
        super().__init__()
        self._screen = screen

    @property
    def encoding(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride]
        return getattr(self._screen, "encoding", None) or "utf-8"

    def isatty(self) -> bool:
        return self._screen is not None and self._screen.isatty()


def _parsed(kind: Any, words: list[str], command: str, default: Any) -> Any:
    """The arguments, and the words that are none of theirs. What is out of range is called by its flag."""
    try:
        return _understood(kind, words, command, default)
    except UserError as error:
        raise type(error)(_by_flag(str(error), words)) from None


def _by_flag(sentence: str, words: list[str]) -> str:
    """The sentence about a setting, with the flag in its place where the words set it."""
    for flag in (word.partition("=")[0] for word in words if word.startswith("--")):
        setting = flag.removeprefix("--").replace("-", "_")
        for name in (setting, f"run.{setting}"):
            if sentence.startswith(f"{name} "):
                return flag + sentence.removeprefix(name)
    return sentence


def _understood(kind: Any, words: list[str], command: str, default: Any) -> Any:
    given: dict[str, Any] = {} if default is None else {"default": default}
    said, shown = io.StringIO(), _Shown(sys.stdout)
    try:
        with contextlib.redirect_stderr(said), contextlib.redirect_stdout(shown):
            return tyro.cli(
                kind,
                prog=f"gacrl {command}",
                description=_DESCRIPTION,
                args=words,
                config=_MARKERS,
                registry=_registry(),
                return_unknown_args=True,
                **given,
            )
    except SystemExit as stop:
        if stop.code == 0:
            print(shown.getvalue().replace(_DESCRIPTION, _description(kind), 1), end="")
            raise
        raise UserError(_sentence(said.getvalue(), command)) from None


def _description(kind: Any) -> str:
    """What help says first: the docstring with its paragraphs, examples and columns as wide as the terminal."""
    paragraphs = inspect.cleandoc(kind.__doc__ or "").split("\n\n")
    joined = [text if "\n " in text else " ".join(text.split()) for text in paragraphs]
    return folded("\n\n".join(joined), terminal_width())


def _flags(kind: type, default: Any, before: str = "--") -> list[str]:
    """All flags of a dataclass of arguments, and of those in it. default: one of its kind, or None."""
    found: list[str] = []
    hints = get_type_hints(kind, include_extras=True)
    for field in fields(kind):
        details = get_args(hints[field.name])[1:]
        given = [detail.name for detail in details if getattr(detail, "name", None) is not None]
        flag = given[0] if given else field.name.replace("_", "-")
        value = getattr(default, field.name, field.default)
        if is_dataclass(value):
            found += _flags(type(value), value, f"{before}{flag}." if flag else before)
        elif not any(detail in (tyro.conf.Positional, tyro.conf.Suppress) for detail in details):
            found.append(before + flag)
    return found


def _unrecognized(word: str, known: Iterable[str], command: str) -> str:
    """The sentence for a word that a command does not have."""
    known, name = list(known), word.partition("=")[0]
    if not name.startswith("-"):
        mend = f"did you mean --preset {word}?" if word in presets.PRESETS and "--preset" in known else None
        return f"unexpected word {word!r}: {mend or f'see `gacrl {command} --help`'}"
    near = nearest(name, known)
    return f"unrecognized option {name}: " + (f"did you mean {near}?" if near else f"see `gacrl {command} --help`")


@dataclass(frozen=True)
class _Changed:
    env: Any


def changed(settings: Any, words: list[str], command: str, kind: type) -> Any:
    """Return a task's settings with those that `--env.X V`, or `--X V`, say.

    kind: the arguments of the command, whose other flags may be meant. Raises UserError (ConfigError out of range).
    """
    names = {field.name.replace("_", "-"): field.name for field in fields(settings)}
    flags: list[str] = []
    for word in words:
        name, equals, value = word.partition("=")
        bare = name.removeprefix("--").removeprefix("env.").replace("_", "-")
        if not name.startswith("--"):
            flags.append(word)
        elif bare.removeprefix("no-") in names or bare in names:
            flags.append(f"--env.{bare}{equals}{value}")
        elif name.startswith("--env."):
            raise UserError(unknown("setting", f"env.{bare}", {f"env.{known}" for known in names}))
        else:
            raise UserError(
                _unrecognized(name, [*_flags(kind, None), *(f"--{known}" for known in names)], command)
            )
    return parse(_Changed, flags, command, _Changed(settings)).env


def _sentence(box: str, command: str) -> str:
    """One sentence out of the parser's box: what is wrong, and where to look."""
    lines = [line.strip("│| ") for line in box.splitlines()[1:]]  # the first one is the box's title
    lines = [line if line.strip("╰╯+─-") else "" for line in lines]
    problem = "\n".join(lines).strip().split("\n\n")[0].replace("\n", " ")
    problem = re.sub(r"^Error parsing (?!--)\S+: ", "", problem).rstrip(". ")
    problem = re.sub(
        r"^Error parsing (--\S+): (must )?", lambda it: f"{it[1]}{' must ' if it[2] else ': '}", problem
    )
    problem = re.sub(r"^Missing from (gacrl \w+): (\w+).*", r"\1 needs a \2", problem)
    problem = re.sub(r"^Missing value for argument '(\S+)'.*", r"\1 needs a value", problem)
    return f"{problem[:1].lower()}{problem[1:]}: see `gacrl {command} --help`"
