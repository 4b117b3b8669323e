"""A heavy PettingZoo environment over several processes, beside one: what a chunk of training takes.

    python benchmarks/host_processes.py [--json] [--waiting] [MILLISECONDS] [PROCESSES]

The environment is MPE2's `simple_spread_v3`, with so many milliseconds of Python's arithmetic in each step (2 by
default). With --waiting it waits so long, as for a simulator elsewhere, which shows the overlap on busy cores too. One
and several processes (2 by default) take turns, in pairs; the preset is `ippo` with 16 environments. Prints
environment steps a second of wall time: on busy cores the ratio is less than on idle ones.
"""

import json
import statistics
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack, closing
from dataclasses import replace
from functools import partial
from typing import Any

import jax
from mpe2 import simple_spread_v3

import gacrl
from gacrl.tasks import own
from gacrl.training import build
from gacrl.training.devices import prepare_jax

PAIRS = 7


class Heavy:
    """Works before every step."""

    def __init__(self, env: Any, work: Callable[[], Any]):
        self._env, self._work = env, work

    def __getattr__(self, name: str) -> Any:
        return getattr(self._env, name)

    def step(self, actions: Any) -> Any:
        """Work, then step."""
        self._work()
        return self._env.step(actions)


def count(rounds: int) -> int:
    """Do so many rounds of arithmetic."""
    total = 0
    for number in range(rounds):
        total += number * number % 7
    return total


def rounds_of(milliseconds: float) -> int:
    """Return how many rounds take so long."""
    begun = time.process_time()
    count(1_000_000)
    return round(1_000_000 * milliseconds / 1e3 / (time.process_time() - begun))


def paces(work: Callable[[], Any], processes: int) -> dict[int, list[float]]:
    """Return steps a second of each pair's two turns, by the number of processes."""
    task = gacrl.from_pettingzoo(lambda: Heavy(simple_spread_v3.parallel_env(), work), "heavy", max_cycles=25)
    name, settings = own.bring(task)
    config = replace(gacrl.preset("ippo"), task=name, env=settings)
    found: dict[int, list[float]] = {1: [], processes: []}
    with ExitStack() as opened:
        trainers, states = {}, {}
        for over in found:
            training = replace(config.training, num_envs=16, num_steps=25, env_processes=over)
            trainers[over] = opened.enter_context(closing(build.make_trainer(replace(config, training=training))))
            states[over] = trainers[over].init((0,))
            trainers[over].compiled(states[over], 1)
        for _ in range(PAIRS):
            for over, trainer in trainers.items():
                begun = time.perf_counter()
                states[over], _ = trainer.chunk(states[over], 1)
                jax.block_until_ready(states[over])
                found[over].append(16 * 25 / (time.perf_counter() - begun))
    return found


if __name__ == "__main__":
    prepare_jax()
    numbers = [word for word in sys.argv[1:] if not word.startswith("--")]
    milliseconds, processes = float(numbers[0]) if numbers else 2.0, int(numbers[1]) if numbers[1:] else 2
    waiting = "--waiting" in sys.argv
    work = partial(time.sleep, milliseconds / 1e3) if waiting else partial(count, rounds_of(milliseconds))
    found = paces(work, processes)
    ratios = [many / one for one, many in zip(found[1], found[processes], strict=True)]
    for over, turns in found.items():
        print(f"{over} processes: {', '.join(f'{pace:,.0f}' for pace in turns)} steps/s")
    print(
        f"ratio: median {statistics.median(ratios):.2f} of {', '.join(f'{ratio:.2f}' for ratio in sorted(ratios))}"
    )
    if "--json" in sys.argv:
        print(json.dumps({"ratio": {"one process": {f"{milliseconds:g} ms": statistics.median(ratios)}}}))
