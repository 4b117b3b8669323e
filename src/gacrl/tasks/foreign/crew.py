"""Copies of an environment in other processes, which step them side by side.

Each process is a Python of its own (`worker`), with JAX's threads in none of them: nothing is forked. A copy has the
same seeds wherever it is, so that the results are those of one process.
"""

import contextlib
import os
import signal
import socket
import subprocess
import sys
import weakref
from collections.abc import Sequence
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Bool, UInt8

from gacrl import tasks
from gacrl.envs.environment import TimeStep
from gacrl.envs.hosted import Actions, Copies
from gacrl.errors import ConfigError, Faulty
from gacrl.tasks.foreign.worlds import Recipe
from gacrl.types import Observation

_PATIENCE = 5.0
"""Seconds that a process has to end by itself."""


class Crew:
    """So many processes; they start when something is opened, and end with `close`, or with this process."""

    def __init__(self, size: int):
        self.size = size
        self._hands: list[_Hand] = []
        self._opened = 0
        weakref.finalize(self, _dismiss, self._hands)

    def open(self, recipe: Recipe, copies: int, seen: bool = False) -> Copies:
        """Make so many copies, an equal share in each process. Raises ConfigError for what cannot be sent there."""
        data = _pickled(recipe)
        if not self._hands:
            self._hands.extend(_Hand() for _ in range(self.size))
        self._opened += 1
        shares = np.array_split(np.arange(copies), min(self.size, copies))
        return _Shared(recipe, self._opened, list(zip(self._hands, shares, strict=False)), (data, seen))

    def close(self) -> None:
        """End the processes."""
        _dismiss(self._hands)


def _pickled(recipe: Recipe) -> bytes:
    """The recipe with the functions in it, also those of a task's own file, which no other process can import."""
    import cloudpickle

    for name, module in list(sys.modules.items()):
        if name.startswith(tasks.OWN_FILE):
            cloudpickle.register_pickle_by_value(module)
    try:
        return cloudpickle.dumps(recipe)
    except Exception as error:
        why = " ".join(str(error).split())[:200]
        raise ConfigError(
            f"{recipe.task} cannot be sent to other processes ({type(error).__name__}: {why}): leave "
            "training.env_processes at 1, or make the environment by a function that keeps nothing open"
        ) from error


class _Hand:
    """One of the processes, and the line to it."""

    def __init__(self) -> None:
        ours, theirs = socket.socketpair()
        surroundings = {
            "OMP_NUM_THREADS": "1",
            **os.environ,
            "JAX_PLATFORMS": "cpu",
            "PYTHONPATH": os.pathsep.join(path or str(Path.cwd()) for path in sys.path),
        }
        with theirs:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "gacrl.tasks.foreign.worker", str(theirs.fileno())],
                pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL,
                stdout=2,  # what environments print is not what a command prints
                env=surroundings,
            )
        self.line = Connection(ours.detach())

    def ended(self) -> str:
        """Return how it ended."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(_PATIENCE)
        code = self.process.returncode
        if code is None:
            return "answers no more"
        return f"was killed by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"


def _dismiss(hands: list[_Hand]) -> None:
    """Close the lines, at which the processes end, and wait for them."""
    for hand in hands:
        hand.line.close()
    for hand in hands:
        with contextlib.suppress(subprocess.TimeoutExpired):
            hand.process.wait(_PATIENCE)
        hand.process.kill()
        hand.process.wait()
    hands.clear()


class _Shared(Copies):
    """Copies of which each process has some that follow each other."""

    def __init__(
        self, recipe: Recipe, number: int, shares: list[tuple[_Hand, np.ndarray]], how: tuple[bytes, bool]
    ):
        self._recipe, self._number, self._shares = recipe, number, shares
        self._clock = np.zeros(sum(len(mine) for _, mine in shares), int)
        data, seen = how
        self._ask("open", [(data, len(mine), seen) for _, mine in shares])
        self._seen: list[Any] = [None] * len(shares)
        self._after: list[Any] = [None] * len(shares)

    def begin(self, which: Sequence[int], seeds: Sequence[int] | None = None) -> Observation:
        """Begin episodes."""
        self._clock[list(which)] = 0
        places = dict(zip(which, range(len(which)) if seeds is None else seeds, strict=True))
        mine = [{int(k): places[k] for k in share.tolist() if k in places} for _, share in self._shares]
        asked = [
            ([k - int(share[0]) for k in begun], None if seeds is None else list(begun.values()))
            if begun
            else None
            for begun, (_, share) in zip(mine, self._shares, strict=True)
        ]
        self._seen = self._ask("begin", asked, self._seen)
        return _side_by_side(self._seen)

    def step(self, actions: Actions, going: Bool[np.ndarray, " C"] | None = None) -> TimeStep:
        """Step those that are going."""
        going = np.ones(len(self._clock), bool) if going is None else going
        self._clock += going
        asked = [(actions[share], going[share]) if going[share].any() else None for _, share in self._shares]
        self._after = self._ask("step", asked, self._after)
        self._seen = [after.observation for after in self._after]
        return _side_by_side(self._after)

    def pictures(self, width: int) -> list[UInt8[np.ndarray, "height width 3"]] | None:
        """Draw every environment; None where one draws nothing."""
        drawn = self._ask("pictures", [(width,)] * len(self._shares))
        return None if None in drawn else [picture for share in drawn for picture in share]

    def close(self) -> None:
        """Close the environments."""
        self._ask("close", [()] * len(self._shares))

    def _ask(self, method: str, given: list[tuple[Any, ...] | None], before: list[Any] | None = None) -> list[Any]:
        """Ask every process at once, and wait for all: who is given None keeps what was `before`. Raises Faulty."""
        answers, faults = list[Any](before or [None] * len(given)), list[Exception]()
        for k, (hand, _) in enumerate(self._shares):
            if given[k] is not None:
                with contextlib.suppress(ConnectionError):  # it is heard below that the process has ended
                    hand.line.send((self._number, method, given[k]))
        for k, (hand, _) in enumerate(self._shares):
            if given[k] is None:
                continue
            try:
                done, answers[k] = hand.line.recv()
            except (EOFError, ConnectionError):
                done, answers[k] = False, self._lost(k)
            if not done:
                faults.append(answers[k])
        if faults:
            raise faults[0]
        return answers

    def _lost(self, k: int) -> Faulty:
        """The sentence for a process that has ended."""
        hand, share = self._shares[k]
        agents = ", ".join(self._recipe.layout.agents)
        return Faulty(
            f"{agents} of {self._recipe.task}, copies {share[0]} to {share[-1]}, are lost in step "
            f"{self._clock[share].max()} of an episode: their process {hand.ended()}; see what it printed, mend the "
            "environment or let it have more memory"
        )


def _side_by_side(parts: list[Any]) -> Any:
    return jax.tree.map(lambda *rows: np.concatenate(rows), *parts)
