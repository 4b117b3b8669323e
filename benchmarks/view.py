"""How quickly the live page answers, and what it costs a training.

    python benchmarks/view.py page [--rounds 3] [--json]
    python benchmarks/view.py train [--env-steps 160000] [--interval 4096] [--num-seeds 2] [--json]

`page` serves pretrained:gacrl-teams and measures from the line with the address on: seconds to the first frame (and in
Chromium, where it and Playwright are there, to the page that can be used), seconds until a change of the number of
agents is answered, and policy steps a second with 100 agents, untouched and with a silenced agent, which is two lanes.
CPU time of the server stands beside: on a machine that has other things to do the clock says little.

`train` trains the preset vdn with `--view` while a visitor watches at the page's normal speed, five steps a second.
From one evaluation to the next the page's process goes on and is stopped in turns, so that what else the machine does
hits both alike. It prints the median ratio of the training's steps a second (without compiling and evaluation), on to
off, of neighbouring chunks, with its quartiles; and the CPU seconds of the page's process beside those of the training.
"""

import argparse
import contextlib
import json
import os
import re
import signal
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import chromium
from websockets.sync.client import connect

CROWD = 100
AT_HOME = 5
"""Agents that pretrained:gacrl-teams has by itself."""
STEPS = 60
"""Of a measurement with 100 agents."""
WARM = 60.0
"""Seconds at the most that the programs for other numbers of agents are given."""


class Line:
    """A visitor's socket."""

    def __init__(self, socket: Any) -> None:
        self._socket, self._version = socket, 0

    def scene(self, seed: int, count: int, *events: dict[str, Any]) -> None:
        self._version += 1
        message = {"kind": "scene", "version": self._version, "seed": seed, "count": count, "events": events}
        self._socket.send(json.dumps(message))

    def frames(self, first: int, last: int) -> dict[str, Any]:
        """The last of them, once all are here."""
        asked = {"kind": "frames", "version": self._version, "first": first, "last": last}
        self._socket.send(json.dumps(asked))
        while True:
            told = json.loads(self._socket.recv(timeout=300))
            if told["kind"] == "error":
                raise RuntimeError(told["says"])
            if told["kind"] == "frame" and told["version"] == self._version and told["t"] == last:
                return told


@contextlib.contextmanager
def visiting(address: str) -> Iterator[Line]:
    """A visitor of the page at that address."""
    with connect(re.sub(r"^http(://[^/]*)/", r"ws\1/live", address), max_size=2**24) as socket:
        yield Line(socket)


@contextlib.contextmanager
def serving(*words: str) -> Iterator[tuple[str, float, int]]:
    """`gacrl view` in a process of its own: its address, the seconds that it took to print it, and its number."""
    begun = time.perf_counter()
    command = [sys.executable, "-m", "gacrl", "view", *words, "--port", "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
        assert server.stdout is not None
        try:
            line = next(line for line in server.stdout if line.startswith("page "))
            yield line.split()[1], time.perf_counter() - begun, server.pid
        finally:
            server.terminate()


def page(rounds: int) -> dict[str, Any]:
    """Everything about the page."""
    with serving("pretrained:gacrl-teams") as (address, up, process):
        begun = time.perf_counter()
        with visiting(address) as line:
            line.scene(1, AT_HOME)
            line.frames(0, 0)
            found = {"seconds until it is up": up, "first frame": time.perf_counter() - begun}
            painted = first_paint(address)
            if painted is not None:
                found["first paint in Chromium"] = painted
            found["first answer to 100 agents"] = change(line, 2, CROWD)
            wait_until_warm(line)
            found |= {
                f"answer to {count} agents": statistics.median(change(line, seed, count) for seed in range(rounds))
                for count in (AT_HOME + 1, 30, CROWD)
            }
            silence = {"at": 0, "kind": "fate", "agent": 0, "fate": {"kind": "silence"}}
            pace(line, process, 9, silence)
            untouched = [pace(line, process, 10 + seed) for seed in range(rounds)]
            both = [pace(line, process, 30 + seed, silence) for seed in range(rounds)]
    return {
        **{name: round(value, 3) for name, value in found.items()},
        "100 agents: [steps a second, CPU ms a step]": untouched,
        "the same, one silenced, two lanes": both,
        "load": os.getloadavg(),
    }


def change(line: Line, seed: int, count: int) -> float:
    """Seconds from asking for another number of agents to seeing them, in the middle of an episode."""
    line.scene(seed, AT_HOME)
    line.frames(0, 10)
    begun = time.perf_counter()
    line.scene(seed, AT_HOME, *[{"at": 10, "kind": "add"}] * (count - AT_HOME))
    frame = line.frames(10, 10)
    assert frame["main"]["count"] == count
    return time.perf_counter() - begun


def wait_until_warm(line: Line) -> None:
    """Wait until the programs of all rooms are compiled: until a change of each is answered within a second."""
    deadline = time.perf_counter() + WARM
    while time.perf_counter() < deadline and max(change(line, 3, count) for count in (8, 30, CROWD)) > 1:
        time.sleep(1)


def pace(line: Line, process: int, seed: int, *events: dict[str, Any]) -> tuple[float, float]:
    """Steps a second of an episode with 100 agents, frames sent and read; and the server's CPU ms of a step."""
    line.scene(seed, CROWD, *events)
    line.frames(0, 0)
    begun, spent = time.perf_counter(), cpu_seconds(process)
    line.frames(1, STEPS)
    seconds, spent = time.perf_counter() - begun, cpu_seconds(process) - spent
    return round(STEPS / seconds, 1), round(1000 * spent / STEPS, 1)


def first_paint(address: str) -> float | None:
    """Seconds from opening the address in Chromium until the page shows its first frame; None without a browser."""
    if chromium.missing():
        return None
    with chromium.opened() as browser:
        tab = browser.new_page()
        begun = time.perf_counter()
        tab.goto(address)
        while not tab.evaluate("globalThis.gacrlPage !== undefined"):
            time.sleep(0.01)
        return time.perf_counter() - begun


def train(env_steps: int, interval: int, num_seeds: int) -> dict[str, Any]:
    """Everything about a training that is watched."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        command = [sys.executable, "-m", "gacrl", "train", "--preset", "vdn", "--env-steps", str(env_steps)]
        command += ["--num-seeds", str(num_seeds), "--evaluation.interval", str(interval), "--out", str(out)]
        command += ["--view", "--view-port", "0"]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as run:
            assert run.stdout is not None
            address, ended, seen = "", threading.Event(), {"frames": 0}
            for line in run.stdout:
                address = line.split()[1] if line.startswith("page ") and "http" in line else address
                if line.startswith("page ") and "is open" in line:
                    break
            threading.Thread(target=watch, args=(address, seen, ended), daemon=True).start()
            child = int(Path(f"/proc/{run.pid}/task/{run.pid}/children").read_text().split()[-1])
            spent = {"page": -cpu_seconds(child), "training": -cpu_seconds(run.pid)}
            chunks = in_turns(out / "metrics.jsonl", child, num_seeds, env_steps)
            spent = {
                "page": spent["page"] + cpu_seconds(child),
                "training": spent["training"] + cpu_seconds(run.pid),
            }
            ended.set()
            run.stdout.read()
    ratios = [one / two for one, two in zip(chunks[True], chunks[False], strict=False)]
    quartiles = statistics.quantiles(ratios, n=4)
    return {
        "pairs of chunks": len(ratios),
        "steps a second, on over off": [round(value, 3) for value in (quartiles[1], quartiles[0], quartiles[2])],
        "sums over all chunks": round(harmonic(chunks[True]) / harmonic(chunks[False]), 3),
        "steps a second off, median": round(statistics.median(chunks[False])),
        "frames watched": seen["frames"],
        "CPU seconds of the page, half of the time on": round(spent["page"], 2),
        "CPU seconds of training": round(spent["training"], 1),
        "load": os.getloadavg(),
    }


def in_turns(metrics: Path, child: int, num_seeds: int, env_steps: int) -> dict[bool, list[float]]:
    """Stop the page and let it go on, chunk by chunk; the training's steps a second in the chunks of each kind."""
    chunks: dict[bool, list[float]] = {True: [], False: []}
    running, before = True, None
    try:
        while True:
            rows = [
                json.loads(line) for line in metrics.read_text().splitlines(keepends=True) if line.endswith("\n")
            ]
            row = rows[-1]
            done = row["env_steps"] * num_seeds, row["env_steps"] * num_seeds / row["steps_per_second"]
            if before is None or done[0] != before[0]:
                if before is not None:
                    chunks[running].append((done[0] - before[0]) / (done[1] - before[1]))
                    running = not running
                    os.kill(child, signal.SIGCONT if running else signal.SIGSTOP)
                before = done
            if row["env_steps"] >= env_steps:
                return chunks
            time.sleep(0.01)
    finally:
        os.kill(child, signal.SIGCONT)


def harmonic(paces: list[float]) -> float:
    """Steps a second of chunks that have as many steps each, together."""
    return len(paces) / sum(1 / pace for pace in paces)


def cpu_seconds(process: int) -> float:
    """CPU seconds that a process has taken so far."""
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def watch(address: str, seen: dict[str, Any], ended: threading.Event) -> None:
    """Be a page that plays one episode after the other at five steps a second."""
    with contextlib.suppress(Exception), visiting(address) as line:
        for seed in range(10_000):
            line.scene(seed, 3)
            for t in range(26):
                if ended.wait(0.2):
                    return
                line.frames(t, t)
                seen["frames"] += 1


def main() -> None:
    """Measure, and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("page", "train"))
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--env-steps", type=int, default=160_000)
    parser.add_argument("--interval", type=int, default=4_096)
    parser.add_argument("--num-seeds", type=int, default=2)
    parser.add_argument("--json", action="store_true")
    asked = parser.parse_args()
    found = page(asked.rounds) if asked.what == "page" else train(asked.env_steps, asked.interval, asked.num_seeds)
    for name, value in found.items():
        print(f"{name:48} {value}")
    if asked.json:
        print(json.dumps(found))


if __name__ == "__main__":
    main()
