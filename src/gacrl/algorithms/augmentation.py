"""More experience from the same steps: the task turned by one of its symmetries is the same task."""

import jax
from jaxtyping import Array, Int

from gacrl.algorithms import actions
from gacrl.envs.environment import Environment, SpatialEnvironment
from gacrl.types import PRNGKey, Transition


def turn_experience(env: Environment, steps: Transition, key: PRNGKey) -> Transition:
    """Each environment's steps [T, E, …] in a world turned by a random symmetry; rewards stay as they are.

    The decisions' actions are indices of `actions.choices`. A task without symmetries gives its steps back.
    """
    if not isinstance(env, SpatialEnvironment):
        return steps
    choices = actions.choices(env)
    symmetries = jax.random.randint(key, (steps.first.shape[1],), 0, env.num_symmetries)

    def turn(steps: Transition, symmetry: Int[Array, ""]) -> Transition:
        decision = steps.decision._replace(action=choices.turn(steps.decision.action, symmetry))
        return steps._replace(
            observation=env.turn(steps.observation, symmetry),
            next_observation=env.turn(steps.next_observation, symmetry),
            decision=decision,
        )

    return jax.vmap(turn, (1, 0), 1)(steps, symmetries)
