"""GACRL that solves the task: the paper's ideas, each in a place where it can work.

- Latent code and discrete messages over the proximity graph, as the paper's (2) to (9): `networks.agent`, with an
  entity graph for a torso, and receivers that know where the speaker stands and look again after they have heard.
- The central critic (12) is used: Q_tot = V(s) + Σ_i [A_i(a_i) − max_a A_i(a)] of the joint action is
  learned from replay by Q-learning. V sees all agents and is for training only; the maximum over joint
  actions stays each agent's own argmax, so that execution is decentralised. With `critic told` the agents of Q_tot are
  for training only as well: they are told what the others see, and teach those who act and talk.
- Exploration that adapts to progress, on `spread` coverage, (13) to (16): `exploration.adaptive`.
"""

from dataclasses import replace
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from gacrl.algorithms import q_learning
from gacrl.algorithms.actions import ActionSet, choices
from gacrl.algorithms.contract import Algorithm
from gacrl.algorithms.q_learner import Network, Parts, message_loss
from gacrl.algorithms.shared import taken
from gacrl.algorithms.vdn import summed
from gacrl.config.algorithms import GacrlConfig
from gacrl.config.checks import require
from gacrl.config.run import TrainingConfig
from gacrl.envs.environment import Environment
from gacrl.networks.agent import AgentNetwork, AgentOutput, matched
from gacrl.networks.communication.told import Told
from gacrl.networks.critic import team_mean
from gacrl.networks.layers import Linear, Mlp
from gacrl.types import Metrics, Observation, PRNGKey

LONG = 1_000_000
"""Environment steps of a training from which on it pays to compile for speed (docs/design.md)."""


def central(
    actions: ActionSet,
    network: Network,
    output: AgentOutput,
    action: Int[Array, " N"],
    observation: Observation,
) -> Float[Array, "1"]:
    """Return Q_tot = V(s) + Σ_i [A_i(a_i) − max_a A_i(a)]: the critic of (12), and what agents fall short of it."""
    layers, head = network.team
    available = jnp.where(actions.mask(observation.action_mask), output.head, -jnp.inf)
    shortfall = taken(output.head, action) - available.max(-1)
    value = head(layers(team_mean(output.hidden, observation)))
    return value + jnp.where(observation.agent_mask, shortfall, 0.0).sum()


def make(
    config: GacrlConfig, env: Environment, training: TrainingConfig, progress: str | None = None
) -> Algorithm:
    """Make the learner for this task's shapes. progress: the task's measure that exploration follows."""
    require(
        config.critic == "told" or config.teacher_rounds == 1,
        f"algorithm.teacher_rounds needs algorithm.critic told, not {config.critic}: others have no teacher",
    )
    actions = choices(env)
    settings = matched(env, config.network, actions.size)
    width = settings.width
    told = replace(settings, communication="told", latent="none", gate=False, word_price=0.0)

    def networks(key: PRNGKey) -> Network:
        agent_key, layers_key, head_key = jax.random.split(key, 3)
        agent = AgentNetwork(env, settings, actions.size, agent_key)
        require(
            config.critic != "told" or not agent.communication.heard_late,
            f"algorithm.critic told needs messages that are heard in the step in which they are said, which "
            f"{settings.communication} has not: take central",
        )
        if config.critic == "sum":
            return Network(agent, ())
        value = (Mlp(width, (width,), layers_key), Linear(width, 1, head_key))
        if config.critic == "central":
            return Network(agent, value)
        return Network(agent, value, teacher(jax.random.fold_in(key, 1)))

    def teacher(key: PRNGKey) -> AgentNetwork:
        network = AgentNetwork(env, told, actions.size, key)
        if config.teacher_rounds == 1:
            return network
        hears = Told(env, told, jax.random.fold_in(key, 1), rounds=config.teacher_rounds)
        return eqx.tree_at(lambda it: it.communication, network, hears)

    def auxiliary(output: AgentOutput, observation: Observation) -> Metrics:
        if settings.latent == "none":
            return message_loss(output, observation)
        code = {"loss_code": config.latent_weight * jnp.mean(output.code_loss)}
        return {**code, **message_loss(output, observation)}

    parts = Parts(
        networks=networks,
        team_value=summed if config.critic == "sum" else partial(central, actions),
        auxiliary=auxiliary,
    )
    learner = q_learning.make(config, env, training, progress, parts)
    return learner._replace(compiled_for_speed=training.env_steps >= LONG)
