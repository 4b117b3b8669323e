"""Gaussian actions: their formulas by hand, a bandit whose optimum is known, and who refuses them."""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import gacrl
from gacrl.algorithms import build
from gacrl.algorithms.distributions import LOG_STD_RANGE, distribution
from gacrl.config.algorithms import IppoConfig, NetworkConfig, QmixConfig, VdnConfig
from gacrl.config.run import TrainingConfig
from gacrl.training.build import constant
from gacrl.training.trainer import Trainer

BEST = np.array([[0.2, 0.9], [0.6, 0.0]])


@dataclass(frozen=True)
class Bandit(gacrl.Environment):
    """One step; each agent loses the squared distance from its optimum. The second agent has one number to set."""

    num_agents = 2
    num_actions = 2
    observation_size = 2
    max_cycles = 1
    continuous_actions = True

    def reset(self, key: Any, params: Any = ()) -> Any:
        return jnp.zeros(()), self.look()

    def step(self, state: Any, action: Any, key: Any, params: Any = ()) -> Any:
        lost = jnp.where(self.look().action_mask, jnp.square(action - BEST), 0.0).sum(-1)
        return state, gacrl.TimeStep(self.look(), -lost, jnp.array(True), jnp.array(False))

    def look(self) -> Any:
        return gacrl.observe(jnp.eye(2), available=jnp.array([[True, True], [True, False]]))


def test_the_gaussian_is_that_of_scipy_and_bounded_in_its_spread():
    """Heads are means, then log standard deviations; numbers that an action does not have count nothing."""
    family = distribution(Bandit())
    head = jnp.array([[0.5, -1.0, np.log(0.5), np.log(2.0)], [0.1, 9.0, -40.0, 40.0]])
    pi = family.of(head, jnp.array([[True, True], [False, True]]))
    # By hand: at one standard deviation, −½ − log σ − ½ log 2π for each number.
    drawn = jnp.array([[1.0, 1.0], [7.0, 9.0]])
    expected = 2 * (-0.5 - 0.5 * np.log(2 * np.pi)) - np.log(0.5) - np.log(2.0)
    np.testing.assert_allclose(family.log_prob(pi, drawn)[0], expected, rtol=1e-6)
    spread = np.exp(LOG_STD_RANGE[1])
    np.testing.assert_allclose(family.log_prob(pi, drawn)[1], stats.norm(9.0, spread).logpdf(9.0), rtol=1e-6)
    wanted = [stats.norm(0, 0.5).entropy() + stats.norm(0, 2.0).entropy(), stats.norm(0, spread).entropy()]
    np.testing.assert_allclose(family.entropy(pi), wanted, rtol=1e-6)
    np.testing.assert_array_equal(pi.log_std[1], LOG_STD_RANGE)

    draws = jax.vmap(lambda key: family.sample(pi, key))(jax.random.split(jax.random.key(0), 4_000))
    np.testing.assert_allclose(draws[:, 0].mean(0), [0.5, -1.0], atol=0.1)
    np.testing.assert_allclose(draws[:, 0].std(0), [0.5, 2.0], rtol=0.05)
    # The task takes 0 to 1 for −1 to 1, and no more.
    found = family.actions.act(jnp.array([[-1.0, 0.5], [1.0, 7.0]]))
    np.testing.assert_allclose(found, [[0.0, 0.75], [1.0, 1.0]])


def test_ippo_finds_the_optimum_of_a_bandit():
    config = IppoConfig(
        network=NetworkConfig(width=16, depth=1), reward="own", learning_rate=3e-3, ent_coef=0.0, update_epochs=4
    )
    training = TrainingConfig(env_steps=64 * 150, num_envs=64, num_steps=1)
    env = Bandit()
    trainer = Trainer(build.make(config, env, training), env, constant(), training.num_envs, training.num_steps)
    state, report = trainer.chunk(trainer.init((0,)), 150)
    assert all(np.isfinite(value).all() for value in report.metrics.values())
    learner = jax.tree.map(lambda leaf: leaf[0], state.learner)
    decision, _ = trainer.algorithm.policy(learner, False)((), env.look(), jax.random.key(0))
    off = np.abs(decision.action - BEST)[np.array([[True, True], [True, False]])]
    assert off.max() < 0.03, off
    drawn, _ = trainer.algorithm.policy(learner, True)((), env.look(), jax.random.key(1))
    assert ((drawn.action >= 0) & (drawn.action <= 1)).all() and not np.array_equal(drawn.action, decision.action)


@pytest.mark.parametrize(
    ("config", "sentence"),
    [
        (VdnConfig(), "the task's actions are continuous, and this algorithm chooses among actions"),
        (QmixConfig(), "the task's actions are continuous"),
        (gacrl.preset("gacrl").algorithm, "the task's actions are continuous"),
        (IppoConfig(exploration="linear"), "algorithm.exploration linear makes actions random"),
        (IppoConfig(symmetric_play=True), "algorithm.symmetric_play takes the mean of choices"),
    ],
)
def test_who_needs_a_choice_says_so(config: Any, sentence: str):
    with pytest.raises(gacrl.ConfigError, match=sentence):
        build.make(config, Bandit(), TrainingConfig())
