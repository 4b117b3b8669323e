"""The folder of a study of many runs: it says what it is for, so that a stopped study goes on and no other starts."""

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from gacrl.errors import UserError, reason


def claim_folder(
    out: Path, marker: str, asked: Mapping[str, Any], kind: str, other: Callable[[Mapping[str, Any]], str]
) -> None:
    """Make the folder and say in it, in the file `marker`, what was asked for (plain JSON data).

    kind: what the study is called. other: the sentence about a folder that holds one of its kind with other settings,
    from those. Raises UserError for it, for a folder that holds something else, and for one that cannot be written.
    """
    path, unfinished = out / marker, out / f".{marker}.unfinished"
    if path.is_file():
        try:
            held: Any = json.loads(path.read_text(encoding="utf-8"))
        except ValueError:
            held = None
        if not isinstance(held, dict):
            raise UserError(f"{path} is damaged: choose another --out")
        if held != json.loads(json.dumps(asked)):  # as it would be read: tuples are lists
            raise UserError(f"{out} holds {other(held)}")  # pyright: ignore[reportUnknownArgumentType]
        return
    if out.exists() and (not out.is_dir() or any(entry != unfinished for entry in out.iterdir())):
        raise UserError(f"{out} exists and holds no {kind}: choose another --out")
    try:
        out.mkdir(parents=True, exist_ok=True)
        unfinished.write_text(json.dumps(asked, indent=2) + "\n", encoding="utf-8")
        unfinished.replace(path)
    except OSError as error:
        raise UserError(f"cannot write into {out}: {reason(error)}; choose another --out") from error
