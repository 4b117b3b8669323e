"""Files that are replaced whole: a reader sees the old one or the new one, never half of it. A leaf."""

import json
import os
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO


def unfinished(path: Path) -> Path:
    """Return where a file is written meanwhile, if one process alone writes into its folder."""
    return path.with_name(f".{path.name}.unfinished")


@contextmanager
def replaced(path: Path, meanwhile: Path | None = None) -> Generator[BinaryIO]:
    """Open a file that appears under its name complete at the end of the block, or not at all. Raises OSError.

    meanwhile: where it is written until then; none: a name of this process, so that several may write the same file.
    """
    meanwhile = meanwhile or path.with_name(f".{path.name}.{os.getpid()}")
    meanwhile.unlink(missing_ok=True)  # by a process that was killed; or a link, which must lead nobody away
    try:
        with meanwhile.open("xb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        meanwhile.replace(path)
    finally:
        meanwhile.unlink(missing_ok=True)


def replace_text(path: Path, text: str) -> None:
    """Write a file whole, in a folder that one process alone writes into. Raises OSError."""
    with replaced(path, unfinished(path)) as file:
        file.write(text.encode())


def replace_json(path: Path, data: Any, indent: int | None = 2) -> None:
    """Write plain data whole, in a folder that one process alone writes into. Raises OSError."""
    replace_text(path, json.dumps(data, indent=indent) + "\n")
