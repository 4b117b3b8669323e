"""The weights for programs that have NumPy alone."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gacrl.export.card import write_card
from gacrl.export.program import program
from gacrl.export.source import Source
from gacrl.replacing import replaced


def write(source: Source, out: Path) -> Sequence[Path]:
    """Write the weights that act, by name, and their card. No array in it is an object: nothing is pickled."""
    it = program(source)
    card = write_card(source, it, out)
    with replaced(out) as file:
        np.savez(file, allow_pickle=False, **it.weights)
    return [out, card]
