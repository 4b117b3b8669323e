"""Messages of your own, in one class and one line: agents say numbers, at a price, and hear their neighbours' mean.

python examples/own_messages.py
gacrl train --use examples/own_messages.py --algorithm.network.communication numbers
"""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp

import gacrl
from gacrl.config.kinds import COMMUNICATION
from gacrl.networks.communication import Communication, Spoken, neighbour_mean, received
from gacrl.networks.layers import Linear


class Numbers(Communication):
    """Each agent says `vocabulary` numbers between -1 and 1; how large they are is a loss of its own."""

    say: Linear
    hear_them: Linear
    price: float = eqx.field(static=True)

    def __init__(self, env, config, key, gain=None):
        say_key, hear_key = jax.random.split(key)
        self.say = Linear(config.width, config.vocabulary, say_key, gain)
        self.hear_them = Linear(config.vocabulary, config.width, hear_key, gain)
        self.price = 1e-3

    def speak(self, hidden, near, key, temperature, code=None):
        numbers = jnp.tanh(self.say(hidden))  # [N V]
        heard = neighbour_mean(received(numbers, near), near.adjacency)
        cost = self.price * jnp.square(numbers).sum(-1)
        return Spoken(hidden + jax.nn.relu(self.hear_them(heard)), numbers[None], loss=cost)


COMMUNICATION["numbers"] = Numbers


def main(env_steps=30_000, out=None):
    """Train GACRL's learner with these messages on the task of examples/own_task.py."""
    config = gacrl.preset("gacrl")
    network = replace(config.algorithm.network, communication="numbers")
    config = replace(
        config,
        algorithm=replace(config.algorithm, network=network),
        training=replace(config.training, env_steps=env_steps),
    )
    return gacrl.train(config, env="examples/own_task.py:Beacon", out=out)


if __name__ == "__main__":
    print(main().summary["final"]["greedy"]["return_agent_mean"])
