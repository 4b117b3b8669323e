"""QMIX (Rashid et al. 2018), VDN (Sunehag et al. 2018), IQL (Tan 1993): from the agents' values to the team's.

The learner is in `q_learning`; here are the three mixers and ε-greedy exploration that falls linearly.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from gacrl.algorithms import exploration, q_learning
from gacrl.algorithms.actions import choices
from gacrl.algorithms.contract import Algorithm
from gacrl.algorithms.q_learning import Network, Parts
from gacrl.algorithms.shared import taken
from gacrl.config.algorithms import QmixConfig
from gacrl.config.run import TrainingConfig
from gacrl.envs.environment import Environment
from gacrl.networks.agent import AgentNetwork, AgentOutput, matched
from gacrl.networks.critic import global_state
from gacrl.networks.mixer import MonotonicMixer
from gacrl.types import Observation, PRNGKey


def independent(
    network: Network, output: AgentOutput, action: Int[Array, " N"], observation: Observation
) -> Float[Array, " N"]:
    """IQL: each agent's value is learned from the reward by itself."""
    return taken(output.head, action)


def summed(
    network: Network, output: AgentOutput, action: Int[Array, " N"], observation: Observation
) -> Float[Array, "1"]:
    """VDN: Q_tot = Σ_i Q_i over the real agents."""
    return jnp.where(observation.agent_mask, taken(output.head, action), 0.0).sum(keepdims=True)


def monotonic(
    network: Network, output: AgentOutput, action: Int[Array, " N"], observation: Observation
) -> Float[Array, "1"]:
    """QMIX: Q_tot rises with every Q_i; how much, the state tells."""
    return network.team(taken(output.head, action), global_state(observation), observation.agent_mask)[None]


MIXERS = {"iql": independent, "vdn": summed, "qmix": monotonic}


def make(config: QmixConfig, env: Environment, training: TrainingConfig) -> Algorithm:
    """Q-learning with the configured mixer."""
    num_choices = choices(env).size
    settings = matched(env, config.network, num_choices)
    state_size = jax.eval_shape(lambda: global_state(env.reset(jax.random.key(0))[1])).size

    def networks(key: PRNGKey) -> Network:
        agent_key, mixer_key = jax.random.split(key)
        agent = AgentNetwork(env, settings, num_choices, agent_key)
        if config.mixer != "qmix":
            return Network(agent, ())
        return Network(agent, MonotonicMixer(env.num_agents, state_size, config.mixer_width, mixer_key))

    parts = Parts(
        networks=networks,
        team_value=MIXERS[config.mixer],
        exploration=exploration.linear((config.epsilon, config.epsilon_end), config.epsilon_steps),
        auxiliary=lambda output: {},
    )
    return q_learning.make(config, env, training, parts)
