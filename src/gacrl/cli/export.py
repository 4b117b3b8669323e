"""The command that takes a run elsewhere."""

import json
from pathlib import Path
from typing import Any

from gacrl import export as formats
from gacrl import tasks
from gacrl.cli.output import warn
from gacrl.cli.words import Words
from gacrl.errors import UserError


def export(words: Words) -> int:
    """Write a run in a format that other programs read."""
    from gacrl.cli import arguments, parsing

    asked, rest = parsing.parse_known(arguments.Export, words, "export")
    if asked.out is None:
        ends = ", ".join(known.suffix for known in formats.FORMATS.values())
        raise UserError(f"say where with --out FILE; how it ends names the format: {ends}")
    name = formats.format_of(asked.format, asked.out)
    _require_room(asked.out, formats.beside(asked.out, name), asked.overwrite)
    write = formats.writer(name)
    from gacrl.evaluation.references import playable
    from gacrl.export.source import Source
    from gacrl.training.devices import prepare_jax

    if asked.run in playable(tasks.find(words.task or tasks.DEFAULT)):
        raise UserError(f"{asked.run} is a script, which has nothing to export: name a run, or pretrained:NAME")

    def change(settings: Any) -> Any:
        return parsing.changed(settings, rest, "export", arguments.Export)

    source = Source(asked.run, change, warn)
    change(source.folder.config().env)  # refuses odd flags for every format
    prepare_jax()
    written = write(source, asked.out.absolute())
    for path in written:
        print(f"{path}: {path.stat().st_size:,} bytes")
    if asked.json:
        print(json.dumps({"run": asked.run, "format": name, "files": [str(path) for path in written]}))
    return 0


def _require_room(out: Path, beside: list[Path], overwrite: bool) -> None:
    """Raise UserError where a file stands in the way, or there is no folder for it."""
    if not out.parent.is_dir():
        raise UserError(f"there is no folder {out.parent} to write {out.name} into")
    for path in (out, *beside):
        if path.is_dir():
            raise UserError(f"{path} is a folder: name a file with --out")
        if path.exists() and not overwrite:
            raise UserError(f"{path} exists: choose another --out, or say --overwrite")
