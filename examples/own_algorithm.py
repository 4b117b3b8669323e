"""An algorithm of your own, in one file and one line: REINFORCE (Williams 1992), with any network and messages.

python examples/own_algorithm.py
"""

from dataclasses import dataclass, replace
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import optax

import gacrl
from gacrl import Algorithm
from gacrl.algorithms.distributions import log_policy
from gacrl.algorithms.shared import taken
from gacrl.config.algorithms import ALGORITHMS, Kind, LearningConfig, NetworkConfig
from gacrl.networks.agent import AgentNetwork, unroll
from gacrl.types import Decision


@dataclass(frozen=True)
class ReinforceConfig(LearningConfig):
    """Policy gradient with the mean return as baseline; a rollout must be one episode long."""

    name: ClassVar[str] = "reinforce"
    learning_rate: float = 5e-3


class Learner(NamedTuple):
    network: AgentNetwork
    optimizer: optax.OptState


def make(config, env, training, progress=None):
    """The algorithm for this task's shapes, as a record of pure functions."""
    adam = optax.adam(config.learning_rate)

    def init(key, hyper):
        network = AgentNetwork(env, config.network, env.num_actions, key)
        return Learner(network, adam.init(network))

    def policy(learner, explore):
        def act(memory, observation, key):
            output, memory = learner.network(observation, memory, key if explore else None)
            logits = log_policy(output.head, observation.action_mask)
            choice = jax.random.categorical(key, logits) if explore else logits.argmax(-1)
            return Decision(choice, output.messages, output.adjacency, {"key": key}), memory

        return act

    def loss(network, steps):
        def one(steps):  # one environment's episode [T, ...]
            output, _ = unroll(network, steps.observation, steps.first, (), steps.decision.extras["key"])
            return taken(log_policy(output.head, steps.observation.action_mask), steps.decision.action)

        to_go = jnp.cumsum(steps.reward[::-1], axis=0)[::-1]  # [T E N]
        return -(jax.vmap(one, 1, 1)(steps) * (to_go - to_go.mean(1, keepdims=True))).mean()

    def update(learner, rollout, key):
        value, gradients = jax.value_and_grad(loss)(learner.network, rollout.transitions)
        updates, optimizer = adam.update(gradients, learner.optimizer)
        return Learner(optax.apply_updates(learner.network, updates), optimizer), {"loss": value}

    return Algorithm(
        init=init,
        initial_memory=lambda num_agents: (),
        policy=policy,
        update=update,
        hyper=(),
        acting=lambda learner: learner._replace(optimizer=()),
        parameters=lambda learner: learner.network,
    )


ALGORITHMS["reinforce"] = Kind(ReinforceConfig, make)


def main(env_steps=60_000, out=None):
    """Train it, with CommNet's messages, on the task of examples/own_task.py, whose episodes have six steps."""
    config = gacrl.preset("ippo")
    network = NetworkConfig(width=32, communication="commnet")
    training = replace(config.training, env_steps=env_steps, num_envs=64, num_steps=6)
    config = replace(config, algorithm=ReinforceConfig(network=network), training=training)
    return gacrl.train(config, env="examples/own_task.py:Beacon", out=out)


if __name__ == "__main__":
    print(main().summary["final"]["greedy"]["return_agent_mean"])
