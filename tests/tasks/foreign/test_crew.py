"""Copies in other processes: the numbers of one process, its sentences, and nobody left behind."""

import os
import signal
import threading
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import numpy as np
import pytest
from mpe2 import simple_speaker_listener_v4

import gacrl
from gacrl.config.files import fingerprint
from gacrl.envs.hosted import Copies
from gacrl.errors import Faulty
from gacrl.tasks.foreign.crew import Crew


class Odd:
    """Raises where a speaker says 2, and kills its process where the listener goes up."""

    def __init__(self, lock: Any = None):
        self._env, self._lock = simple_speaker_listener_v4.parallel_env(max_cycles=4), lock

    def __getattr__(self, name: str) -> Any:
        return getattr(self._env, name)

    def step(self, actions: dict[str, int]) -> Any:
        if actions["speaker_0"] == 2:
            raise ValueError("too loud")
        if actions["listener_0"] == 4:
            os.kill(os.getpid(), signal.SIGKILL)
        return self._env.step(actions)


def zoo(make: Callable[..., Any] = lambda: Odd()) -> Any:
    task = gacrl.from_pettingzoo(make, "odd", max_cycles=4)
    return task.make(task.settings())


def played(copies: Copies) -> list[np.ndarray]:
    """Episodes of three copies, of which the last one is left behind for a step."""
    actions = np.array([[0, 1], [1, 2], [0, 3]])
    found: list[Any] = [copies.begin([0, 1, 2], [5, 6, 7])]
    found += [copies.step(actions) for _ in range(3)]
    found += [copies.step(actions[::-1], np.array([True, True, False])), copies.begin([1, 0])]
    found += [copies.step(actions), copies.begin([2, 0], [8, 9])]
    return [np.asarray(leaf) for leaf in jax.tree.leaves(found)]


def test_copies_in_two_processes_are_those_of_one():
    """Then one raises, and then one dies: the sentence of the one, agents and step of the other."""
    crew, env = Crew(2), zoo()
    with pytest.raises(gacrl.ConfigError, match="odd cannot be sent to other processes"):
        lock = threading.Lock()
        zoo(lambda: Odd(lock)).over(crew).open(2)
    copies, here = env.over(crew).open(3), env.open(3)
    for found, expected in zip(played(copies), played(here), strict=True):
        np.testing.assert_array_equal(found, expected)
    for of in (copies, here):
        of.begin([0, 1, 2], [0, 1, 2])
        with pytest.raises(Faulty, match="odd raised ValueError in step, after 0 steps of an episode: too loud"):
            of.step(np.array([[0, 0], [0, 0], [2, 0]]))
    copies.begin([0, 1, 2], [0, 1, 2])
    copies.step(np.zeros((3, 2), int))
    lost = r"speaker_0, listener_0 of odd, copies 0 to 1, are lost in step 2 .* was killed by SIGKILL; see"
    with pytest.raises(Faulty, match=lost):
        copies.step(np.array([[0, 4], [0, 0], [0, 0]]))
    processes = [hand.process for hand in crew._hands]
    assert [process.poll() for process in processes] == [-signal.SIGKILL, None]
    crew.close()
    assert [process.poll() for process in processes] == [-signal.SIGKILL, 0]


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (
            ("--env", "pettingzoo:mpe2.simple_spread_v3", "--training.num-envs=1"),
            "env-processes is 2, and there is no more than",
        ),
        (("--preset=ippo",), "is for environments that live in Python, and spread is compiled: leave it at 1"),
    ],
)
def test_where_there_is_nothing_to_spread(words: tuple[str, ...], sentence: str, said: Callable[..., Any]):
    code, told = said("train", *words, "--training.env-processes=2", "--env-steps=10")
    assert code == 2 and sentence in told


def test_a_run_goes_on_over_another_number_of_processes():
    one = gacrl.preset("ippo")
    two = replace(one, training=replace(one.training, env_processes=2))
    assert fingerprint(one) == fingerprint(two)
