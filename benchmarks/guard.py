"""Has anything become slower? Ratios, and counts of programs, against `benchmarks/baseline.json`.

    python benchmarks/guard.py [--rounds 5] [--core 0] [--write]
    python benchmarks/guard.py --short                  # counts alone: a few seconds, for CI

Fails where a ratio to a peer has fallen by more than 15 %, or so has the part of an update that its matrix products
take alone (IPPO and QMIX at JaxMARL's shapes); where a compiled program has grown by as much: in instructions, or in
messages between devices; or where the training program of a preset, as it is handed to the compiler, has grown by more
than 2 % (`lowered.py` shows where). Absolute times are never compared. Counts hold for one version of JAX: with another
they are printed and not judged.
--write makes what was measured the new baseline.
"""

import argparse
import json
import statistics
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import environment
import lowered
import peers

BASELINE = Path(__file__).parent / "baseline.json"
TOLERANCE = 0.15


def counted() -> dict[str, int]:
    """Of compiled programs: instructions of the training loop of the paper's schedule and of a step of 32 copies, and
    messages between two devices in an update of IPPO; of lowered ones: instructions of every preset's training.
    """
    import jax
    import jax.numpy as jnp
    import numpy as np
    from devices import collectives
    from jax.sharding import Mesh

    from gacrl.training import build
    from gacrl.training.devices import prepare_jax

    jax.config.update("jax_num_cpu_devices", 2)
    prepare_jax()

    import gacrl
    from gacrl.algorithms.shared import ENVS
    from gacrl.config.presets import PRESETS
    from gacrl.envs import copies
    from gacrl.tasks.spread.environment import Spread

    trainer = build.make_trainer(gacrl.preset("paper"))
    env = Spread()
    params = env.default_params()
    state = copies.reset(env, params, jax.random.split(jax.random.key(0), 32))[0]
    step = jax.jit(lambda state, action, key: copies.step(env, params, state, action, key))
    programs = {
        "paper": trainer.chunk.lower(trainer.init((0,)), jnp.int32(1)),
        "environment": step.lower(state, jnp.zeros((32, 3), jnp.int32), jax.random.key(0)),
    }
    found = {
        f"instructions: {name}": program.compile().as_text().count(" = ") for name, program in programs.items()
    }
    mesh = Mesh(np.array(jax.devices()).reshape(1, 2), ("seeds", ENVS))
    shared = build.make_trainer(gacrl.preset("ippo"), mesh)
    program = shared.chunk.lower(shared.init((0,)), jnp.int32(1)).compile()
    found |= {"messages: ippo": collectives(program.as_text() or "")[0]}
    return found | {f"{lowered.LOWERED}{preset}": lowered.count(preset) for preset in PRESETS}


def shares(rounds: int, core: int) -> dict[str, dict[str, list[float]]]:
    """The part of an update at JaxMARL's networks, batches and epochs that its products take alone, by preset."""
    script = Path(__file__).with_name("arithmetic.py")
    words = ["--preset", "ippo", "--preset", "qmix", "--shapes", "jaxmarl", "--core", str(core), "--json"]
    found: dict[str, list[float]] = {}
    for _ in range(rounds):
        done = subprocess.run([sys.executable, script, *words], capture_output=True, text=True, check=True)
        for preset, seen in json.loads(done.stdout.splitlines()[-1]).items():
            found.setdefault(preset, []).append(seen["own"] / seen["milliseconds"])
    return {"products": found}


def fallen(
    name: str, now: Mapping[str, Mapping[str, Sequence[float]]], before: Mapping[str, Mapping[str, float]]
) -> list[str]:
    """Print the table of these ratios; those that fell too far, and those of before that were not measured."""
    found = [
        f"{name}: {peer} at {size} (not measured)"
        for peer, sizes in before.items()
        for size in sizes
        if size not in now.get(peer, {})
    ]
    print("".join(f"{label}\n" for label in found), end="")
    for peer, sizes in now.items():
        for size, values in sizes.items():
            was, ratio = before.get(peer, {}).get(size), statistics.median(values)
            bad = was is not None and ratio < (1 - TOLERANCE) * was
            label = f"{name}: {peer} at {size}"
            print(f"{label:40} {peers.spread(values):32} baseline {was or 'none'}{'  FALLEN' * bad}")
            found += [label] * bad
    return found


def rounded(ratios: Mapping[str, Mapping[str, Sequence[float]]]) -> dict[str, dict[str, float]]:
    """The medians, in three digits."""
    medians = peers.summary(ratios)["ratio"]
    return {
        peer: {size: float(f"{ratio:.3g}") for size, ratio in sizes.items()} for peer, sizes in medians.items()
    }


def grown(now: Mapping[str, int], before: Mapping[str, int]) -> list[str]:
    """Print the counts; those that grew too far."""
    for name, count in now.items():
        print(f"{name:40} {count:<32} baseline {before.get(name, 'none')}")

    def most(name: str, count: int) -> float:
        tolerance = lowered.TOLERANCE if name.startswith(lowered.LOWERED) else TOLERANCE
        return (1 + tolerance) * before.get(name, count)

    return [name for name, count in now.items() if count > most(name, count)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--short", action="store_true", help="count, measure nothing")
    parser.add_argument("--rounds", type=int, default=5, help="turns of each side, per size")
    parser.add_argument("--core", type=int, default=0, help="the core that all sides are pinned to")
    parser.add_argument("--write", action="store_true", help="make what was measured the baseline")
    asked = parser.parse_args()
    import jax

    baseline: dict[str, Any] = json.loads(BASELINE.read_text(encoding="utf-8")) if BASELINE.exists() else {}
    counts = counted()
    same_version = baseline.get("jax") == jax.__version__
    bad = grown(counts, baseline.get("counts", {}) if same_version else {})
    if not same_version:
        print(f"the baseline was counted with jax {baseline.get('jax', '(none)')}, this is {jax.__version__}")
    measured = {}
    if not asked.short:
        ratios = environment.compare(asked.rounds, asked.core)
        bad += fallen("environment", ratios, baseline.get("environment", {}))
        parts = shares(asked.rounds, asked.core)
        bad += fallen("training", parts, baseline.get("training", {}))
        measured = {"environment": rounded(ratios), "training": rounded(parts)}
    missing = [label for label in bad if label.endswith("(not measured)")]
    if asked.write and missing:
        sys.exit(f"{BASELINE.name} stays as it was: {'; '.join(missing)}")
    if asked.write:
        baseline |= {"jax": jax.__version__, "counts": counts, **measured}
        BASELINE.write_text(json.dumps(baseline, indent=2) + "\n", encoding="utf-8")
    elif bad:
        sys.exit(f"slower than {BASELINE.name} by more than {TOLERANCE:.0%}, or missing: {'; '.join(bad)}")


if __name__ == "__main__":
    main()
