"""What sharing the environments of one seed of PPO between two processes is worth: measured, and by a model.

    python benchmarks/devices.py [--preset ippo] [--rounds 3] [--json]

Two processes of one thread each, joined over loopback as `--distributed` joins them, have half of an update's
environments each, and tell each other what they found:

    seconds = c · (an update of half as many, alone) + a · messages

Messages are the arrays that collective operations bring together (gloo sends each by itself), counted from the compiled
program. c and a are fitted to every second number of environments, and checked on the others. Wall time, the
median of the rounds, in which all take turns; the machine should have nothing else to do.
"""

import argparse
import json
import math
import re
import socket
import statistics
import subprocess
import sys
import time
from dataclasses import replace
from typing import Any

import numpy as np

ENVS = (32, 64, 128, 256, 512)
SECONDS = 2.0
"""Of a measurement, about."""
BYTES = {"pred": 1, "s32": 4, "u32": 4, "f32": 4}


def collectives(hlo: str) -> tuple[int, float]:
    """Arrays that the collective operations of an update bring together, and their gigabytes.

    hlo: a compiled chunk of training. Its loop over the updates is the one whose length is data; it is counted once.
    """
    computations: dict[str, list[str]] = {}
    lines: list[str] = []
    for line in hlo.splitlines():
        if opened := re.match(r"^(?:ENTRY )?%?([\w.\-]+) .*\{$", line):
            lines = computations.setdefault(opened[1], [])
        lines.append(line)

    def loop_in(line: str) -> tuple[str, int | None] | None:
        """Its body, and how often it runs where that is known."""
        body = re.search(r" while\(.*body=%?([\w.\-]+)", line)
        turns = re.search(r'known_trip_count":\{"n":"(\d+)"', line)
        return (body[1], int(turns[1]) if turns else None) if body else None

    def count(computation: str) -> np.ndarray:
        found = np.zeros(2)
        for line in computations[computation]:
            if told := re.search(
                r" = (.*?) (?:all-(?:reduce|gather|to-all)|collective-permute)(?:-start)?\(", line
            ):
                for kind, dims in re.findall(r"(\w+)\[([\d,]*)\]", told[1]):
                    found += 1, BYTES[kind] * math.prod(int(dim) for dim in dims.split(",") if dim) / 1e9
            if loop := loop_in(line):
                found += (loop[1] or 1) * count(loop[0])
        return found

    loops = [loop for line in hlo.splitlines() if (loop := loop_in(line))]
    messages, size = max((count(body) for body, turns in loops if turns is None), key=lambda found: found[0])
    return int(messages), float(size)


def work(preset: str, process: int, address: str, count: int) -> None:
    """One process: for each line of numbers of environments, print the seconds of an update, messages and GB."""
    import jax
    import jax.numpy as jnp

    from gacrl.config import presets
    from gacrl.training import build, distributed
    from gacrl.training.devices import prepare_jax
    from gacrl.training.watching import Watcher

    prepare_jax()
    place = distributed.find_place(address, count, process) if count > 1 else distributed.ALONE
    trainers: dict[int, Any] = {}
    with distributed.joined(place, "", 120.0, Watcher()):
        for line in sys.stdin:
            envs = int(line)
            if envs not in trainers:
                run = presets.preset(preset)
                trainer = build.make_trainer(replace(run, training=replace(run.training, num_envs=envs)))
                state = trainer.init((0,))
                text = trainer.chunk.lower(state, jnp.int32(1)).compile().as_text()
                state = jax.block_until_ready(trainer.chunk(state, 1))[0]
                trainers[envs] = trainer, state, collectives(text or "") if count > 1 else (0, 0)
            trainer, state, told = trainers[envs]
            updates = max(2, round(SECONDS / (0.0008 * envs)))  # not by the clock: the same in both processes
            begun = time.perf_counter()
            state = jax.block_until_ready(trainer.chunk(state, updates))[0]
            taken = (time.perf_counter() - begun) / updates
            trainers[envs] = trainer, state, told
            print(json.dumps({"answer": [taken, *told]}), flush=True)


def answered(process: subprocess.Popen[str]) -> list[float]:
    """The next answer of a process; gloo prints too."""
    assert process.stdout
    return next(json.loads(line)["answer"] for line in process.stdout if line.startswith('{"answer"'))


class Group:
    """Processes that train together."""

    def __init__(self, preset: str, count: int):
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            address = f"127.0.0.1:{free.getsockname()[1]}"
        self.processes = [
            subprocess.Popen(
                [sys.executable, __file__, "--preset", preset, "--work", f"{process} {address} {count}"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
            )
            for process in range(count)
        ]

    def ask(self, envs: int) -> list[float]:
        """What the first of them says of an update of so many environments."""
        for process in self.processes:
            assert process.stdin
            print(envs, file=process.stdin, flush=True)
        first, *_ = [answered(process) for process in self.processes]
        return first

    def close(self) -> None:
        for process in self.processes:
            assert process.stdin
            process.stdin.close()
        for process in self.processes:
            process.wait()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--preset", default="ippo", help="one of PPO's")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--work", help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.work:
        process, address, count = asked.work.split()
        work(asked.preset, int(process), address, int(count))
        return
    one, two = Group(asked.preset, 1), Group(asked.preset, 2)
    alone: dict[int, list[float]] = {}
    shared: dict[int, list[list[float]]] = {}
    for turn in range(asked.rounds):
        print(f"round {turn + 1} of {asked.rounds}", flush=True)
        for envs in (ENVS[0] // 2, *ENVS):
            alone.setdefault(envs, []).append(one.ask(envs)[0])
        for envs in ENVS:
            shared.setdefault(envs, []).append(two.ask(envs))
    one.close()
    two.close()
    single = {envs: statistics.median(times) for envs, times in alone.items()}
    double = {envs: statistics.median(answer[0] for answer in answers) for envs, answers in shared.items()}
    told = {envs: answers[0][1:] for envs, answers in shared.items()}
    fitted = ENVS[::2]
    terms = np.array([[single[envs // 2], told[envs][0]] for envs in fitted])
    measured = np.array([double[envs] for envs in fitted])
    c, a = np.linalg.lstsq(terms / measured[:, None], np.ones(len(fitted)))[0]
    print(f"seconds = {c:.3g} · (half alone) + {a:.3g} · messages")
    print(
        "| environments | messages | MB | ms alone | half alone | by two | by the model | error | times as fast |"
    )
    print("| --- " * 9 + "|")
    for envs in ENVS:
        messages, size = told[envs]
        model = c * single[envs // 2] + a * messages
        print(
            f"| {envs}{'' if envs in fitted else ', held out'} | {messages:.0f} | {1e3 * size:.3g} | "
            f"{1e3 * single[envs]:.3g} | {1e3 * single[envs // 2]:.3g} | {1e3 * double[envs]:.3g} | "
            f"{1e3 * model:.3g} | {model / double[envs] - 1:+.0%} | {single[envs] / double[envs]:.2f} |"
        )
    if asked.json:
        print(json.dumps({"c": c, "a": a, "alone": alone, "shared": shared}))


if __name__ == "__main__":
    main()
