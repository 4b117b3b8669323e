"""Processes that meet, and end together: with a bounded wait, and always with a sentence. They load no JAX."""

import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from typing import Any

import pytest

PROGRAM = """
import sys, time
from gacrl.errors import UserError
from gacrl.training.peers import Place, meet
process, count, port, settings, seconds, then = sys.argv[1:]
try:
    peers = meet(Place(int(process), int(count), "127.0.0.1", int(port)), settings, float(seconds))
except UserError as error:
    sys.exit(str(error))
if process == "0":
    peers.mend = lambda: "mend 0"
    peers.tell("told by 0")
print("met", flush=True)
if then == "leave":
    peers.leave()
    sys.exit()
if then == "fail":
    peers.end("no more paper", 2)
time.sleep(60)
"""


@pytest.fixture
def start() -> Iterator[Any]:
    """`start(process, count, port)` is such a process."""
    running: list[subprocess.Popen[str]] = []

    def start(
        process: int, count: int, port: int, settings: str = "same", seconds: float = 20, then: str = "stay"
    ) -> subprocess.Popen[str]:
        words = [sys.executable, "-c", PROGRAM, *map(str, (process, count, port, settings, seconds, then))]
        running.append(subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True))
        return running[-1]

    yield start
    for child in running:
        child.kill()
        child.communicate()


@pytest.fixture
def port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return server.getsockname()[1]


def met(*children: subprocess.Popen[str]) -> None:
    for child in children:
        assert child.stdout is not None
        assert child.stdout.readline() == "met\n"


def ended(child: subprocess.Popen[str], code: int = 1) -> str:
    said = child.communicate(timeout=5)[1]
    assert child.returncode == code, said
    return said.strip()


@pytest.mark.parametrize(("victim", "mend"), [(2, "mend 0"), (0, "told by 0")])
def test_all_end_within_five_seconds_of_a_death(start: Any, port: int, victim: int, mend: str):
    children = [start(process, 3, port) for process in (2, 0, 1)]
    by_process = [children[1], children[2], children[0]]
    met(*children)
    time.sleep(0.2)  # what process 0 tells is on its way
    by_process[victim].kill()
    for process in {0, 1, 2} - {victim}:
        sentence = f"gacrl: process {victim} of 3 has died, and with it the job: {mend}"
        assert ended(by_process[process]) == sentence


def test_who_has_left_is_not_missed(start: Any, port: int):
    """Process 1 waits for process 0, and both end well."""
    first, second = start(0, 2, port, then="leave"), start(1, 2, port, then="leave")
    assert ended(first, 0) == ended(second, 0) == ""


def test_the_reason_of_one_is_told_by_all(start: Any, port: int):
    children = [start(process, 3, port, then="fail" if process == 1 else "stay") for process in range(3)]
    codes = (1, 2, 1)
    assert [ended(child, code) for child, code in zip(children, codes, strict=True)] == [
        "gacrl: no more paper"
    ] * 3


def test_a_process_that_does_not_come_is_waited_for_and_named(start: Any, port: int):
    first, second = start(0, 3, port, seconds=2), start(1, 3, port)
    sentence = (
        f"of 3 processes these did not come to 127.0.0.1:{port} within 2 s: 2; start them, or give --num-processes "
        "as there are"
    )
    assert ended(first) == ended(second) == sentence


def test_a_coordinator_that_is_not_there_is_waited_for_and_named(start: Any, port: int):
    assert ended(start(1, 2, port, seconds=1)).startswith(
        f"process 0 cannot be reached at 127.0.0.1:{port} within 1 s"
    )


@pytest.mark.parametrize(
    ("other", "sentence"),
    [
        ({"process": 0, "count": 2}, "two processes say that they are process 0: give each its own --process-id"),
        ({"process": 1, "count": 3}, "process 1 was told of 3 processes, process 0 of 2"),
        (
            {"process": 1, "count": 2, "settings": "other"},
            "process 1 has other settings, or another version, than",
        ),
    ],
)
def test_who_does_not_belong_there_is_told(start: Any, port: int, other: dict[str, Any], sentence: str):
    first = start(0, 2, port)
    if (
        other["process"] == 0
    ):  # as a process that was given the number 0 by mistake would not come, this one speaks for it
        said = speak(port, '{"process": 0, "count": 2, "settings": "same"}\n')
        assert sentence in said
    else:
        assert ended(start(port=port, **other)).startswith(sentence)
    assert ended(first).startswith(sentence)


def speak(port: int, words: str) -> str:
    """Say that to process 0, and hear the answer."""
    end = time.monotonic() + 5
    while True:
        try:
            with socket.create_connection(("127.0.0.1", port), timeout=5) as connection:
                connection.sendall(words.encode())
                return connection.makefile().readline()
        except ConnectionRefusedError:
            assert time.monotonic() < end
            time.sleep(0.05)


def test_a_stranger_at_the_port_is_sent_away(start: Any, port: int):
    first = start(0, 2, port)
    for words in ("GET / HTTP/1.1\r\n", "[1]\n", '{"process": "x"}\n', "\xff\n"):
        assert "coordinator" not in speak(port, words)
    met(start(1, 2, port), first)
