"""What a decision of an exported policy costs: microseconds of CPU time of one core, in onnxruntime.

    python benchmarks/onnx_pace.py [RUN]        # pip install 'gacrl[onnx]'; pretrained:gacrl by default

A decision is of the whole team. Prints the smallest and the median of nine turns of 2,000 decisions, of the graph that
jax2onnx makes and of the one that is exported (`gacrl.export.lean`); the two take turns.
"""

import statistics
import sys
import time

import numpy as np

from gacrl.export import onnx
from gacrl.export.program import program
from gacrl.export.recorded import record
from gacrl.export.source import Source
from gacrl.training.devices import prepare_jax

TURNS, DECISIONS = 9, 2000


def main(run: str) -> None:
    """Measure both graphs on recorded decisions."""
    prepare_jax()
    source = Source(run)
    it = program(source)
    seen = record(source, it, 100).inputs
    inputs = [{name: np.asarray(array[k]) for name, array in seen.items()} for k in range(100)]
    graphs = {"as jax2onnx makes it": onnx.traced(source, it), "exported": onnx.convert(source, it)}
    decide = {name: onnx.runner(data) for name, data in graphs.items()}
    took: dict[str, list[float]] = {name: [] for name in decide}
    for _ in range(TURNS):
        for name, run_once in decide.items():
            begun = time.process_time()
            for k in range(DECISIONS):
                run_once(inputs[k % 100])
            took[name].append((time.process_time() - begun) / DECISIONS * 1e6)
    for name, turns in took.items():
        print(f"{name}: {min(turns):.0f} µs, median {statistics.median(turns):.0f}")


if __name__ == "__main__":
    main(sys.argv[1] if sys.argv[1:] else "pretrained:gacrl")
