"""The paper's schedule, one update per environment step: this library beside a plain MPE2 + PyTorch program.

    python benchmarks/paper_schedule.py [--rounds 5] [--core 0] [--json]

Both run on the same single core, taking turns, so that a noisy machine slows both; the figure is the ratio
of their steps per second, the median over the rounds, with the smallest and the largest. PyTorch lives in an
environment of its own under `.bench/`, made at the first call. Compilation is not part of it (both warm up).

Printed besides: which share of our step is arithmetic, that is the floating point operations of the networks
(counted from their shapes, forward and backward) at the speed that this core reaches in a large matrix
product, over the time of a step.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import time
from pathlib import Path

import peers

HERE = Path(__file__).parent
STEPS, WARMUP = 3_000, 300


def run_peer(python: str, core: int, fused: bool) -> float:
    """Steps per second of the plain program."""
    command = [python, str(HERE / "plain_torch.py"), "--steps", "1500", "--warmup", str(WARMUP), "--json"]
    command += ["--core", str(core)] + ["--fused"] * fused
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return json.loads(done.stdout.splitlines()[-1])["steps_per_second"]


def run_ours(core: int) -> dict[str, float]:
    """Steps per second of the library, in a process of its own; and of a matrix product, in GFLOP/s."""
    command = [sys.executable, __file__, "--ours", "--core", str(core)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return json.loads(done.stdout.splitlines()[-1])


def measure_ours(core: int) -> None:
    """The body of `run_ours`: the training program of `gacrl train --preset paper`, without evaluations."""
    os.sched_setaffinity(0, {core})
    from gacrl.training import build
    from gacrl.training.devices import prepare_jax

    prepare_jax()
    import jax
    import jax.numpy as jnp

    import gacrl

    trainer = build.make_trainer(gacrl.preset("paper"))
    state, _ = trainer.chunk(trainer.init((0,)), WARMUP)
    rates = []
    for _ in range(5):
        begun = time.perf_counter()
        state, report = trainer.chunk(state, STEPS // 5)
        jax.block_until_ready(report)
        rates.append(STEPS / 5 / (time.perf_counter() - begun))

    size, repeats = 512, 40
    square = jnp.ones((size, size))
    multiply = jax.jit(lambda a: jax.lax.fori_loop(0, repeats, lambda _, x: x @ square / size, a))
    multiply(square).block_until_ready()
    speeds = []
    for _ in range(5):
        begun = time.perf_counter()
        multiply(square).block_until_ready()
        speeds.append(2 * size**3 * repeats / (time.perf_counter() - begun) / 1e9)
    result = {"steps_per_second": statistics.median(rates), "gflops": statistics.median(speeds)}
    print(json.dumps(result))


def flops_per_step() -> int:
    """Multiplications and additions of the weights' matrix products in one step of the paper's algorithm.

    65 rows of 3 agents (and the acting step) go through encoder, messages and policy, 64 states through the
    critic; backward costs the same again for the weights' gradients, and once more for the activations'
    except in the first layers, whose inputs are observations.
    """
    agents = [(18, 64), (64, 32), (32, 32), (16, 32), (32, 8), (40, 32), (32, 8), (50, 64), (64, 32), (32, 5)]
    critic = [(54, 128), (128, 64), (64, 1)]

    def products(layers: list[tuple[int, int]], rows: int, passes: int) -> int:
        return 2 * passes * rows * sum(i * o for i, o in layers)

    batch, team = 64, 3
    forward_and_weights = products(agents, (batch + 1) * team, 2) + products(critic, batch, 2)
    activations = products(agents[1:], (batch + 1) * team, 1) + products(critic[1:], batch, 1)
    return forward_and_weights + activations + products(agents, team, 1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=5, help="turns of each program")
    parser.add_argument("--core", type=int, default=0, help="the core that both are pinned to")
    parser.add_argument("--json", action="store_true", help="end with one line of JSON: {ratio: {peer: …}}")
    parser.add_argument("--ours", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.ours:
        measure_ours(arguments.core)
        return
    python = peers.python_of("torch")
    if python is None:
        return
    programs = {"mpe2 + PyTorch": False, "mpe2 + PyTorch, fused Adam": True}
    ratios: dict[str, list[float]] = {name: [] for name in programs}
    shares = []
    for turn in range(arguments.rounds):
        ours = run_ours(arguments.core)
        milliseconds = 1e3 / ours["steps_per_second"]
        shares.append(flops_per_step() / ours["gflops"] / 1e6 / milliseconds)
        print(f"round {turn + 1}: ours {ours['steps_per_second']:.0f} steps/s ({milliseconds:.2f} ms)", end="")
        for name, fused in programs.items():
            rate = run_peer(python, arguments.core, fused)
            ratios[name].append(ours["steps_per_second"] / rate)
            print(f", {name} {rate:.0f} ({ratios[name][-1]:.1f} times)", end="", flush=True)
        print(flush=True)
    for name, values in ratios.items():
        middle = statistics.median(values)
        print(f"{middle:.1f} times as fast as {name} ({min(values):.1f} to {max(values):.1f})")
    print(
        f"arithmetic: {flops_per_step() / 1e6:.1f} MFLOP a step, {statistics.median(shares):.0%} of its time "
        f"at the {ours['gflops']:.0f} GFLOP/s of a 512 × 512 matrix product on this core"
    )
    if arguments.json:
        summary = {name: {"N=3": statistics.median(values)} for name, values in ratios.items()}
        print(json.dumps({"ratio": summary, "spread": ratios, "arithmetic_share": statistics.median(shares)}))


if __name__ == "__main__":
    main()
