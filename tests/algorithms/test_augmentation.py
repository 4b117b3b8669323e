"""Playing by the mean over the turned worlds: a policy that is symmetric by construction."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import drawn_learner

from gacrl.algorithms import build as algorithms
from gacrl.algorithms.contract import Algorithm
from gacrl.config import presets
from gacrl.config.algorithms import LearningConfig, NetworkConfig
from gacrl.config.run import TrainingConfig
from gacrl.envs.probes import Probe
from gacrl.errors import ConfigError
from gacrl.tasks.spread.environment import Spread

TRAINING = TrainingConfig(env_steps=100, num_envs=2, num_steps=4)


def made(preset: str, env: Spread, symmetric: bool) -> Algorithm:
    config = presets.preset(preset).algorithm
    assert isinstance(config, LearningConfig)
    network = replace(config.network, width=8)
    return algorithms.make(replace(config, network=network, symmetric_play=symmetric), env, TRAINING)


@pytest.mark.parametrize(("preset", "continuous"), [("gacrl", False), ("gacrl", True), ("mappo", False)])
def test_when_the_world_turns_the_actions_turn(preset: str, continuous: bool):
    """In 32 worlds turned in all eight ways; the same networks played plainly do something else in many of them."""
    env = Spread(num_agents=3, num_landmarks=2, continuous_actions=continuous)
    seen = jax.vmap(lambda key: env.reset(key)[1])(jax.random.split(jax.random.key(0), 32))
    symmetries = jnp.arange(env.num_symmetries)

    def kept(symmetric: bool) -> float:
        """Share of the actions that are those of the world as it is, turned."""
        algorithm = made(preset, env, symmetric)
        memory = algorithm.initial_memory(3)
        policy = algorithm.policy(drawn_learner(algorithm), False)

        def act(observation):
            return policy(memory, observation, jax.random.key(0))[0].action

        def both(observation, symmetry):
            turned = act(env.turn(observation, symmetry))
            return jnp.isclose(turned, env.turn_action(act(observation), symmetry))

        return jax.jit(jax.vmap(jax.vmap(both, (None, 0)), (0, None)))(seen, symmetries).mean()

    assert kept(symmetric=True) == 1.0
    assert kept(symmetric=False) < 0.9


def test_it_is_the_mean_over_eight_conversations():
    """By hand: the network asked in each turned world, its numbers turned back."""
    env = Spread(num_agents=3, num_landmarks=3)
    algorithm, (_, seen) = made("gacrl", env, symmetric=True), jax.jit(env.reset)(jax.random.key(3))
    learner = drawn_learner(algorithm)
    play = jax.jit(algorithm.policy(learner, False))
    decision, _ = play(algorithm.initial_memory(3), seen, jax.random.key(0))
    ask = jax.jit(lambda symmetry: learner.target.agent(env.turn(seen, symmetry))[0])
    total = np.zeros((3, 5))
    for symmetry in range(8):
        numbers = ask(symmetry).head
        for action in range(5):
            total[:, action] += numbers[:, env.turn_action(jnp.asarray(action), jnp.asarray(symmetry))]
    np.testing.assert_array_equal(decision.action, total.argmax(1))
    np.testing.assert_array_equal(decision.messages, ask(0).messages)


def test_networks_that_do_not_go_with_their_learner_are_refused():
    with pytest.raises(ConfigError, match="latent needs a learner that trains the code"):
        replace(presets.preset("mappo").algorithm, network=NetworkConfig(latent="vae"))
    gacrl, mappo = (presets.preset(name).algorithm for name in ("gacrl", "mappo"))
    for network in (NetworkConfig(recurrent=True), NetworkConfig(communication="dial")):
        for config in (gacrl, mappo):
            remembering = replace(config, symmetric_play=True, network=network)
            with pytest.raises(ConfigError, match="symmetric_play needs a network without memory"):
                algorithms.make(remembering, Spread(), TRAINING)
            # A task without symmetries is played as it is.
            algorithms.make(remembering, Probe(), TRAINING)
