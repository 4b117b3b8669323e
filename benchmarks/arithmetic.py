"""How far training is from the arithmetic limit of the machine: counted products against measured ones.

    python benchmarks/arithmetic.py [--preset gacrl …] [--shapes shipped] [--num-envs N] [--core 0] [--each] [--json]

For each preset: the matrix products of one update and the acting before it, counted from the program's jaxpr; the time
that an update takes; and two limits. `large`: their FLOPs at the speed of a 512 × 512 product. `own`: each of them
measured alone, at its own shape, and added up; --each tells each. CPU time of one thread on one core.
"""

import argparse
import json
import os
from dataclasses import replace
from typing import Any

import peers
import training

PRESETS = ("gacrl", "qmix", "mappo", "ippo", "paper")
SECONDS = 2.0
"""Of a measurement, about."""


def measure(preset: str, shapes: str, num_envs: int | None, each: bool = False) -> dict[str, float]:
    """Milliseconds of an update, its MFLOP, and the milliseconds of the two limits."""
    import jax
    import jax.numpy as jnp
    from products import Product, alone, products, total
    from updates import timed

    from gacrl.training import build

    run = training.settings(preset, shapes)
    if num_envs is not None:
        run = replace(run, training=replace(run.training, num_envs=num_envs))
    trainer = build.make_trainer(run)
    taken, _ = timed(trainer, run, SECONDS)
    one = jax.eval_shape(trainer.init_member, jax.random.key(0), trainer.algorithm.hyper)
    found = products(jax.make_jaxpr(trainer.chunk_of_one)(one, jnp.int32(1)).jaxpr)
    large = Product((512, 512), (512, 512), (((1,), (0,)), ((), ())))
    taken_alone = {product: count * alone(product) for product, count in found.items()}
    for product, seconds in sorted(taken_alone.items(), key=lambda item: -item[1]) if each else ():
        speed = found[product] * product.flops / seconds / 1e9
        factors = f"{product.left} {product.right} over {product.dimensions[0]}"
        print(f"{preset}: {found[product]:5} times {factors:60} {speed:4.0f} GFLOP/s {1e3 * seconds:6.2f} ms")
    own = sum(taken_alone.values())
    return {
        "steps_per_second": run.steps_per_update / taken,
        "milliseconds": 1e3 * taken,
        "megaflop": total(found) / 1e6,
        "large": 1e3 * total(found) * alone(large) / large.flops,
        "own": 1e3 * own,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--preset", action="append", help="several times for several; by default one of each kind")
    parser.add_argument(
        "--shapes",
        choices=("shipped", "jaxmarl", "benchmarl"),
        default="shipped",
        help="a peer's networks, batches and epochs, as in training.py",
    )
    parser.add_argument("--num-envs", type=int, help="instead of the preset's")
    parser.add_argument("--core", type=int, default=0)
    parser.add_argument("--each", action="store_true", help="every product, and its speed alone")
    parser.add_argument("--json", action="store_true")
    asked = parser.parse_args()
    os.environ |= peers.ONE_THREAD
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {asked.core})
    from gacrl.training.devices import prepare_jax

    prepare_jax()
    table: dict[str, Any] = {}
    print("| preset | steps/s | ms an update | MFLOP | at a large product's speed | each at its own |")
    print("| --- | --- | --- | --- | --- | --- |")
    for preset in asked.preset or PRESETS:
        seen = table[preset] = measure(preset, asked.shapes, asked.num_envs, asked.each)
        print(
            f"| {preset} | {seen['steps_per_second']:,.0f} | {seen['milliseconds']:.3g} | {seen['megaflop']:.3g} | "
            f"{seen['large'] / seen['milliseconds']:.0%} | {seen['own'] / seen['milliseconds']:.0%} |",
            flush=True,
        )
    if asked.json:
        print(json.dumps(table))


if __name__ == "__main__":
    main()
