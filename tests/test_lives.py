"""What ends before its time: lives inside an episode, across which no value is bootstrapped, and episodes themselves."""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gacrl import Environment, TimeStep, observe, rollout
from gacrl.algorithms import build
from gacrl.config.algorithms import IppoConfig, IqlConfig, NetworkConfig, VdnConfig
from gacrl.config.run import TrainingConfig
from gacrl.training.curriculum import constant
from gacrl.training.trainer import Trainer
from gacrl.types import Decision

GAMMA = 0.9


@dataclass(frozen=True)
class Slots(Environment):
    """Each life has two steps, of which the second earns 1; then another agent takes the slot. The second agent's lives
    begin a step later than the first one's."""

    num_agents: int = 2
    num_actions: int = 2
    observation_size: int = 2
    max_cycles: int = 7

    def reset(self, key: Any, params: Any = ()) -> Any:
        state = {"age": jnp.array([0, 1]), "clock": jnp.zeros((), jnp.int32)}
        return state, self.look(state)

    def step(self, state: Any, action: Any, key: Any, params: Any = ()) -> Any:
        left = state["age"] == 1
        state = {"age": jnp.where(left, 0, 1), "clock": state["clock"] + 1}
        over = state["clock"] >= self.max_cycles
        return state, TimeStep(self.look(state), left * 1.0, jnp.asarray(False), over, {}, left)

    def look(self, state: Any) -> Any:
        return observe(jax.nn.one_hot(state["age"], 2), num_actions=2)


@pytest.mark.parametrize("recurrent", [pytest.param(False, marks=pytest.mark.slow), True])
@pytest.mark.parametrize("kind", [IppoConfig, IqlConfig])
def test_values_end_with_a_life(kind: Any, recurrent: bool):
    """1 in a life's second step and γ in its first; bootstrapped into the next life they would be 5.3 and 4.7."""
    settings: dict[str, Any] = {
        "network": NetworkConfig(width=8, depth=1, recurrent=recurrent),
        "gamma": GAMMA,
        "learning_rate": 1e-2,
        "learning_rate_end": 1e-2,
        "reward": "own",
    }
    if kind is IqlConfig:
        settings |= {"learning_starts": 0, "batch_size": 32, "updates": 4, "target_step": 0.1, "n_step": 3}
        settings |= {"replay_capacity": 2_000, "sequence_length": 4}
    else:
        settings |= {"value_norm": False, "num_minibatches": 1}
    env, training = Slots(), TrainingConfig(env_steps=8 * 7 * 150, num_envs=8, num_steps=7)
    algorithm = build.make(kind(**settings), env, training)
    trainer = Trainer(algorithm, env, constant(), training.num_envs, training.num_steps)
    state, _ = trainer.chunk(trainer.init((0,)), 150)
    policy = algorithm.policy(jax.tree.map(lambda leaf: leaf[0], state.learner), False)
    values = []
    world, seen = env.reset(jax.random.key(0))
    memory = trainer.memory
    for _ in range(4):
        decision, memory = policy(memory, seen, jax.random.key(0))
        values.append((world["age"], decision.extras["value"]))
        world, after = env.step(world, decision.action, jax.random.key(0))
        seen = after.observation
        memory = rollout.restarted(trainer.memory, memory, after.left)
    found = np.array([value for _, value in values])
    expected = np.where(np.array([age for age, _ in values]) == 1, 1.0, GAMMA)
    if kind is IqlConfig:  # a decision's value is the mean over the agents, one of which is in each step of a life
        expected = np.full_like(expected, (1 + GAMMA) / 2)
    np.testing.assert_allclose(found, expected, atol=0.05)


def test_who_takes_a_slot_remembers_nothing():
    """The memory counts an agent's steps: it begins anew with a life, for the whole team with an episode."""
    env = Slots(max_cycles=5)

    def policy(memory: Any, observation: Any, key: Any) -> Any:
        own, team = memory
        return Decision(jnp.zeros(2, jnp.int32), extras=memory), (own + 1, team + 1)

    start = (jnp.zeros((2, 1)), jnp.zeros(()))
    carry = rollout.start(env, (), start, jax.random.key(0), 3)
    _, found = rollout.collect(env, policy, start, (), carry, jax.random.key(1), 8)
    own, team = found.transitions.decision.extras
    np.testing.assert_array_equal(own[:, 0, :, 0].T, [[0, 1, 0, 1, 0, 0, 1, 0], [0, 0, 1, 0, 1, 0, 0, 1]])
    np.testing.assert_array_equal(team[:, 0], [0, 1, 2, 3, 4, 0, 1, 2])


@dataclass(frozen=True)
class Errand(Environment):
    """Every step costs 1, until the first agent ends it: by its second action."""

    num_agents: int = 2
    num_actions: int = 2
    observation_size: int = 1
    max_cycles: int = 7

    def reset(self, key: Any, params: Any = ()) -> Any:
        return jnp.zeros((), jnp.int32), observe(jnp.ones((2, 1)), num_actions=2)

    def step(self, state: Any, action: Any, key: Any, params: Any = ()) -> Any:
        seen, over = observe(jnp.ones((2, 1)), num_actions=2), action[0] == 1
        return state + 1, TimeStep(seen, -jnp.ones(2), over, ~over & (state + 1 >= self.max_cycles), {})


def test_a_task_that_costs_the_same_in_every_step_is_ended_at_once():
    """With the reward's mean taken off there would be nothing to learn from: −1 as ever, 0 from what is expected."""
    config = VdnConfig(
        network=NetworkConfig(width=8, depth=1, recurrent=False),
        gamma=GAMMA,
        learning_rate=1e-2,
        learning_rate_end=1e-2,
        learning_starts=0,
        batch_size=32,
        updates=4,
        target_step=0.1,
        replay_capacity=2_000,
        sequence_length=1,
        reward_norm=True,
    )
    env, training = Errand(), TrainingConfig(env_steps=8 * 7 * 100, num_envs=8, num_steps=7)
    algorithm = build.make(config, env, training)
    trainer = Trainer(algorithm, env, constant(), training.num_envs, training.num_steps)
    state, _ = trainer.chunk(trainer.init((0,)), 100)
    policy = algorithm.policy(jax.tree.map(lambda leaf: leaf[0], state.learner), False)
    decision, _ = policy(trainer.memory, env.reset(jax.random.key(0))[1], jax.random.key(0))
    assert decision.action[0] == 1
    np.testing.assert_allclose(decision.extras["value"], -1.0, atol=0.05)
