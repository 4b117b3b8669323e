"""How quickly the live page answers, and what it costs a training.

    python benchmarks/view.py page [--rounds 3] [--json]
    python benchmarks/view.py train [--rounds 3] [--env-steps 30000] [--num-seeds 2] [--json]

`page` serves pretrained:gacrl-teams and measures from the line with the address on: seconds to the first frame (and in
Chromium, where it and Playwright are there, to the page that can be used), seconds until a change of the number of
agents is answered, and policy steps a second with 100 agents, untouched and with a silenced agent, which is two lanes.
CPU time of the server stands beside: on a machine that has other things to do the clock says little.

`train` trains the preset vdn with `--view` and without, in turns (off on, on off, …), while a visitor watches at the
page's normal speed, five steps a second. It prints the ratio of the training's steps a second (without compiling and
evaluation), turn by turn, and the CPU seconds of the page's process beside those of the training.
"""

import argparse
import contextlib
import json
import os
import re
import shutil
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

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
    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    try:
        from playwright.sync_api import sync_playwright
    except ImportError:
        return None
    if chromium is None:
        return None
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        tab = browser.new_page()
        begun = time.perf_counter()
        tab.goto(address)
        while not tab.evaluate("globalThis.gacrlPage !== undefined"):
            time.sleep(0.01)
        seconds = time.perf_counter() - begun
        browser.close()
    return seconds


def train(rounds: int, env_steps: int, num_seeds: int) -> dict[str, Any]:
    """Everything about a training that is watched."""
    turns: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as folder:
        for number in range(rounds):
            order = (False, True) if number % 2 == 0 else (True, False)
            pair = {
                watched: trained(Path(folder), f"{number}-{watched}", env_steps, num_seeds, watched)
                for watched in order
            }
            on, off = pair[True], pair[False]
            turns.append(
                {
                    "steps a second off": round(off["steps"]),
                    "on": round(on["steps"]),
                    "ratio": round(on["steps"] / off["steps"], 3),
                    "CPU seconds of training": round(on["cpu"], 1),
                    "of the page": round(on["page"], 2),
                    "frames watched": on["frames"],
                }
            )
            print(turns[-1], file=sys.stderr, flush=True)
    return {
        "turns": turns,
        "median ratio": statistics.median(turn["ratio"] for turn in turns),
        "CPU seconds of the page over those of training": round(
            sum(turn["of the page"] for turn in turns) / sum(turn["CPU seconds of training"] for turn in turns), 4
        ),
        "load": os.getloadavg(),
    }


def trained(folder: Path, name: str, env_steps: int, num_seeds: int, watched: bool) -> dict[str, Any]:
    """Train once: its pace, and the CPU seconds of its process and of the page's."""
    out, seen = folder / name, {"frames": 0, "page": 0.0, "cpu": 0.0}
    command = [
        sys.executable,
        "-m",
        "gacrl",
        "train",
        "--preset",
        "vdn",
        "--env-steps",
        str(env_steps),
        "--out",
        str(out),
    ]
    command += ["--num-seeds", str(num_seeds), "--evaluation.interval", str(env_steps // 10)]
    command += ["--view", "--view-port", "0"] if watched else []
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as run:
        assert run.stdout is not None
        ended, address = threading.Event(), ""
        threading.Thread(target=account, args=(run.pid, seen, ended), daemon=True).start()
        for line in run.stdout:
            address = line.split()[1] if line.startswith("page ") and "http" in line else address
            if line.startswith("page ") and "is open" in line:
                threading.Thread(target=watch, args=(address, seen, ended), daemon=True).start()
        ended.set()
    summary = json.loads((out / "summary.json").read_text())
    return {**seen, "steps": summary["steps_per_second"]}


def account(process: int, seen: dict[str, Any], ended: threading.Event) -> None:
    """Note the CPU seconds of a training and of its page, as long as they live."""
    while not ended.wait(0.5):
        with contextlib.suppress(OSError, ValueError, IndexError):
            children = Path(f"/proc/{process}/task/{process}/children").read_text().split()
            seen["cpu"] = cpu_seconds(process)
            seen["page"] = sum(map(cpu_seconds, map(int, children)))


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
    parser.add_argument("--env-steps", type=int, default=30_000)
    parser.add_argument("--num-seeds", type=int, default=2)
    parser.add_argument("--json", action="store_true")
    asked = parser.parse_args()
    found = page(asked.rounds) if asked.what == "page" else train(asked.rounds, asked.env_steps, asked.num_seeds)
    for name, value in found.items():
        print(f"{name:48} {value}")
    if asked.json:
        print(json.dumps(found))


if __name__ == "__main__":
    main()
