"""GACRL that solves the task: the paper's ideas, each in a place where it can work.

- Latent code and discrete messages over the proximity graph, as the paper's (2) to (9): `networks.agent`, with an
  entity graph for a torso, straight-through symbols, and receivers that know where the speaker stands.
- The central critic (12) is used: Q_tot = V(s) + Σ_i [A_i(a_i) − max_a A_i(a)] of the joint action is
  learned from replay by Q-learning. V sees all agents and is for training only; the maximum over joint
  actions stays each agent's own argmax, so that execution is decentralised.
- Exploration that adapts to coverage (13) to (16): `exploration.adaptive`.
"""

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from gacrl.algorithms import exploration, q_learning
from gacrl.algorithms.actions import ActionSet, choices
from gacrl.algorithms.contract import Algorithm
from gacrl.algorithms.exploration import Exploration
from gacrl.algorithms.q_learning import Network, Parts
from gacrl.algorithms.qmix import summed
from gacrl.algorithms.shared import taken
from gacrl.config.algorithms import GacrlConfig
from gacrl.config.run import TrainingConfig
from gacrl.envs.environment import Environment
from gacrl.networks.agent import AgentNetwork, AgentOutput, matched
from gacrl.networks.critic import team_mean
from gacrl.networks.layers import Linear, Mlp
from gacrl.types import Metrics, Observation, PRNGKey


def central(
    actions: ActionSet,
    network: Network,
    output: AgentOutput,
    action: Int[Array, " N"],
    observation: Observation,
) -> Float[Array, "1"]:
    """Q_tot = V(s) + Σ_i [A_i(a_i) − max_a A_i(a)]: the critic of (12), and what each agent falls short of it."""
    layers, head = network.team
    available = jnp.where(actions.mask(observation.action_mask), output.head, -jnp.inf)
    shortfall = taken(output.head, action) - available.max(-1)
    value = head(layers(team_mean(output.hidden, observation)))
    return value + jnp.where(observation.agent_mask, shortfall, 0.0).sum()


def make(config: GacrlConfig, env: Environment, training: TrainingConfig) -> Algorithm:
    """The learner for this task's shapes."""
    actions = choices(env)
    settings = matched(env, config.network, actions.size)
    width = settings.width

    def networks(key: PRNGKey) -> Network:
        agent_key, layers_key, head_key = jax.random.split(key, 3)
        agent = AgentNetwork(env, settings, actions.size, agent_key)
        if config.critic == "sum":
            return Network(agent, ())
        return Network(agent, (Mlp(width, (width,), layers_key), Linear(width, 1, head_key)))

    def auxiliary(output: AgentOutput) -> Metrics:
        if settings.latent == "none":
            return {}
        return {"loss_code": config.latent_weight * jnp.mean(output.code_loss)}

    parts = Parts(
        networks=networks,
        team_value=partial(central, actions) if config.critic == "central" else summed,
        exploration=_exploration(config, training.env_steps),
        auxiliary=auxiliary,
    )
    return q_learning.make(config, env, training, parts)


def _exploration(config: GacrlConfig, planned_steps: int) -> Exploration:
    epsilon, temperature = (config.epsilon, config.epsilon_end), (config.temperature, config.temperature_end)
    if config.exploration in ("adaptive", "yoked"):
        recorded = config.yoked_coverage if config.exploration == "yoked" else ()
        measure = f"coverage_{config.coverage_radius}"
        return exploration.adaptive(epsilon, temperature, config.greedy_share, measure, recorded, planned_steps)
    if config.exploration == "fixed":
        epsilon = (config.epsilon_end, config.epsilon_end)
        temperature = (config.temperature_end, config.temperature_end)
    return exploration.linear(epsilon, config.exploration_steps, temperature)
