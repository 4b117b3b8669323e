"""What sharing the environments of one seed of PPO between two processes is worth: measured, and by a model.

    python benchmarks/devices.py [--preset ippo] [--rounds 3] [--json]

An update of E environments by two processes of one thread each, joined over loopback as `--distributed` joins
them, takes the time of E/2 environments by one, and what the two tell each other:

    seconds = (E/2 alone) + a · messages + b · GB

Messages are the collective operations of an update, GB what they bring together, both counted from the compiled
program. a and b are fitted to the fewest and the most environments, and checked on those between. Wall time, the
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

ENVS = (32, 64, 128, 256)
SECONDS = 2.0
"""Of a measurement, about."""
BYTES = {"pred": 1, "s32": 4, "u32": 4, "f32": 4}


def collectives(hlo: str) -> tuple[float, float]:
    """Collective operations in one run of a compiled program, and the gigabytes of their results.

    A loop whose length is data (over the updates) counts once; what stands outside of it is not of an update.
    """
    bodies: dict[str, list[str]] = {}
    inside: list[str] = []
    for line in hlo.splitlines():
        if opened := re.match(r"^(?:ENTRY )?%?([\w.\-]+) .*\{$", line):
            inside = bodies.setdefault(opened[1], [])
        else:
            inside.append(line)

    def count(name: str) -> tuple[float, float]:
        messages = size = 0.0
        for line in bodies[name]:
            found = re.search(
                r" = (.*?) (?:all-reduce|all-gather|all-to-all|collective-permute)(?:-start)?\(", line
            )
            if found:
                messages += 1
                for kind, dims in re.findall(r"(\w+)\[([\d,]*)\]", found[1]):
                    size += BYTES[kind] * math.prod(int(dim) for dim in dims.split(",") if dim) / 1e9
            if loop := re.search(r" while\(.*body=%?([\w.\-]+)", line):
                turns = re.search(r'known_trip_count":\{"n":"(\d+)"', line)
                inner = count(loop[1])
                messages, size = (
                    a + (int(turns[1]) if turns else 1) * b for a, b in zip((messages, size), inner, strict=True)
                )
        return messages, size

    loops = [
        re.search(r" while\(.*body=%?([\w.\-]+)", line)
        for line in hlo.splitlines()
        if "known_trip_count" not in line
    ]
    outermost = [loop[1] for loop in loops if loop]
    return max(map(count, outermost))


def work(preset: str, core: int, address: str, count: int) -> None:
    """One process: for each line of numbers of environments, print the seconds of an update, messages and GB."""
    import jax
    import jax.numpy as jnp

    from gacrl import config
    from gacrl.training import distributed, session
    from gacrl.training.devices import prepare_jax
    from gacrl.training.session import Watcher

    prepare_jax()
    place = distributed.find_place(address, count, core) if count > 1 else distributed.ALONE
    trainers: dict[int, Any] = {}
    with distributed.joined(place, "", 120.0, Watcher()):
        for line in sys.stdin:
            envs = int(line)
            if envs not in trainers:
                run = config.preset(preset)
                trainer = session.build(replace(run, training=replace(run.training, num_envs=envs)))
                state = trainer.init((0,))
                text = trainer.chunk.lower(state, jnp.int32(1)).compile().as_text()
                state = jax.block_until_ready(trainer.chunk(state, 1))[0]
                trainers[envs] = trainer, state, collectives(text or "") if count > 1 else (0, 0)
            trainer, state, told = trainers[envs]
            updates = max(2, round(SECONDS / (0.0008 * envs)))  # the same in both processes
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
                [sys.executable, __file__, "--preset", preset, "--work", f"{core} {address} {count}"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
            )
            for core in range(count)
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
        core, address, count = asked.work.split()
        work(asked.preset, int(core), address, int(count))
        return
    import numpy as np

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
    ends = [ENVS[0], ENVS[-1]]
    extra = [double[envs] - single[envs // 2] for envs in ends]
    a, b = np.linalg.solve([told[envs] for envs in ends], extra)
    print(f"seconds = (half alone) + {a:.3g} · messages + {b:.3g} · GB")
    print(
        "| environments | messages | MB | ms alone | half alone | by two | by the model | error | times as fast |"
    )
    print("| --- " * 9 + "|")
    for envs in ENVS:
        messages, size = told[envs]
        model = single[envs // 2] + a * messages + b * size
        print(
            f"| {envs}{'' if envs in ends else ', held out'} | {messages:.0f} | {1e3 * size:.3g} | "
            f"{1e3 * single[envs]:.3g} | {1e3 * single[envs // 2]:.3g} | {1e3 * double[envs]:.3g} | "
            f"{1e3 * model:.3g} | {model / double[envs] - 1:+.0%} | {single[envs] / double[envs]:.2f} |"
        )
    if asked.json:
        print(json.dumps({"a": a, "b": b, "alone": alone, "shared": shared}))


if __name__ == "__main__":
    main()
