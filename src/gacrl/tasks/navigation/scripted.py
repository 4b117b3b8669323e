"""Policies of the navigation tasks that learn nothing: one that is told its goal, and silent ones.

They take the push after which they would coast nearest to their target: so they rest on a lattice of 0.2, where learned
policies that brake earlier do not.
"""

from collections.abc import Callable

import jax.numpy as jnp
from jaxtyping import Array, Float

from gacrl.envs.particles import DIRECTIONS, coast
from gacrl.tasks.navigation.environment import Navigation, unpack_state
from gacrl.types import Actor, Decision, Memory, Observation, PRNGKey


def told(env: Navigation) -> Actor:
    """Make everyone walk to its own goal: what can be had where all is said."""
    return _walker(env, lambda landmarks, goals: landmarks[goals])


def centroid(env: Navigation) -> Actor:
    """Make everyone walk to the middle of the landmarks: the best that was found in silence."""
    return _walker(env, lambda landmarks, goals: jnp.broadcast_to(landmarks.mean(0), (env.num_agents, 2)))


def guess(env: Navigation) -> Actor:
    """Make everyone walk to the first landmark, and hope."""
    return _walker(env, lambda landmarks, goals: jnp.broadcast_to(landmarks[0], (env.num_agents, 2)))


def _walker(env: Navigation, target_of: Callable[..., Float[Array, "N 2"]]) -> Actor:
    physics, moves = env.default_params().physics, jnp.asarray(env.rules.moves)

    def policy(memory: Memory, observation: Observation, key: PRNGKey) -> tuple[Decision, Memory]:
        if observation.state is None:
            raise ValueError("a scripted policy needs an environment that puts its state into the observation")
        state = unpack_state(observation.state, env.num_agents, env.rules.landmarks)
        positions, velocities, landmarks, goals = state
        coasting, reach = coast(positions, velocities, physics)
        places = coasting[:, None] + reach * jnp.asarray(DIRECTIONS)[None]  # [N 5 2]
        distance = jnp.square(places - target_of(landmarks, goals)[:, None]).sum(-1)
        return Decision(jnp.where(moves, distance.argmin(1), 0)), memory

    return Actor(policy, ())
