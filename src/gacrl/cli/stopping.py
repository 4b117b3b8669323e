"""Ctrl-C and SIGTERM: the first asks for a stop at the next checkpoint, and nothing is lost."""

import contextlib
import signal
from collections.abc import Generator
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from gacrl.cli.terminal import LiveWatcher


@contextlib.contextmanager
def stopping(terminal: "LiveWatcher") -> Generator[None]:
    """Let the first SIGINT or SIGTERM ask for a stop at the next checkpoint; the next one is not ours."""

    def handler(number: int, frame: Any) -> None:
        signal.signal(number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL)
        terminal.request_stop(128 + number)

    before = {number: signal.signal(number, handler) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, old in before.items():
            signal.signal(number, old)
