"""A live page from its names to its end: the socket, the server, and what goes on beside it."""

import secrets
import socket
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial
from itertools import chain, pairwise, zip_longest

import uvicorn

from gacrl.errors import UserError, reason
from gacrl.viewer.cast import Cast
from gacrl.viewer.guard import Guard
from gacrl.viewer.page import page
from gacrl.viewer.requests import MOST_BYTES
from gacrl.viewer.server import Board, Server

_POLITE = 0.02
"""Seconds after which the compiler asks again whether somebody is being answered."""


def new_token() -> str:
    """Draw the secret of an address."""
    return secrets.token_urlsafe(24)


def listening(host: str, port: int) -> socket.socket:
    """Return a socket that listens. Raises UserError where the port is taken, or the address is not this machine's."""
    if not 0 <= port <= 65_535:
        raise UserError(f"--port must be between 0 and 65535, not {port}")
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        found = socket.socket(family, kind, protocol)
    except (OSError, UnicodeError) as error:
        said = reason(error) if isinstance(error, OSError) else str(error)
        raise UserError(f"--host {host} is no address of this machine ({said}): leave it out") from error
    try:
        found.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        found.bind(address)
        found.listen(64)
    except OSError as error:
        found.close()
        mend = "choose another with --port, or --port 0 for any that is free"
        raise UserError(f"cannot listen on {host}, port {port} ({reason(error)}): {mend}") from error
    return found


def address_of(listener: socket.socket, host: str, token: str) -> str:
    """Return the whole address of the page, which is its key."""
    name = (
        "127.0.0.1"
        if host in ("0.0.0.0", "")
        else "[::1]"
        if host == "::"
        else f"[{host}]"
        if ":" in host
        else host
    )
    return f"http://{name}:{listener.getsockname()[1]}/?token={token}"


@dataclass
class Running:
    """A server that can be run and ended."""

    cast: Cast
    listener: socket.socket
    host: str
    token: str
    board: Board

    def __post_init__(self) -> None:
        guard = Guard(self.token, self.host)
        self.server = Server(self.cast, guard, lru_cache(16)(partial(page, self.cast)), self.board)
        self._uvicorn = uvicorn.Server(
            uvicorn.Config(
                self.server.app,
                ws="websockets-sansio",
                ws_max_size=4 * MOST_BYTES,
                ws_max_queue=16,
                ws_per_message_deflate=False,
                lifespan="off",
                access_log=False,
                log_level="error",
                log_config=None,
                server_header=False,
                timeout_graceful_shutdown=1,
                limit_concurrency=64,
            )
        )

    @property
    def address(self) -> str:
        """The whole address of the page."""
        return address_of(self.listener, self.host, self.token)

    def run(self) -> None:
        """Serve until Ctrl-C or `stop`."""
        self._uvicorn.run(sockets=[self.listener])

    def stop(self) -> None:
        """End it, from any thread."""
        self._uvicorn.should_exit = True


def warm_up(cast: Cast) -> None:
    """Compile what the first picture needs."""
    for player in cast.players:
        deque(player.room(player.home).warm(player.learner, player.params(player.home, player.home)), maxlen=0)


def warm_up_the_rest(cast: Cast, busy: Callable[[], bool]) -> None:
    """Compile the rooms for other numbers of agents: first of each what answers a visitor who asks for it.

    busy: whether somebody is being answered, who goes first. (A thread of low priority would hold the interpreter's
    lock for as long as the machine has other things to do, and everyone would wait for it.)
    """
    least, most = cast.bounds.least, cast.bounds.most
    under_way = [
        player.room(size).warm(player.learner, player.params(size, size))
        for player in (cast.players if least < most else ())
        for smaller, size in pairwise(player.sizes)
        if smaller < most
    ]
    for _ in chain.from_iterable(zip_longest(*under_way)):  # the first program of each, then the second
        while busy():
            time.sleep(_POLITE)


def beside(*work: Callable[[], None]) -> threading.Thread:
    """Do some things, one after the other, in a thread that ends with the process."""

    def one_by_one() -> None:
        for each in work:
            each()

    thread = threading.Thread(target=one_by_one, daemon=True)
    thread.start()
    return thread
