"""The page of a training: a process of its own, so that nothing a browser does can stop or slow what learns.

`gacrl train --view` holds the socket, and starts this module with it once the run folder is there. The child follows
the folder as `gacrl view` does, on the CPU and at the lowest priority; it ends when its standard input does, with the
training or when that is killed.
"""

import contextlib
import json
import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Generator, Mapping, Sequence
from pathlib import Path
from typing import Any

from gacrl.config.run import RunConfig
from gacrl.training.build import Plan
from gacrl.training.recorder import RunFolder
from gacrl.training.watching import Watcher
from gacrl.viewer.running import Running, address_of, listening, new_token

_LOWEST = 19
_ENDS_WITHIN = 3.0
"""Seconds that the child has for its end."""


@contextlib.contextmanager
def page_beside(
    host: str, port: int, named: Mapping[str, Sequence[str]], say: Callable[[str], None]
) -> Generator[Watcher]:
    """Serve a page beside the training that is told to the watcher.

    named: what came from outside, {--env: [...], --use: [...]}, which the child needs again. say: prints a line. Raises
    UserError where the port is taken.
    """
    token = new_token()
    with listening(host, port) as listener, contextlib.ExitStack() as ending:
        address = address_of(listener, host, token)

        def planned(folder: RunFolder, config: RunConfig, plan: Plan) -> None:
            asked = {"folder": str(folder.path), "host": host, "token": token, "named": dict(named)}
            child = _start({**asked, "socket": listener.fileno()}, listener)
            ending.callback(_end, child)
            say(f"page       {address} after the first evaluation")
            threading.Thread(target=_relay, args=(child, say), daemon=True).start()

        yield Watcher(planned=planned)


def _start(asked: Mapping[str, Any], listener: socket.socket) -> "subprocess.Popen[str]":
    child = subprocess.Popen(
        [sys.executable, "-m", __name__],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        pass_fds=(listener.fileno(),),
        process_group=0,  # Ctrl-C is for the training; a session of its own would have its share whatever its priority
        env={**os.environ, "JAX_PLATFORMS": "cpu"},
    )
    assert child.stdin is not None
    with contextlib.suppress(OSError):  # it has died: that ends its output
        child.stdin.write(json.dumps(asked) + "\n")
        child.stdin.flush()
    return child


def _relay(child: "subprocess.Popen[str]", say: Callable[[str], None]) -> None:
    """Pass on what the child says, until its end."""
    assert child.stdout is not None
    with child.stdout as lines:
        for line in lines:
            say(line.rstrip("\n"))


def _end(child: "subprocess.Popen[str]") -> None:
    """Let the child end, and end it where it does not."""
    with contextlib.suppress(OSError):
        assert child.stdin is not None
        child.stdin.close()
    try:
        child.wait(_ENDS_WITHIN)
    except subprocess.TimeoutExpired:
        child.kill()
        child.wait()


def main() -> None:
    """Be the child: follow a run folder until standard input ends."""
    asked = json.loads(sys.stdin.readline())
    threading.Thread(target=_end_with_input, daemon=True).start()
    with contextlib.suppress(AttributeError, OSError):
        os.nice(_LOWEST)
    try:
        _serve(asked)
    except Exception as error:  # whatever it is, the training goes on
        print(f"page       has ended, and training goes on: {error}", flush=True)


def _end_with_input() -> None:
    sys.stdin.read()
    os._exit(0)


def _serve(asked: Mapping[str, Any]) -> None:
    from gacrl.training.devices import prepare_jax

    prepare_jax()
    from gacrl.tasks import own
    from gacrl.viewer import following, lore, running
    from gacrl.viewer.cast import open_cast
    from gacrl.viewer.server import Board

    for file in asked["named"].get("--use", ()):
        own.run_file(Path(file))
    for name in asked["named"].get("--env", ()):
        own.bring(name)
    folder = RunFolder(Path(asked["folder"]))
    while not any(folder.checkpoints.glob("step-*")):
        time.sleep(following.EVERY)
    cast, board = open_cast([asked["folder"]]), Board()
    running.warm_up(cast)
    listener = socket.socket(fileno=asked["socket"])
    server = Running(cast, listener, asked["host"], asked["token"], board)
    running.beside(lambda: following.follow(cast, board))
    running.beside(lambda: lore.keep_telling(cast, board))
    print("page       is open", flush=True)
    server.run()


if __name__ == "__main__":
    main()
