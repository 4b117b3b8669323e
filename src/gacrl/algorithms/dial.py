"""DIAL (Foerster et al. 2016): VDN's learner, whose gradients flow back through messages from hearer to speaker.

The messages are in `networks.communication.dial`: noisy units while learning, bits when played, heard a step later. A
window of several steps is learned from, since what is said at a step is worth something at the next one.
"""

from gacrl.algorithms import q_learning
from gacrl.algorithms.contract import Algorithm
from gacrl.algorithms.q_learner import Parts
from gacrl.algorithms.vdn import summed
from gacrl.config.algorithms import DialConfig
from gacrl.config.run import TrainingConfig
from gacrl.envs.environment import Environment


def make(config: DialConfig, env: Environment, training: TrainingConfig, progress: str | None = None) -> Algorithm:
    """Make Q-learning of the sum, through messages."""
    parts = Parts(q_learning.agents_alone(config, env), summed)
    return q_learning.make(config, env, training, progress, parts)
