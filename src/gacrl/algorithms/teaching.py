"""A teacher of the agents: the same network, told what the others see, whose values are learned from rewards.

Those who act learn from it what each action loses. A word is worth something to them from the start, since somebody
already knows what to do with it. The teacher is for training only.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from gacrl.algorithms.objectives import HUBER_DELTA, huber
from gacrl.types import Arrives, Observation, Transition


def told(observation: Observation) -> Observation:
    """Return what a teacher is shown: it is told all, whatever happens to words; cut edges stay cut."""
    return observation._replace(arrives=Arrives(kept=observation.arrives.kept))


def as_told(steps: Transition) -> Transition:
    """Return the steps as a teacher is shown them."""
    return steps._replace(observation=told(steps.observation), next_observation=told(steps.next_observation))


def lesson(
    pupils: Float[Array, "N A"],
    teacher: Float[Array, "N A"],
    available: Bool[Array, "N A"],
    real: Bool[Array, " N"],
) -> Float[Array, ""]:
    """Measure how far the agents' values are from what each action loses by their teacher; summed over both.

    available: the actions of each agent. real: who is there.
    """
    best = jnp.where(available, teacher, -jnp.inf).max(-1, keepdims=True)
    error = huber(pupils - jax.lax.stop_gradient(teacher - best), HUBER_DELTA)
    return jnp.where(available & real[:, None], error, 0.0).sum()
