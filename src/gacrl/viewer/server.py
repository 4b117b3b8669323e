"""The server of a live page: one page, one socket, nothing of the file system.

Each browser that has the page open is a visitor with an episode of its own. All of them share one thread in which the
policy plays. What a visitor sends is read by `requests`, and never more of it than a budget; what is sent to one who
does not take it ends that visit.
"""

import asyncio
import contextlib
import json
import sys
import time
from collections.abc import AsyncGenerator, Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any

from starlette.applications import Starlette
from starlette.requests import Request as HttpRequest
from starlette.responses import HTMLResponse, PlainTextResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.types import ASGIApp, Receive, Scope, Send
from starlette.websockets import WebSocket, WebSocketDisconnect

from gacrl.errors import UserError
from gacrl.viewer.cast import Cast
from gacrl.viewer.guard import Guard, same_site
from gacrl.viewer.requests import Frames, Refused, Wanted, read
from gacrl.viewer.show import Show

MOST_VISITORS = 8
PATIENCE = 20.0
"""Seconds that a visitor may take to take what is sent."""
_SLICE = 0.1
"""Seconds after which a visitor who jumped far ahead lets the others have their turn."""
_A_SECOND, _AT_ONCE = 100.0, 200.0
"""Messages that a visitor may send, and how many of them in a burst."""
_HEADERS = {
    "Cache-Control": "no-store",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
}


class Board:
    """What all visitors are told besides frames: how learning goes, and which policy plays. The newest of each kind."""

    def __init__(self) -> None:
        self.notes: dict[str, str] = {}
        self.number = 0

    def put(self, kind: str, **content: Any) -> None:
        """Put up a note in place of the last one of its kind; from any thread."""
        self.notes[kind] = json.dumps({"kind": kind, **content}, allow_nan=False)
        self.number += 1


@dataclass
class Budget:
    """Messages that may still be sent."""

    left: float = _AT_ONCE
    since: float = field(default_factory=time.monotonic)

    def takes(self) -> bool:
        """Take one, if there is one left; returns whether."""
        now = time.monotonic()
        self.left = min(self.left + (now - self.since) * _A_SECOND, _AT_ONCE)
        self.since = now
        if self.left < 1:
            return False
        self.left -= 1
        return True


class Visit:
    """One browser's episode, and what it has asked for and not got."""

    def __init__(self, cast: Cast) -> None:
        self.show = Show(cast)
        self._bounds, self._budget = cast.bounds, Budget()
        self._wanted: Wanted | None = None
        self._frames: Frames | None = None
        self._version, self._told = -1, 0.0
        self.refusal: str | None = None
        self.news = asyncio.Event()

    def hear(self, text: str | bytes) -> None:
        """Take note of a message; of one that cannot be followed, why."""
        try:
            if not self._budget.takes():
                raise Refused(f"too many messages: at most {_A_SECOND:g} a second")
            asked = read(text, self._bounds)
        except Refused as refused:
            if time.monotonic() > self._told + 0.1:  # who sends nonsense without end is not answered without end
                self.refusal, self._told = str(refused), time.monotonic()
        else:
            if isinstance(asked, Wanted):
                self._wanted, self._frames = asked, None
            elif self._wanted is not None and asked.version == self._wanted.version:
                self._frames = _joined(self._frames, asked)
        self.news.set()

    @property
    def waits(self) -> bool:
        """Whether there is a frame to play."""
        return self._frames is not None

    def play(self) -> str | None:
        """Play toward the next frame that is asked for, and return it as text; None where it is not there yet."""
        wanted, frames = self._wanted, self._frames
        if wanted is None or frames is None:
            return None
        if wanted.version != self._version:
            self.show.take(wanted.scene)
            self._version = wanted.version
        if not self.show.toward(frames.first, _SLICE):
            return None
        shown = self.show.frame(frames.first)
        if self._frames is frames:
            rest = frames._replace(first=frames.first + 1)
            self._frames = rest if rest.first <= rest.last else None
        return json.dumps(
            {"kind": "frame", "version": wanted.version, **shown}, allow_nan=False, separators=(",", ":")
        )

    def forget(self) -> None:
        """Ask for nothing more."""
        self._frames = None


def _joined(pending: Frames | None, asked: Frames) -> Frames:
    """Return what is to be sent after another request: what was asked for before as well, where the two meet."""
    if pending is None or not pending.first <= asked.first <= pending.last + 1:
        return asked
    return pending._replace(last=max(pending.last, asked.last))


class Server:
    """The application, and who is connected to it."""

    def __init__(self, cast: Cast, guard: Guard, page: Callable[[str], str], board: Board | None = None) -> None:
        """page: the host of the socket -> the page."""
        self.cast, self.board = cast, Board() if board is None else board
        self._page = page
        self._stage, self._answering = ThreadPoolExecutor(1, "stage"), 0
        self.visitors = 0
        routes = [
            Route("/", self._get_page),
            Route("/favicon.ico", lambda request: Response(status_code=204)),
            WebSocketRoute("/live", self._live),
        ]
        self.app: ASGIApp = _Guarded(Starlette(routes=routes), guard)

    def busy(self) -> bool:
        """Return whether somebody waits for a frame."""
        return self._answering > 0

    async def _get_page(self, request: HttpRequest) -> Response:
        return HTMLResponse(self._page(same_site(request.headers)))

    async def _live(self, socket: WebSocket) -> None:
        if self.visitors >= MOST_VISITORS:
            await socket.accept()
            says = f"{MOST_VISITORS} pages are open already: close one, and reload this one"
            await socket.send_text(json.dumps({"kind": "error", "says": says, "over": True}))
            await socket.close(1013)
            return
        self.visitors += 1
        try:
            await socket.accept()
            visit = Visit(self.cast)
            async with _both(self._listen(socket, visit), self._answer(socket, visit)):
                pass
        finally:
            self.visitors -= 1

    async def _listen(self, socket: WebSocket, visit: Visit) -> None:
        while True:
            message = await socket.receive()
            if message["type"] == "websocket.disconnect":
                return
            text = message.get("text")
            visit.hear(text if text is not None else message.get("bytes") or b"")
            await asyncio.sleep(0)  # a flood leaves room for everyone else

    async def _answer(self, socket: WebSocket, visit: Visit) -> None:
        seen = -1
        while True:
            if seen != self.board.number:
                seen = self.board.number
                for note in list(self.board.notes.values()):
                    await self._send(socket, note)
            if visit.refusal is not None:
                says, visit.refusal = visit.refusal, None
                await self._send(socket, json.dumps({"kind": "error", "says": says}))
            if visit.waits:
                text = await self._played(visit)
                if text is not None:
                    await self._send(socket, text)
                continue
            visit.news.clear()
            if not (visit.waits or visit.refusal):
                with contextlib.suppress(TimeoutError):
                    await asyncio.wait_for(visit.news.wait(), 1.0)  # then look at the board

    async def _played(self, visit: Visit) -> str | None:
        """Play a frame in the thread of the stage; what a task's code raises is told to the visitor, and printed."""
        self._answering += 1
        try:
            return await asyncio.get_running_loop().run_in_executor(self._stage, visit.play)
        except UserError as error:
            says = str(error)
        except Exception as error:  # a task's own code may raise anything; the other visitors go on
            says = f"the task or the policy raised {type(error).__name__}: {error}"
        finally:
            self._answering -= 1
        print(f"gacrl: {says}", file=sys.stderr)
        visit.forget()
        return json.dumps({"kind": "error", "says": says})

    async def _send(self, socket: WebSocket, text: str) -> None:
        await asyncio.wait_for(socket.send_text(text), PATIENCE)


@contextlib.asynccontextmanager
async def _both(*work: Any) -> AsyncGenerator[None]:
    """Do several things at once until the first of them ends, in one way or another: a visitor may vanish anywhere."""
    tasks = [asyncio.ensure_future(it) for it in work]
    try:
        yield
        await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for task in tasks:
            task.cancel()
        for task in tasks:
            with contextlib.suppress(asyncio.CancelledError, WebSocketDisconnect, TimeoutError, RuntimeError):
                await task


class _Guarded:
    """Turns requests away before the application sees them, and puts headers on every answer."""

    def __init__(self, app: ASGIApp, guard: Guard) -> None:
        self._app, self._guard = app, guard

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        request = HttpRequest(scope) if scope["type"] == "http" else WebSocket(scope, receive, send)
        found = self._guard.verdict(request.headers, request.query_params.get("token", ""))
        if found is None or (scope["type"] == "http" and scope["path"] == "/favicon.ico" and found.status != 400):
            await self._app(scope, receive, self._dressed(send))
            return
        answer = PlainTextResponse(found.says + "\n", found.status, _HEADERS)
        if isinstance(request, WebSocket):
            await request.send_denial_response(answer)
        else:
            await answer(scope, receive, send)

    def _dressed(self, send: Send) -> Send:
        async def dressed(message: Any) -> None:
            if message["type"] == "http.response.start":
                headers = [(name.lower().encode(), value.encode()) for name, value in _HEADERS.items()]
                message = {**message, "headers": [*message["headers"], *headers]}
            await send(message)

        return dressed
