"""Agents acting in environments that live in Python: a compiled program decides, the host steps.

The step is `rollout.act`, cut in two where the environment moves. Memory is renewed at the start of the next decision,
in the same program: a call of a program costs more than what it computes here.
"""

from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import jax
import numpy as np
from jaxtyping import Array, Bool, Int

from gacrl import rollout
from gacrl.envs.environment import TimeStep
from gacrl.envs.hosted import Hosted
from gacrl.rollout import Carry
from gacrl.types import Decision, Intervention, Memory, Policy, PRNGKey

Left: TypeAlias = Any
"""Whose life ended with the step before, inside an episode: [E, N]."""
Decide: TypeAlias = Callable[[Carry, Left, PRNGKey, Any], tuple[Carry, Decision]]
"""(carry, left, key of all steps, step) -> where agents stand after deciding, and what they do."""


def decider(
    policy: Policy, initial_memory: Memory, num_steps: int, intervention: Intervention | None = None
) -> Decide:
    """Return the device's half of a step of E environments, one of so many steps; jit it.

    It draws what a compiled rollout of so many steps draws.
    """

    def decide(carry: Carry, left: Left, key: PRNGKey, step: Int[Array, ""]) -> tuple[Carry, Decision]:
        key = key if num_steps == 1 else jax.random.split(key, num_steps)[step]
        keys = jax.random.split(key, (carry.first.shape[0], 3))
        return rollout.decide(policy, rollout.forgetting(initial_memory, carry, left), keys, intervention)

    return decide


def seeds_from(key: PRNGKey, count: int) -> list[int]:
    """Draw so many seeds of episodes; of more, the first are the same."""
    draws = np.random.default_rng(np.asarray(jax.random.key_data(key)).tolist())
    return draws.integers(2**31, size=count).tolist()


class Stage:
    """E copies of an environment with agents in them, and what is seen there now."""

    def __init__(self, env: Hosted, copies: int, seen: bool = False):
        """seen: pictures of the copies will be asked for."""
        self._count, self.copies = copies, env.open(copies, seen)
        self._nobody = np.zeros((copies, env.num_agents), bool)

    def begin(self, seeds: Sequence[int]) -> None:
        """Begin an episode in every copy, each with its seed."""
        self.seen, self.left = self.copies.begin(range(self._count), seeds), self._nobody
        self.first = np.ones(self._count, bool)

    def carry(self, carry: Carry) -> Carry:
        """Put what is seen now in its place."""
        return carry._replace(observation=self.seen, first=self.first)

    def step(
        self, decision: Decision, again: bool = True, going: Bool[np.ndarray, " E"] | None = None
    ) -> TimeStep:
        """Let every copy take the step that was decided; returns what it brought.

        again: begin a new episode where one has ended. going: the copies that are still of interest.
        """
        after = self.copies.step(np.asarray(decision.action), going)
        over = np.asarray(after.terminated | after.truncated)
        self.seen, self.left, self.first = after.observation, after.left, over
        if again and over.any():
            self.seen = self.copies.begin(np.flatnonzero(over).tolist())
        return after
