"""Seconds from starting Python to the end of the first update: import, tracing, compilation.

    python benchmarks/first_update.py [--preset gacrl] [--rounds 3] [--cold]

Every round is a process of its own. With --cold each starts with an empty compilation cache; without, a first round,
not counted, fills it.
"""

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
import time

_FIRST = """
import sys
from gacrl.training.devices import prepare_jax
prepare_jax(1)
import jax
from gacrl import config
from gacrl.training import build, session
trainer = build.make_trainer(config.preset(sys.argv[1]))
jax.block_until_ready(trainer.chunk(trainer.init((0,)), 1))
"""


def first_update(preset: str, cold: bool) -> float:
    """Seconds of one start."""
    with tempfile.TemporaryDirectory() as cache:
        environment = {**os.environ, **({"XDG_CACHE_HOME": cache} if cold else {})}
        begun = time.perf_counter()
        subprocess.run([sys.executable, "-c", _FIRST, preset], env=environment, check=True)
        return time.perf_counter() - begun


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--preset", action="append", help="several times for several; by default gacrl")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--cold", action="store_true", help="an empty compilation cache for every round")
    asked = parser.parse_args()
    for preset in asked.preset or ["gacrl"]:
        if not asked.cold:
            first_update(preset, cold=False)
        taken = [first_update(preset, asked.cold) for _ in range(asked.rounds)]
        print(
            f"{preset}: median {statistics.median(taken):.1f} s ({min(taken):.1f} to {max(taken):.1f})", flush=True
        )


if __name__ == "__main__":
    main()
