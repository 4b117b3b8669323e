"""A server in a thread, and clients of it; without starlette, uvicorn and websockets these tests say that they skip."""

import contextlib
import http.client
import json
import os
import threading
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest

pytest.importorskip("starlette", reason="the live page is tested with the extra view (pip install 'gacrl[view]')")
pytest.importorskip("uvicorn", reason="the live page is tested with the extra view (pip install 'gacrl[view]')")
pytest.importorskip("websockets", reason="the live page is tested with the extra view (pip install 'gacrl[view]')")

from websockets.sync.client import ClientConnection, connect

from gacrl.viewer import running
from gacrl.viewer.cast import Cast, open_cast
from gacrl.viewer.server import Board

TOKEN = "secret-of-this-test"


class Site:
    """A running server, and ways to talk to it."""

    def __init__(self, cast: Cast) -> None:
        self.board = Board()
        self.running = running.Running(cast, running.listening("127.0.0.1", 0), "127.0.0.1", TOKEN, self.board)
        self.url = self.running.address
        self.host = urlsplit(self.url).netloc
        self._thread = threading.Thread(target=self.running.run, daemon=True)
        self._thread.start()

    def get(self, path: str = f"/?token={TOKEN}", **headers: str) -> tuple[int, dict[str, str], str]:
        """Status, headers and body of an answer."""
        asking = http.client.HTTPConnection(self.host, timeout=20)
        asking.putrequest("GET", path, skip_host="Host" in headers)
        for name, value in headers.items():
            asking.putheader(name, value)
        asking.endheaders()
        answer = asking.getresponse()
        found = answer.status, {name.lower(): value for name, value in answer.getheaders()}, answer.read().decode()
        asking.close()
        return found

    @contextlib.contextmanager
    def visit(self, path: str = f"/live?token={TOKEN}", **headers: str) -> Iterator["Visitor"]:
        """A page that is open."""
        address = f"ws://{self.host}{path}"
        with connect(address, additional_headers=headers, open_timeout=20, max_size=2**22) as line:
            yield Visitor(line)

    def close(self) -> None:
        self.running.stop()
        self._thread.join(20)
        assert not self._thread.is_alive()
        self.running.listener.close()


class Visitor:
    """What a page does with its socket."""

    def __init__(self, line: ClientConnection) -> None:
        self.line, self.version = line, 0

    def send(self, message: Any) -> None:
        self.line.send(message if isinstance(message, str | bytes) else json.dumps(message))

    def hear(self) -> dict[str, Any]:
        return json.loads(self.line.recv(timeout=60))

    def scene(self, seed: int, count: int, *events: dict[str, Any]) -> None:
        self.version += 1
        self.send({"kind": "scene", "version": self.version, "seed": seed, "count": count, "events": list(events)})

    def frames(self, first: int, last: int) -> list[dict[str, Any]]:
        self.send({"kind": "frames", "version": self.version, "first": first, "last": last})
        found: list[dict[str, Any]] = []
        while len(found) < last - first + 1:
            message = self.hear()
            assert message["kind"] == "frame", message
            found += [message] if message["version"] == self.version else []
        assert [frame["t"] for frame in found] == list(range(first, last + 1))
        return found


@contextlib.contextmanager
def serving(cast: Cast) -> Iterator[Site]:
    site = Site(cast)
    try:
        yield site
    finally:
        site.close()


@cache
def cast_of(*names: str) -> Cast:
    """Policies by name, opened once."""
    return open_cast(names)


def memory() -> int:
    """Bytes that this process holds."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGESIZE")
