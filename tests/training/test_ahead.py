"""Programs that are compiled ahead: each once, and nobody waits for those that nobody needs."""

import logging
import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from threading import Event

import jax
import jax.numpy as jnp
import pytest

import gacrl
from gacrl.config import files as configuration
from gacrl.evaluation import references
from gacrl.training import session
from gacrl.training.ahead import Ahead


class Compiled(logging.Handler):
    """Counts what is compiled, in all threads."""

    def __init__(self) -> None:
        super().__init__()
        self.count: Counter[str] = Counter()

    def emit(self, record: logging.LogRecord) -> None:
        self.count.update(re.findall(r"^Compiling jit\((\w+)\)", record.getMessage()))


@pytest.fixture
def compiled() -> Iterator[Counter[str]]:
    log, handler = logging.getLogger("jax"), Compiled()
    log.addHandler(handler)
    log.propagate = False
    jax.config.update("jax_log_compiles", True)
    yield handler.count
    jax.config.update("jax_log_compiles", False)
    log.propagate = True
    log.removeHandler(handler)


@pytest.mark.parametrize(
    "seeds", [pytest.param(1, marks=pytest.mark.soak), pytest.param(2, marks=pytest.mark.slow)]
)
def test_a_run_compiles_each_of_its_programs_once(seeds: int, tmp_path: Path, compiled: Counter[str]):
    """What is compiled ahead is what is called later: another layout, and XLA would compile it again, unseen."""
    small = {
        "algorithm": {"network": {"width": 8}},
        "training": {"env_steps": 40, "num_envs": 2, "num_steps": 5},
        "evaluation": {"interval": 20, "num_episodes": 2, "final_episodes": 3},
    }
    config = replace(configuration.from_dict(small, gacrl.preset("ippo")), num_seeds=seeds)
    references.scripted_program.cache_clear()  # whatever other tests have played
    session.start(config, tmp_path / "run")
    assert compiled["on_all_devices"] == compiled["record"] == 1, compiled
    assert compiled["evaluate"] == 4, compiled  # greedy and sampled, along the way and at the end
    assert compiled["play"] == 3, compiled  # random, noop and oracle


def test_what_lowering_raises_is_raised_to_whoever_waits():
    def fails():
        raise KeyError("a task's own fault")

    with Ahead() as ahead, pytest.raises(KeyError, match="own fault"):
        ahead.compile(fails).result()


def test_leaving_drops_what_has_not_begun():
    """An interrupted run does not compile what closes it."""
    begun, leave, lowered = Event(), Event(), []

    def busy() -> None:
        begun.set()
        leave.wait(10)

    def lower() -> object:
        lowered.append(1)
        return jax.jit(jnp.sin).lower(1.0)

    with Ahead(threads=1) as ahead:
        ahead.run(busy)
        begun.wait(10)
        waiting = ahead.compile(lower)
        ahead.leave()
        leave.set()
    assert not lowered and (waiting.cancelled() or waiting.result() is None)
