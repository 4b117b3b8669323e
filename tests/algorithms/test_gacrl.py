"""GACRL: the team's value, execution without a centre, pushes for actions."""

from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import drawn

from gacrl.algorithms import build as algorithms
from gacrl.algorithms import gacrl, q_learning, q_loss, teaching
from gacrl.algorithms import replay as ring
from gacrl.algorithms.actions import STRENGTHS, choices
from gacrl.algorithms.q_learner import Network
from gacrl.config import presets
from gacrl.config.algorithms import NetworkConfig
from gacrl.config.run import TrainingConfig
from gacrl.errors import ConfigError
from gacrl.messages import interventions
from gacrl.networks.agent import AgentNetwork
from gacrl.networks.layers import Linear, Mlp
from gacrl.networks.messages import most_likely_symbol
from gacrl.tasks.spread.environment import Spread
from gacrl.training.curriculum import constant
from gacrl.training.trainer import Trainer
from gacrl.types import Arrives

ENV = Spread(num_agents=4, num_landmarks=3)
TALKING = NetworkConfig(
    torso="graph", width=8, latent="vae", latent_size=3, communication="discrete", vocabulary=4
)
SMALL = replace(
    presets.preset("gacrl").algorithm,
    network=TALKING,
    replay_capacity=60,
    learning_starts=10,
    batch_size=4,
    updates=1,
)
TRAINING = TrainingConfig(env_steps=100, num_envs=2, num_steps=5)


def test_the_teams_value_is_the_critics_less_what_each_agent_falls_short():
    _, seen = jax.jit(ENV.reset)(jax.random.key(0))
    network = Network(drawn(AgentNetwork, ENV, TALKING, 5), (drawn(Mlp, 8, (8,)), drawn(Linear, 8, 1)))
    output, _ = jax.jit(lambda seen: network.agent(seen))(seen)
    best = output.head.argmax(-1)
    layers, head = network.team
    value = head(layers(output.hidden.mean(0)))
    np.testing.assert_allclose(gacrl.central(choices(ENV), network, output, best, seen), value, rtol=1e-5)
    worse = best.at[1].set(output.head[1].argmin())
    short = output.head[1].max() - output.head[1].min()
    found = gacrl.central(choices(ENV), network, output, worse, seen)
    np.testing.assert_allclose(found, value - short, rtol=1e-5)

    padded = seen._replace(agent_mask=jnp.array([True, False, True, True]))
    value = head(layers(output.hidden[jnp.array([0, 2, 3])].mean(0)))
    found = gacrl.central(choices(ENV), network, output, worse, padded)
    np.testing.assert_allclose(found, value, rtol=1e-5, err_msg="who is not there counts nothing")


TAUGHT = replace(SMALL, critic="told", averaged=False, network=replace(TALKING, latent="none"))


@pytest.mark.parametrize("rounds", [1, 2])
def test_rewards_teach_the_teacher_and_the_teacher_the_agents(rounds: int):
    """Each term of the loss has gradients in one of the two networks alone; who acts needs the agents alone."""
    algorithm = algorithms.make(replace(TAUGHT, teacher_rounds=rounds), ENV, TRAINING)
    trainer = Trainer(algorithm, ENV, constant(), TRAINING.num_envs, TRAINING.num_steps)
    state, _ = trainer.chunk(trainer.init((0,)), 4)
    learner = jax.tree.map(lambda leaf: leaf[0], state.learner)
    q = trainer.algorithm.init.args[0]  # pyright: ignore[reportFunctionMemberAccess] a partial
    unpack = ring.packing(partial(q_learning.example, q))[1]
    batch = jax.vmap(jax.vmap(unpack))(learner.replay.items[: q.window, :1])

    @jax.jit
    def slopes(network: Network) -> Any:
        def term(name: str) -> Any:
            def of(network: Network) -> jax.Array:
                keys = jax.random.split(jax.random.key(1), 1)
                return q_loss.loss(q, network, learner, learner.rewards, batch, keys)[1][name]

            return jax.grad(of)(network)

        return term("loss_td"), term("loss_lesson")

    def size(network: Any) -> float:
        return float(sum(jnp.abs(leaf).sum() for leaf in jax.tree.leaves(network)))

    rewarded, taught = slopes(learner.network)
    assert size(rewarded.agent) == 0.0 and size(rewarded.teacher) > 1e-3
    assert size(taught.agent) > 1e-3 and size(taught.teacher) == 0.0

    alone = trainer.algorithm.acting(learner)
    assert alone.network.teacher is None and alone.target.teacher is None
    _, seen = ENV.reset(jax.random.key(0))
    acts = [trainer.algorithm.policy(it, False)((), seen, jax.random.key(1))[0] for it in (learner, alone)]
    np.testing.assert_array_equal(acts[0].action, acts[1].action)
    assert np.isfinite(acts[0].extras["value"]).all() and np.isnan(acts[1].extras["value"]).all()


def test_a_teacher_is_told_all_whatever_happens_to_words():
    """Words on their way are the agents' alone; a cut edge is cut for both. A step late, nobody could be taught."""
    _, seen = ENV.reset(jax.random.key(0))
    arrives = Arrives(jnp.ones((1, 4, 4)), jnp.ones((1, 4), bool), ~jnp.eye(4, dtype=bool))
    shown = teaching.told(seen._replace(arrives=arrives)).arrives
    assert shown.values is None and shown.replaced is None and shown.kept is arrives.kept
    training = replace(TRAINING, intervention="swap 0 1")
    trainer = Trainer(
        algorithms.make(TAUGHT, ENV, training),
        ENV,
        constant(),
        TRAINING.num_envs,
        TRAINING.num_steps,
        intervention=interventions.parse("swap 0 1"),
    )
    _, report = trainer.chunk(trainer.init((0,)), 4)
    assert float(report.metrics["loss_lesson"][0]) > 0 and np.isfinite(report.metrics["loss_td"]).all()
    late = replace(TAUGHT, network=replace(TAUGHT.network, communication="dial"))
    with pytest.raises(ConfigError, match="algorithm.critic told needs messages that are heard in the step"):
        algorithms.make(late, ENV, TRAINING)
    with pytest.raises(ConfigError, match="algorithm.teacher_rounds needs algorithm.critic told, not central"):
        algorithms.make(replace(SMALL, critic="central", teacher_rounds=2), ENV, TRAINING)


@pytest.mark.parametrize(("env_steps", "for_speed"), [(999_999, False), (1_000_000, True)])
def test_long_trainings_are_compiled_for_speed(env_steps: int, for_speed: bool):
    made = algorithms.make(SMALL, ENV, replace(TRAINING, env_steps=env_steps))
    assert made.compiled_for_speed == for_speed


def test_a_lesson_is_what_each_action_loses_by_the_teacher():
    """Of four agents one may not do the last action, and two are not there."""
    q = algorithms.make(TAUGHT, ENV, TRAINING).init.args[0]  # pyright: ignore[reportFunctionMemberAccess] a partial
    _, seen = ENV.reset(jax.random.key(0))
    seen = seen._replace(
        agent_mask=jnp.array([True, True, False, False]),
        action_mask=jnp.ones((4, 5), bool).at[1, 4].set(False),
    )

    def says(*heads: list[float]) -> jax.Array:
        return jnp.asarray([*heads, [5.0] * 5, [7.0] * 5])

    # The teacher's actions lose (0, −1, −1, 0, 0) and (−4, 0, 0, 0, ·); the pupils err by −1 in one and by 5 in another.
    teacher = says([3.0, 2.0, 2.0, 3.0, 3.0], [0.0, 4.0, 4.0, 4.0, 9.0])
    pupils = says([0.0, -1.0, -2.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0, 9.0])
    available = q.actions.mask(seen.action_mask)
    found = teaching.lesson(pupils, teacher, available, seen.agent_mask)
    np.testing.assert_allclose(found, 0.5 * (1 + 25))


def test_each_agent_acts_on_what_it_sees_and_what_it_is_told():
    """By itself, with its own observation and its neighbours' symbols, an agent computes what the team's program does."""
    key = jax.random.key(1)
    _, seen = jax.jit(ENV.reset)(key)
    network = drawn(AgentNetwork, ENV, replace(TALKING, rounds=2), 5)
    together, _ = jax.jit(lambda seen: network(seen))(seen)
    talk, code = network.communication, network.code
    assert code is not None

    def alone(agent: int):
        """What one agent knows before anything is said: all other rows are noise."""
        features = jax.random.normal(key, seen.features.shape).at[agent].set(seen.features[agent])
        hidden = network.torso(seen._replace(features=features)).hidden[agent][None]
        z, hidden, _ = code(hidden, None)
        return z, hidden

    states = [alone(agent) for agent in range(4)]
    source, hidden = [z for z, _ in states], [h for _, h in states]
    positions = np.asarray(seen.positions)
    for number in range(2):
        told = [most_likely_symbol(talk.encode[number](x))[0] for x in source]
        after = []
        for i in range(4):
            near = [j for j in range(4) if j != i and np.linalg.norm(positions[i] - positions[j]) < 1.5]
            heard = jnp.zeros(4)
            if near:
                offsets = jnp.asarray(positions[near] - positions[i])
                where = jnp.concatenate([offsets, jnp.sqrt(jnp.square(offsets).sum(-1, keepdims=True) + 1e-8)], -1)
                edges = talk.edge[number](jnp.concatenate([jnp.stack([told[j] for j in near]), where], -1))
                score = edges @ talk.query[number](hidden[i])[0] / 2  # √4 numbers of an edge
                heard = jax.nn.softmax(score) @ edges
            merged = talk.merge[number](jnp.concatenate([hidden[i], heard[None]], -1))
            after.append(hidden[i] + jax.nn.relu(merged))
        source = hidden = after
    np.testing.assert_allclose(network.head(jnp.concatenate(hidden)), together.head, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("continuous", [pytest.param(False, marks=pytest.mark.soak), True])
def test_it_learns_from_its_replay_and_acts_as_the_task_wants(continuous: bool):
    env = Spread(num_agents=2, num_landmarks=2, max_cycles=4, continuous_actions=continuous)
    algorithm = algorithms.make(SMALL, env, TRAINING)
    trainer = Trainer(algorithm, env, constant(), TRAINING.num_envs, TRAINING.num_steps)
    before = trainer.init((0,))
    weights = np.asarray(jax.tree.leaves(before.learner.network)[0])
    state, report = trainer.chunk(before, 4)
    assert all(np.isfinite(value).all() for value in report.metrics.values())
    assert (np.asarray(jax.tree.leaves(state.learner.network)[0]) != weights).any()
    assert report.metrics["loss_code"] > 0

    learner = jax.tree.map(lambda leaf: leaf[0], state.learner)
    _, seen = env.reset(jax.random.key(0))
    decision, _ = algorithm.policy(learner, True)(trainer.memory, seen, jax.random.key(1))
    assert decision.messages.shape == (1, 2, 4)
    np.testing.assert_array_equal(decision.messages.sum(-1), 1.0)
    if continuous:
        assert decision.action.shape == (2, 5)
        assert set(np.unique(decision.action)) <= {0.0, 1.0, *STRENGTHS}
    else:
        assert decision.action.shape == (2,)


def test_pushes_turn_with_the_world():
    env = Spread(num_agents=1, num_landmarks=1, continuous_actions=True)
    pushes = choices(env)
    assert pushes.size == 1 + 4 * len(STRENGTHS)
    everything = jnp.arange(pushes.size)
    for symmetry in range(8):
        turned = pushes.turn(everything, jnp.asarray(symmetry))
        assert sorted(turned.tolist()) == everything.tolist()
        expected = env.turn_action(pushes.act(everything), jnp.asarray(symmetry))
        np.testing.assert_allclose(pushes.act(turned), expected)
