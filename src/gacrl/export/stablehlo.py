"""The policy as a program for XLA: what `jax.export` writes, StableHLO inside."""

from collections.abc import Sequence
from pathlib import Path

import jax
import numpy as np
from jax import export

from gacrl.export.card import write_card
from gacrl.export.program import flattened, program
from gacrl.export.recorded import Arrays, compared
from gacrl.export.source import Source
from gacrl.extras import require_extra
from gacrl.replacing import replaced

PLATFORMS = ("cpu", "cuda", "rocm", "tpu")


def write(source: Source, out: Path) -> Sequence[Path]:
    """Write the policy for every platform, its weights inside, and its card.

    `jax.export.deserialize(bytes).call(features, alive, …)` runs it, and `.mlir_module()` is its StableHLO as text.
    """
    require_extra("onnx", "flatbuffers")
    it = program(source)
    data = export.export(jax.jit(flattened(it)), platforms=PLATFORMS)(*it.inputs.values()).serialize()
    call = jax.jit(export.deserialize(data).call)

    def run(inputs: Arrays) -> Arrays:
        found = call(*(inputs[name] for name in it.inputs))
        return {name: np.asarray(array) for name, array in zip(it.outputs, found, strict=True)}

    checked = compared(source, it, run)
    card = write_card(source, it, out, f"{checked} Platforms: {', '.join(PLATFORMS)}.")
    with replaced(out) as file:
        file.write(data)
    return [out, card]
