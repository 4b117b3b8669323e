"""A model of what an update of a preset costs, fitted to measurements, and checked on others.

    python benchmarks/scaling.py [--core 0] [--json]

Time: seconds = a + b · gradient steps + c · GFLOP + d · GB + e · million rows. GFLOP are the matrix products, counted
from the jaxpr; GB is what all other operations read and write, likewise, and rows are how many last axes they write: a
narrow one starts a loop as a wide one does. The numbers are this machine's: least squares of relative errors, none
below 0. Every point is measured in turn, ROUNDS times, and the quickest counts. Memory: what the state holds, counted
from shapes, and f · GB of one gradient step, against what XLA plans for the whole program. Teams, environments, widths,
batches and vocabularies are varied; every fourth point is held out. CPU time of one thread on one core.
"""

import argparse
import json
import math
import os
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import peers

SECONDS = 0.7
ROUNDS = 3
POINTS: tuple[dict[str, int], ...] = (
    {},
    {"num_agents": 5},
    {"num_agents": 8},
    {"num_agents": 6, "width": 48},  # held out, as every fourth
    {"num_agents": 12},
    {"width": 64},
    {"batch_size": 128},
    {"num_agents": 10, "batch_size": 32},
    {"num_envs": 100},
    {"num_agents": 4, "width": 96},
    {"vocabulary": 64},
    {"num_agents": 5, "width": 64, "batch_size": 128, "vocabulary": 32},
)


class Cost(NamedTuple):
    """What an update of one point does, and what it took."""

    gradient_steps: int
    gigaflop: float
    gigabytes: float
    megarows: float
    seconds: float
    state_bytes: int
    planned_bytes: int


def settings(num_agents: int = 3, num_envs: int = 25, batch_size: int = 64, **network: int) -> Any:
    """`gacrl-teams` without its limit on what is seen, of these sizes; entities always as dense."""
    from gacrl.config import presets

    run = presets.preset("gacrl-teams")
    seen = replace(run.algorithm.network, nearest_landmarks=None, nearest_agents=None, **network)
    return replace(
        run,
        algorithm=replace(run.algorithm, network=seen, batch_size=batch_size, replay_capacity=5_000),
        env=replace(run.env, num_agents=num_agents, arena_scale=math.sqrt(num_agents / 3)),
        training=replace(run.training, num_envs=num_envs),
    )


def moved(jaxpr: Any) -> np.ndarray:
    """Bytes that one run of a jaxpr reads and writes, and rows that it writes, products and reshapings aside."""
    from jax.extend.core import jaxprs_in_params

    count = np.zeros(2)
    for equation in jaxpr.eqns:
        name, inner = equation.primitive.name, list(jaxprs_in_params(equation.params))
        if name == "cond":
            count += max((moved(branch.jaxpr) for branch in equation.params["branches"]), key=lambda both: both[0])
        elif inner:
            count += sum(map(moved, inner)) * (equation.params["length"] if name == "scan" else 1)
        elif name not in ("dot_general", "reshape", "broadcast_in_dim", "squeeze", "convert_element_type"):
            small = [v.aval for v in (*equation.invars, *equation.outvars) if hasattr(v.aval, "dtype")]
            if name in (
                "gather",
                "scatter",
                "dynamic_slice",
                "dynamic_update_slice",
            ):  # touch a part of the largest
                small = sorted(small, key=lambda aval: aval.size)[:-1]
            count[0] += sum(aval.size * getattr(aval.dtype, "itemsize", 8) for aval in small)
            written = [v.aval for v in equation.outvars if v.aval.size and v.aval in small]
            count[1] += sum(aval.size / aval.shape[-1] if aval.shape else 1 for aval in written)
    return count


class Point:
    """A program of these sizes, compiled."""

    def __init__(self, point: dict[str, int]):
        import jax
        import jax.numpy as jnp
        from products import products, total
        from updates import timed

        from gacrl.training import build
        from gacrl.training import footprint as memory

        run = settings(**point)
        trainer = build.make_trainer(run)
        one = jax.eval_shape(trainer.init_member, jax.random.key(0), trainer.algorithm.hyper)
        jaxpr = jax.make_jaxpr(trainer.chunk_of_one)(one, jnp.int32(1)).jaxpr
        state = jax.eval_shape(trainer.init_stacked, (0,))
        plan = trainer.chunk.lower(state, jnp.int32(1)).compile().memory_analysis()
        self.measure = lambda: timed(trainer, run, SECONDS)[0]
        size, rows = moved(jaxpr)
        self.cost = Cost(
            run.algorithm.updates,
            total(products(jaxpr)) / 1e9,
            size / 1e9,
            rows / 1e6,
            math.inf,
            memory.size(one),
            plan.temp_size_in_bytes + plan.argument_size_in_bytes,
        )


def fit(costs: list[Cost]) -> tuple[np.ndarray, float]:
    """The five numbers of the time, and the one of the memory."""
    from scipy.optimize import nnls

    rows = np.array([[1.0, *c[:4]] for c in costs])
    seconds = np.array([c.seconds for c in costs])
    times = nnls(rows / seconds[:, None], np.ones(len(costs)))[0]
    planned = np.array([c.planned_bytes for c in costs])
    share = np.array([c.gigabytes / c.gradient_steps * 1e9 for c in costs]) / planned
    rest = 1.0 - np.array([c.state_bytes for c in costs]) / planned
    return times, float(share @ rest / (share @ share))


def predicted(cost: Cost, times: np.ndarray, memory: float) -> tuple[float, float]:
    """Seconds and bytes by the model."""
    seconds = times @ [1.0, *cost[:4]]
    return float(seconds), cost.state_bytes + memory * cost.gigabytes / cost.gradient_steps * 1e9


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--core", type=int, default=0)
    parser.add_argument("--json", action="store_true")
    asked = parser.parse_args()
    os.environ |= peers.ONE_THREAD
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {asked.core})
    from gacrl.training.devices import prepare_jax

    prepare_jax()
    print(f"compiling {len(POINTS)} programs", flush=True)
    points = [Point(point) for point in POINTS]
    for turn in range(ROUNDS):
        print(f"measuring, round {turn + 1} of {ROUNDS}", flush=True)
        for point in points:
            point.cost = point.cost._replace(seconds=min(point.cost.seconds, point.measure()))
    costs = [point.cost for point in points]
    held_out = [number for number in range(len(POINTS)) if number % 4 == 3]
    times, memory = fit([c for number, c in enumerate(costs) if number not in held_out])
    print(
        f"seconds = {times[0]:.3g} + {times[1]:.3g} · gradient steps + {times[2]:.3g} · GFLOP + {times[3]:.3g} · GB "
        f"+ {times[4]:.3g} · million rows; "
        f"bytes = state + {memory:.3g} · bytes moved in a gradient step"
    )
    print("| point | held out | ms | by the model | error | MiB | by the model | error |\n" + "| --- " * 8 + "|")
    for number, (point, seen) in enumerate(zip(POINTS, costs, strict=True)):
        seconds, size = predicted(seen, times, memory)
        print(
            f"| {', '.join(f'{k} {v}' for k, v in point.items()) or 'as it is'} | {'yes' * (number in held_out)} | "
            f"{1e3 * seen.seconds:.3g} | {1e3 * seconds:.3g} | {seconds / seen.seconds - 1:+.0%} | "
            f"{seen.planned_bytes / 2**20:.3g} | {size / 2**20:.3g} | {size / seen.planned_bytes - 1:+.0%} |"
        )
    if asked.json:
        print(json.dumps({"times": times.tolist(), "memory": memory, "costs": [c._asdict() for c in costs]}))


if __name__ == "__main__":
    main()
