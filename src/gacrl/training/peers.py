"""The processes of one job know of each other: they meet before JAX starts, and none outlives another.

Process 0 listens where all were told to come and holds a line (TCP, a JSON object a line) to each of the others. The
system closes the line of a process that dies, whatever it died of, and probes that of a host that has gone. JAX by
itself would let those that are left wait for 100 s, and then end them without a word on why.
"""

import contextlib
import json
import os
import socket
import sys
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NoReturn

from gacrl.errors import UserError

_PROBES = {"TCP_KEEPIDLE": 1, "TCP_KEEPINTVL": 1, "TCP_KEEPCNT": 3}
"""A silent host is probed every second and given up after the third that is not answered."""
_HELLO_SECONDS = 5.0
_FAREWELL_SECONDS = 2.0


@dataclass(frozen=True)
class Place:
    """Which process of a job this is, and where they meet."""

    process: int
    count: int
    host: str
    port: int
    local_devices: tuple[int, ...] | None = None
    """Numbers of the accelerators that are this process's own; None: all of the host."""


class Line:
    """One end of a connection: JSON objects, each on a line."""

    def __init__(self, connection: socket.socket):
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        for name, value in _PROBES.items():
            if hasattr(socket, name):  # not all systems have all of them
                connection.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)
        self._connection = connection
        self._reader = connection.makefile("r", encoding="utf-8")

    def say(self, **words: Any) -> None:
        with contextlib.suppress(OSError):  # nobody is there: whoever listens finds out
            self._connection.sendall((json.dumps(words) + "\n").encode())

    def hear(self, seconds: float | None = None) -> dict[str, Any] | None:
        """Return what comes next; None when the line is dead, says nothing in this time, or speaks another language."""
        try:
            self._connection.settimeout(seconds)
            words = json.loads(self._reader.readline())
        except (OSError, ValueError):
            return None
        return words if isinstance(words, dict) else None  # pyright: ignore[reportUnknownVariableType]

    def close(self) -> None:
        self._reader.close()
        self._connection.close()


class Peers:
    """The other processes: to process 0 all of them, to the others process 0."""

    def __init__(self, place: Place, lines: Mapping[int, Line], coordinator: str):
        self.place = place
        self.coordinator = coordinator
        """Where JAX's own coordinator is to be."""
        self.mend: Callable[[], str] = lambda: "start the job again"
        """What to do when a process has gone."""
        self._lines = lines
        self._ending = threading.Lock()
        self._left = {peer: threading.Event() for peer in lines}
        self._heard = {peer: threading.Event() for peer in lines}
        for peer in lines:
            threading.Thread(target=self._listen, args=(peer,), daemon=True).start()

    def tell(self, mend: str) -> None:
        """Let all know what to do should this process go."""
        self._say(mend=mend)

    def leave(self) -> None:
        """Leave, this process having done its part: process 0 when the others have heard so, the others when it has.

        A line that closes with something unread resets, and what its other end had not read yet is lost.
        """
        self._say(left=True)
        if self.place.process:
            self._left[0].wait()
        end = time.monotonic() + _FAREWELL_SECONDS
        for heard in self._heard.values() if self.place.process == 0 else ():
            heard.wait(max(end - time.monotonic(), 0.0))

    def end(self, because: str, code: int) -> NoReturn:
        """End the whole job; this process with that code, and without waiting for anything that hangs."""
        with self._ending:  # never let go: the first reason is the one that is told
            self._say(ended=because)
            show_cursor = "\n\x1b[?25h" if sys.stderr.isatty() else ""  # a live line has hidden it
            print(f"{show_cursor}gacrl: {because}", file=sys.stderr, flush=True)
            sys.stdout.flush()
            os._exit(code)

    def _say(self, **words: Any) -> None:
        for line in self._lines.values():
            line.say(**words)

    def _listen(self, peer: int) -> None:
        while (words := self._lines[peer].hear()) is not None:
            if "ended" in words:
                self.end(str(words["ended"]), 1)
            if "mend" in words:
                self.mend = lambda mend=str(words["mend"]): mend
            if "left" in words:
                self._lines[peer].say(heard=True)
                self._left[peer].set()
            if "heard" in words:
                self._heard[peer].set()
        self._heard[peer].set()  # or never will
        if not self._left[peer].is_set():
            self.end(f"process {peer} of {self.place.count} has died, and with it the job: {self.mend()}", 1)


def meet(place: Place, settings: str, seconds: float) -> Peers:
    """Wait until all processes of the job have come, for so long. They must have the same `settings`.

    Raises UserError, in every process that can be reached, where some do not come or do not belong together.
    """
    return _gather(place, settings, seconds) if place.process == 0 else _go(place, settings, seconds)


def _gather(place: Place, settings: str, seconds: float) -> Peers:
    lines: dict[int, Line] = {}

    def refuse(sentence: str, *more: Line) -> NoReturn:
        for line in (*lines.values(), *more):
            line.say(refused=sentence)
        raise UserError(sentence)

    end = time.monotonic() + seconds
    with _listening(place) as server:
        while len(lines) < place.count - 1:
            server.settimeout(max(end - time.monotonic(), 0.01))
            try:
                line = Line(server.accept()[0])
            except TimeoutError:
                missing = ", ".join(str(k) for k in range(1, place.count) if k not in lines)
                refuse(
                    f"of {place.count} processes these did not come to {place.host}:{place.port} within "
                    f"{seconds:g} s: {missing}; start them, or give --num-processes as there are"
                )
            hello = line.hear(_HELLO_SECONDS)
            if hello is None or not isinstance(hello.get("process"), int):  # someone else knocked at this port
                line.close()
                continue
            other, problem = hello["process"], _problem(hello, place, settings, lines)
            if problem:
                refuse(problem, line)
            lines[other] = line
    coordinator = f"{place.host}:{_free_port()}"
    for line in lines.values():
        line.say(coordinator=coordinator)
    return Peers(place, lines, coordinator)


def _problem(hello: Mapping[str, Any], place: Place, settings: str, lines: Mapping[int, Line]) -> str | None:
    """Why this process cannot join, in a sentence."""
    other = hello["process"]
    if hello.get("count") != place.count:
        return f"process {other} was told of {hello.get('count')} processes, process 0 of {place.count}"
    if other == 0 or other in lines:
        return f"two processes say that they are process {other}: give each its own --process-id"
    if hello.get("settings") != settings:
        return f"process {other} has other settings, or another version, than process 0: start all with the same"
    return None


def _listening(place: Place) -> socket.socket:
    try:
        if socket.has_dualstack_ipv6():
            return socket.create_server(("", place.port), family=socket.AF_INET6, dualstack_ipv6=True)
        return socket.create_server(("", place.port))
    except OSError as error:
        raise UserError(f"cannot listen on port {place.port} for the other processes: {error.strerror}") from error


def _free_port() -> int:
    with socket.create_server(("", 0)) as server:
        return server.getsockname()[1]


def _go(place: Place, settings: str, seconds: float) -> Peers:
    end = time.monotonic() + seconds
    where = f"{place.host}:{place.port}"
    while True:
        try:
            connection = socket.create_connection((place.host, place.port), timeout=_HELLO_SECONDS)
            break
        except OSError as error:
            if time.monotonic() > end:
                raise UserError(
                    f"process 0 cannot be reached at {where} within {seconds:g} s ({error}): is it running there, "
                    "and its port open?"
                ) from error
            time.sleep(0.2)
    line = Line(connection)
    line.say(process=place.process, count=place.count, settings=settings)
    answer = line.hear(max(end - time.monotonic(), 0.0) + _HELLO_SECONDS)
    if answer is None:
        raise UserError(f"process 0 at {where} ended before all processes had come: see what it says")
    if "coordinator" not in answer:
        raise UserError(str(answer.get("refused", f"{where} is not process 0 of this job")))
    return Peers(place, {0: line}, answer["coordinator"])
