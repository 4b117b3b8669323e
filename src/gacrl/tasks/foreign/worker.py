"""A process that holds copies of environments: `python -m gacrl.tasks.foreign.worker SOCKET`, started by `crew`.

It answers what it is asked, one thing after the other, and ends when whoever asks is gone.
"""

import contextlib
import pickle
import signal
import sys
from multiprocessing.connection import Connection
from typing import Any

from gacrl.envs.hosted import Copies
from gacrl.errors import Faulty, UserError


def serve(asked: Connection) -> None:
    """Answer (number of the copies, method, arguments) with (whether it was done, its result or its error)."""
    held: dict[int, Copies] = {}
    with contextlib.suppress(EOFError, ConnectionError):
        while True:
            number, method, given = asked.recv()
            try:
                asked.send((True, _done(held, number, method, given)))
            except UserError as error:
                asked.send((False, error))
            except Exception as error:
                said = " ".join(f"{type(error).__name__}: {error}".split())[:300]
                asked.send((False, Faulty(f"a process of environments failed in {method}: {said}")))


def _done(held: dict[int, Copies], number: int, method: str, given: tuple[Any, ...]) -> Any:
    if method == "open":
        recipe, *how = given
        held[number] = pickle.loads(recipe).open(*how)
        return None
    if method == "close":
        return held.pop(number).close()
    return getattr(held[number], method)(*given)


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # whoever started it decides what an interruption ends
    serve(Connection(int(sys.argv[1])))
