"""QMIX (Rashid et al. 2018): the team's value is a monotonic network of the agents' values. The learner is in
`q_learning`, the mixing network in `networks.mixer`."""

import jax
from jaxtyping import Array, Float, Int

from gacrl.algorithms import q_learning
from gacrl.algorithms.actions import choices
from gacrl.algorithms.contract import Algorithm
from gacrl.algorithms.q_learner import Network, Parts
from gacrl.algorithms.shared import taken
from gacrl.config.algorithms import QmixConfig
from gacrl.config.run import TrainingConfig
from gacrl.envs.environment import Environment
from gacrl.networks.agent import AgentNetwork, AgentOutput, matched
from gacrl.networks.critic import global_state
from gacrl.networks.mixer import MonotonicMixer
from gacrl.types import Observation, PRNGKey


def monotonic(
    network: Network, output: AgentOutput, action: Int[Array, " N"], observation: Observation
) -> Float[Array, "1"]:
    """Return Q_tot, which rises with every Q_i; how much, the state tells."""
    return network.team(taken(output.head, action), global_state(observation), observation.agent_mask)[None]


def make(config: QmixConfig, env: Environment, training: TrainingConfig, progress: str | None = None) -> Algorithm:
    """Make Q-learning with the mixing network."""
    num_choices = choices(env).size
    settings = matched(env, config.network, num_choices)
    state_size = jax.eval_shape(lambda: global_state(env.reset(jax.random.key(0), env.default_params())[1])).size

    def networks(key: PRNGKey) -> Network:
        agent_key, mixer_key = jax.random.split(key)
        agent = AgentNetwork(env, settings, num_choices, agent_key)
        return Network(agent, MonotonicMixer(env.num_agents, state_size, config.mixer_width, mixer_key))

    return q_learning.make(config, env, training, progress, Parts(networks, monotonic))
