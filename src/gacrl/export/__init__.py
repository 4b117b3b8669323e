"""Taking a run elsewhere: each format is a module of its own, imported when somebody asks for it.

A module has `write(source, out) -> Sequence[Path]`. It writes `out`, and where its format has one a card beside it, and
returns what it wrote, `out` first. It raises UserError for what cannot be written so, before it writes anything.
"""

from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

from gacrl.config.checks import unknown
from gacrl.errors import UserError


class Format(NamedTuple):
    """A way to write a run down."""

    module: str
    suffix: str
    """How its files end."""
    what: str
    """What is in them, for help."""
    card: bool = False
    """Whether a model card stands beside the file, `FILE.md`."""


FORMATS: Mapping[str, Format] = MappingProxyType(
    {
        "safetensors": Format("gacrl.export.safetensors", ".safetensors", "the weights that act, by name", True),
        "npz": Format("gacrl.export.npz", ".npz", "the same weights for NumPy alone", True),
        "stablehlo": Format(
            "gacrl.export.stablehlo", ".stablehlo", "the policy as a program, of jax.export", True
        ),
        "onnx": Format("gacrl.export.onnx", ".onnx", "the policy as a graph for onnxruntime", True),
        "html": Format("gacrl.export.html", ".html", "a page on which the agents act and speak, for any browser"),
        "csv": Format("gacrl.export.csv", ".csv", "every evaluation of every seed, a row each"),
    }
)
"""The formats by name."""


def format_of(name: str | None, out: Path) -> str:
    """Return the format that is asked for: by its name, or by how the file is called.

    Raises UserError where there is none of this name, or the two disagree.
    """
    suffixes = {known.suffix: key for key, known in FORMATS.items()}
    called = suffixes.get(out.suffix.lower())
    if name is None:
        if called is None:
            raise UserError(f"{out} does not say which format: name one with --format {'|'.join(FORMATS)}")
        return called
    if name not in FORMATS:
        raise UserError(unknown("format", name, list(FORMATS)))
    if called not in (None, name):
        raise UserError(f"{out} is called like a file of {called}, and --format says {name}: change one of them")
    return name


def card_of(out: Path) -> Path:
    """Return where the model card of a file stands."""
    return out.with_name(f"{out.name}.md")


def beside(out: Path, name: str) -> list[Path]:
    """Return the files that a format writes beside `out`."""
    return [card_of(out)] if FORMATS[name].card else []


def writer(name: str) -> Callable[[Any, Path], Sequence[Path]]:
    """Return the function that writes a format, from its own module."""
    return import_module(FORMATS[name].module).write
