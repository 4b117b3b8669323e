"""What the symmetries of a task are good for: a turned world is the same task.

More experience from the same steps, and a policy that is symmetric by construction.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from gacrl.algorithms import actions
from gacrl.algorithms.actions import ActionSet
from gacrl.config.algorithms import LearningConfig
from gacrl.config.checks import require
from gacrl.envs.environment import Environment
from gacrl.networks.agent import AgentNetwork, AgentOutput
from gacrl.types import Memory, Observation, PRNGKey, Transition


def turn_experience(env: Environment, choices: ActionSet, steps: Transition, key: PRNGKey) -> Transition:
    """Return each environment's steps [T, E, …] in a world turned by a random symmetry; rewards stay as they are.

    The decisions' actions are what was drawn of the choices. A task without symmetries gives its steps back.
    """
    if env.num_symmetries == 1:
        return steps
    symmetries = jax.random.randint(key, (steps.first.shape[1],), 0, env.num_symmetries)

    def turn(steps: Transition, symmetry: Int[Array, ""]) -> Transition:
        decision = steps.decision._replace(action=choices.turn(steps.decision.action, symmetry))
        return steps._replace(
            observation=env.turn(steps.observation, symmetry),
            next_observation=env.turn(steps.next_observation, symmetry),
            decision=decision,
        )

    return jax.vmap(turn, (1, 0), 1)(steps, symmetries)


def play(
    env: Environment,
    symmetric: bool,
    network: AgentNetwork,
    observation: Observation,
    memory: Memory,
    temperature: Float[Array, ""] | float = 1.0,
) -> tuple[AgentOutput, Memory]:
    """Return what the network puts out when nothing is drawn.

    `symmetric` (and without a memory): its head [N, A] is the mean over the turned worlds, turned back, so that
    when the world turns the actions do. Every turned world has a conversation of its own: all that is computed and
    sent grows by the number of symmetries. The message shown is the one of the world as it is.
    """
    if not symmetric or env.num_symmetries == 1:
        return network(observation, memory, None, temperature)
    choices = actions.choices(env)

    def turned(symmetry: Int[Array, ""]) -> AgentOutput:
        output, _ = network(env.turn(observation, symmetry), (), None, temperature)
        return output._replace(head=output.head[:, choices.turn(jnp.arange(choices.size), symmetry)])

    outputs = jax.vmap(turned)(jnp.arange(env.num_symmetries))
    return jax.tree.map(lambda leaf: leaf[0], outputs)._replace(head=outputs.head.mean(0)), memory


def require_no_memory_in_symmetric_play(config: LearningConfig, env: Environment, memory: Memory) -> None:
    """Raise ConfigError where a network that remembers is to play by the mean over turned worlds."""
    require(
        not (config.symmetric_play and env.num_symmetries > 1 and jax.tree.leaves(memory)),
        "algorithm.symmetric_play needs a network without memory: leave it off with a recurrent network, or with "
        f"messages that are heard a step later ({config.network.communication})",
    )
