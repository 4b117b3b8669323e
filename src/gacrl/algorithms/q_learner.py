"""What Q-learning of a team from replay is made of: what a learner passes in `Parts`, and the records of the rest."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import equinox as eqx
import jax
import optax
from jaxtyping import Array, Float, Int

from gacrl.algorithms import replay as ring
from gacrl.algorithms.actions import ActionSet
from gacrl.algorithms.exploration import Exploration
from gacrl.algorithms.objectives import RewardNorm
from gacrl.algorithms.shared import mean_real
from gacrl.config.algorithms import QLearningConfig
from gacrl.envs.environment import Environment
from gacrl.networks.agent import AgentNetwork, AgentOutput
from gacrl.types import Arrives, Memory, Metrics, Observation, PRNGKey, Transition


class Network(eqx.Module):
    """What is learned: the agents' network, whose head gives a number for each action, and the team's part."""

    agent: AgentNetwork
    team: Any
    teacher: AgentNetwork | None = None
    """Told what others see, and learns from rewards in the agents' place, who learn from it what each action loses."""

    @property
    def judge(self) -> AgentNetwork:
        """The network that learns from rewards."""
        return self.agent if self.teacher is None else self.teacher


TeamValue = Callable[[Network, AgentOutput, Int[Array, " N"], Observation], Float[Array, " M"]]
"""(network, its output, actions, observation) -> what is learned: the team's value, or each agent's."""


def message_loss(output: AgentOutput, observation: Observation) -> Metrics:
    """Return the loss that a kind of message has of its own, the mean over the real agents; {} for none."""
    if output.message_loss is None:
        return {}
    return {"loss_messages": mean_real(output.message_loss, observation.agent_mask)}


class Parts(NamedTuple):
    """Hold what makes a learner out of Q-learning (`q_learning.make`)."""

    networks: Callable[[PRNGKey], Network]
    team_value: TeamValue
    own_values: bool = False
    """Whether each agent's value is learned by itself: it ends with the agent's life, the team's does not."""
    auxiliary: Callable[[AgentOutput, Observation], Metrics] = message_loss
    """Further terms of the loss, weighted already, from what the network put out and was shown; {} for none."""


@dataclass(frozen=True)
class Setup:
    """Hold what is settled before anything is learned: constants of every function of Q-learning."""

    config: QLearningConfig
    env: Environment
    actions: ActionSet
    parts: Parts
    explorer: Exploration
    adam: optax.GradientTransformation
    num_envs: int
    num_steps: int
    network: Network
    """Its shapes."""
    fresh: Memory
    """The network's memory at an episode's start."""
    arrives: Arrives
    """The shapes of what arrives in a step, where somebody intervenes while training."""

    @property
    def window(self) -> int:
        """W: steps of a replayed window, those that are learned from and those whose rewards their targets hold."""
        return self.config.sequence_length + self.config.n_step - 1

    @property
    def rows(self) -> int:
        """Of the replay: a multiple of a rollout's steps, and at least a window."""
        rollouts = -(-self.config.replay_capacity // (self.num_envs * self.num_steps))
        return max(rollouts, -(-self.window // self.num_steps)) * self.num_steps

    @property
    def shares_reward(self) -> bool:
        """Everyone earns the team's reward: a value of the team can be learned from no other."""
        return self.config.reward == "team" or not self.parts.own_values

    @property
    def forgetful(self) -> bool:
        """The network has no memory."""
        return not jax.tree.leaves(self.fresh)


class Experience(NamedTuple):
    """What the replay remembers of a step of one environment."""

    transition: Transition
    memory: Memory
    """The network's, before the step."""


class ActMemory(NamedTuple):
    """The policy's memory: the network's, and what exploration settled at the start of the episode."""

    network: Memory
    exploration: Any


class Hyper(NamedTuple):
    """The numbers that a sweep can vary."""

    learning_rate: Float[Array, ""] | float
    learning_rate_end: Float[Array, ""] | float
    gamma: Float[Array, ""] | float
    target_step: Float[Array, ""] | float
    planned_steps: Float[Array, ""] | float
    """Environment steps over which the learning rate moves; it stays at its end after them."""


class LearnerState(NamedTuple):
    """What Q-learning carries from update to update."""

    network: Network
    target: Network
    optimizer: optax.OptState
    replay: ring.Replay[Float[Array, "capacity E W"]]
    """Of experiences, each packed into one vector."""
    rewards: RewardNorm
    """Running moments of the reward, and whether episodes end by themselves."""
    exploration: Any
    env_steps: Int[Array, ""]
    hyper: Hyper
