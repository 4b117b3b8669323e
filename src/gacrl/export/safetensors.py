"""The weights as safetensors, which any framework reads."""

from collections.abc import Sequence
from pathlib import Path

import safetensors.numpy

from gacrl.export.card import write_card
from gacrl.export.program import program
from gacrl.export.source import Source
from gacrl.replacing import replaced
from gacrl.versions import version


def write(source: Source, out: Path) -> Sequence[Path]:
    """Write the weights that act, by name, and their card; the file's metadata say what it is of."""
    it, run = program(source), source.opened
    about = {"format": "gacrl", "gacrl": version(), "task": run.config.task, "preset": run.config.preset}
    card = write_card(source, it, out)
    with replaced(out) as file:
        file.write(safetensors.numpy.save(it.weights, metadata=about))
    return [out, card]
