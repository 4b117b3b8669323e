"""What a user of one GPU waits for: starts, compiling, training; and JaxMARL beside, in under six minutes.

    python benchmarks/gpu.py [--preset gacrl --preset ippo] [--jaxmarl CHECKOUT [--peer-python PYTHON]] [--json]
    python benchmarks/gpu.py --small      # the same at tiny sizes: a try on a CPU

Every figure comes from a process of its own, and the first line names the device: on a CPU the same is measured there.

* a start: `gacrl train --env-steps 15000`, typed to prompt, with an empty cache and again with the full one;
* programs: of each, seconds to lower and to compile without a cache, and instructions as handed to the compiler;
* pace: environment steps a second (wall time, compiled before) of presets with 1 and 10 seeds;
* JaxMARL: its IPPO and QMIX from a checkout, and ours at its networks, batches and epochs: steps a second and
  seconds to compile. --peer-python: an interpreter that has `jaxmarl`; by default this one.

What has not begun after --seconds is named and left out. XLA_FLAGS of yours are used as they are, so that
`XLA_FLAGS=--xla_gpu_autotune_level=4 python benchmarks/gpu.py` measures other flags.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import commands
import lowered
import peers
import training

TURNS = 3
ALGORITHMS = ("ippo", "qmix")
Part = tuple[str, list[str]]
"""What is measured, and the words after `gpu.py --part`."""


def device() -> dict[str, Any]:
    """The card, and what computes on it."""
    import jax

    first = jax.devices()[0]
    return {
        "device": first.device_kind,
        "platform": first.platform,
        "jax": jax.__version__,
        "flags": os.environ.get("XLA_FLAGS", ""),
    }


def timed_compile(lower: Callable[[], Any]) -> dict[str, float]:
    """Seconds to lower and to compile, and instructions in between."""
    begun = time.perf_counter()
    low = lower()
    middle = time.perf_counter()
    low.compile()
    done = time.perf_counter()
    return {
        "lower": middle - begun,
        "compile": done - middle,
        "instructions": lowered.instructions(low.as_text()),
    }


def programs(preset: str) -> dict[str, Any]:
    """Each program of a training run."""
    import jax
    import jax.numpy as jnp

    from gacrl.config import presets
    from gacrl.training import ahead, build
    from gacrl.training.trainer import Trainer

    run = presets.preset(preset)
    trainer = build.make_trainer(run)
    assert isinstance(trainer, Trainer)
    state = build.stacked_shapes(trainer)
    count = run.evaluation.num_episodes
    made: dict[str, Callable[[], Any]] = {
        "start": lambda: trainer.lower_init(run.seeds[0]),
        "chunk": lambda: trainer.chunk.lower(state, jax.ShapeDtypeStruct((), jnp.int32)),
        "greedy": lambda: Trainer.evaluate.lower(trainer, state.learner, False, "monitor", count),
        "sampled": lambda: Trainer.evaluate.lower(trainer, state.learner, True, "monitor", count),
    }
    names = ("closing greedy", "closing sampled", "episodes to look at")
    made |= dict(zip(names, ahead.closing(trainer, run), strict=True))
    return {name: timed_compile(lower) for name, lower in made.items()}


def trained(run: Any, seconds: float) -> dict[str, float]:
    """Steps a second of all seeds together, and seconds to compile."""
    import jax

    from gacrl.training import build

    trainer = build.make_trainer(run)
    state = trainer.init(run.seeds)
    warm = -(-getattr(run.algorithm, "learning_starts", 0) // run.steps_per_update) + 1
    begun = time.perf_counter()
    chunk = trainer.compiled(state, warm)
    compiling = time.perf_counter() - begun
    state, _ = jax.block_until_ready(chunk(state, warm))

    def turn(updates: int) -> float:
        nonlocal state
        begun = time.perf_counter()
        state, _ = jax.block_until_ready(chunk(state, updates))
        return (time.perf_counter() - begun) / updates

    updates = max(1, round(seconds / turn(2)))
    pace = statistics.median(turn(updates) for _ in range(TURNS))
    return {"steps_per_second": run.steps_per_update * len(run.seeds) / pace, "compile": compiling}


def pace(preset: str, seeds: int, seconds: float) -> dict[str, float]:
    """The preset as it is, with so many seeds."""
    from gacrl.config import presets

    return trained(replace(presets.preset(preset), num_seeds=seeds), seconds)


def ours(algorithm: str, seconds: float) -> dict[str, float]:
    """Our preset with JaxMARL's networks, batches and epochs."""
    return trained(training.settings(algorithm, "jaxmarl"), seconds)


def jaxmarl(algorithm: str, checkout: str, steps: int) -> dict[str, float]:
    """A baseline of JaxMARL, from its repository."""
    import jax

    _, said, train = peers.jaxmarl_baseline(algorithm, checkout, steps)
    begun = time.perf_counter()
    compiled = jax.jit(train).lower(jax.random.PRNGKey(0)).compile()
    compiling = time.perf_counter() - begun
    taken: list[float] = []
    for _ in range(TURNS):
        begun = time.perf_counter()
        jax.block_until_ready(compiled(jax.random.PRNGKey(0)))
        taken.append(time.perf_counter() - begun)
    done = said["NUM_UPDATES"] * said["NUM_STEPS"] * said["NUM_ENVS"]
    return {"steps_per_second": done / statistics.median(taken), "compile": compiling}


def parts(asked: argparse.Namespace) -> Iterator[Part]:
    """What is measured, in order; what matters most comes first."""
    seconds = "0.2" if asked.small else "2"
    for preset in asked.preset[:1]:
        yield f"programs of {preset}", ["programs", preset]
    for preset in asked.preset:
        for seeds in (1, 2) if asked.small else (1, 10):
            yield f"{preset}, {seeds} seeds", ["pace", preset, str(seeds), seconds]
    for algorithm in ALGORITHMS[:1] if asked.small else ALGORITHMS:
        yield f"{algorithm} at JaxMARL's shapes", ["ours", algorithm, seconds]
        if asked.jaxmarl is not None:
            steps = "20000" if asked.small else "1000000"
            yield f"JaxMARL's {algorithm}", ["jaxmarl", algorithm, asked.jaxmarl, steps]


def measure(words: list[str], python: str) -> dict[str, Any]:
    """Run a part in a process of its own, without a cache. A failure is what its last line says."""
    with tempfile.TemporaryDirectory() as cache:
        environment = {name: value for name, value in os.environ.items() if name != "JAX_COMPILATION_CACHE_DIR"}
        done = subprocess.run(
            [python, __file__, "--part", *words],
            env=environment | {"XDG_CACHE_HOME": cache},
            capture_output=True,
            text=True,
        )
    if done.returncode != 0:
        return {"failed": (done.stderr.strip() or "no reason given").splitlines()[-1]}
    return json.loads(done.stdout.splitlines()[-1])


def starts(small: bool) -> dict[str, float]:
    """Seconds of `gacrl train`, typed to prompt: cold, and warm."""
    command = ("train", "--env-steps", "500" if small else "15000", "--out", "here")
    with tempfile.TemporaryDirectory() as cache:
        return {kind: commands.seconds(command, Path(cache)) for kind in ("cold", "warm")}


def told(name: str, found: dict[str, Any]) -> str:
    """A line, or several, of a table."""
    if all(isinstance(value, dict) for value in found.values()):
        return "\n".join(told(f"{name}: {key}", value) for key, value in found.items())
    values = ", ".join(f"{k} {v:,.4g}" if isinstance(v, float | int) else f"{k} {v}" for k, v in found.items())
    return f"{name:44} {values}"


def run_part(words: list[str]) -> dict[str, Any]:
    """Measure, in this process."""
    kind, *rest = words
    if kind == "jaxmarl":
        return jaxmarl(rest[0], rest[1], int(rest[2]))
    from gacrl.training.devices import prepare_jax

    if kind == "device":
        prepare_jax()
        return device()
    prepare_jax(int(rest[1]) if kind == "pace" else 1)
    if kind == "programs":
        return programs(rest[0])
    if kind == "pace":
        return pace(rest[0], int(rest[1]), float(rest[2]))
    return ours(rest[0], float(rest[1]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--preset", action="append", help="several times for several; by default gacrl, ippo and qmix"
    )
    parser.add_argument("--jaxmarl", help="a checkout of the JaxMARL repository")
    parser.add_argument("--peer-python", default=sys.executable, help="an interpreter that has jaxmarl")
    parser.add_argument("--seconds", type=float, default=300.0, help="after which nothing more is begun")
    parser.add_argument("--only", default="", help="only parts whose names have this in them, and no start")
    parser.add_argument("--small", action="store_true", help="tiny sizes: a try")
    parser.add_argument("--json", action="store_true", help="end with everything in one line")
    parser.add_argument("--part", nargs="+", help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.part is not None:
        print(json.dumps(run_part(asked.part)))
        return
    asked.preset = asked.preset or ["gacrl", "ippo", "qmix"]
    begun = time.perf_counter()
    found: dict[str, Any] = {"machine": measure(["device"], sys.executable)}
    print(told("machine", found["machine"]), flush=True)
    if not asked.only:
        found["start"] = starts(asked.small)
        print(told("gacrl train, typed to prompt", found["start"]), flush=True)
    for name, words in parts(asked):
        if asked.only.lower() not in name.lower():
            continue
        if time.perf_counter() - begun > asked.seconds:
            print(f"{name:44} left out: {asked.seconds:.0f} s are over", flush=True)
            continue
        python = asked.peer_python if words[0] == "jaxmarl" else sys.executable
        found[name] = measure(words, python)
        print(told(name, found[name]), flush=True)
    if asked.json:
        print(json.dumps(found))


if __name__ == "__main__":
    main()
