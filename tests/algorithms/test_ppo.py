"""PPO: its formulas by hand and as rlax has them, its targets, its segments, and a first ratio of 1."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import rlax
from conftest import drawn, drawn_learner, soaked
from scipy import special, stats

from gacrl import rollout
from gacrl.algorithms import distributions, ippo, mappo, ppo
from gacrl.algorithms.actions import choices
from gacrl.algorithms.objectives import clipped_surrogate, follow_returns, huber, no_returns
from gacrl.algorithms.shared import mean_real, share_reward
from gacrl.config.algorithms import IppoConfig, MappoConfig, NetworkConfig
from gacrl.config.run import TrainingConfig
from gacrl.envs.environment import observe
from gacrl.envs.probes import Probe
from gacrl.tasks.spread.environment import Spread
from gacrl.types import Decision, Rollout, Transition

# The formulas.


def test_clipped_surrogate_by_hand_and_as_rlax_has_it():
    """ε = 0.2. A gain counts up to a ratio of 1.2 and not beyond; a loss counts however large the ratio is."""
    ratio = jnp.array([1.0, 1.5, 0.5, 1.5, 0.5])
    advantage = jnp.array([2.0, 2.0, 2.0, -2.0, -2.0])
    found = clipped_surrogate(jnp.log(ratio) - 0.7, jnp.full(5, -0.7), advantage, 0.2)
    np.testing.assert_allclose(found, [-2.0, -2.4, -1.0, 3.0, 1.6], rtol=1e-5)
    numbers = np.random.default_rng(0)
    log_prob, behaviour, advantage = (jnp.asarray(numbers.normal(size=50), jnp.float32) for _ in range(3))
    expected = rlax.clipped_surrogate_pg_loss(jnp.exp(log_prob - behaviour), advantage, 0.3)
    found = clipped_surrogate(log_prob, behaviour, advantage, 0.3)
    np.testing.assert_allclose(found.mean(), expected, rtol=1e-5)


def test_huber_is_that_of_rlax_and_entropy_that_of_scipy():
    errors = jnp.linspace(-7, 7, 29)
    np.testing.assert_allclose(huber(errors, 2.0), rlax.huber_loss(errors, 2.0), rtol=1e-6)
    np.testing.assert_allclose(huber(jnp.array([1.0, -3.0]), 2.0), [0.5, 2 * 3 - 2])
    logits = jnp.asarray(np.random.default_rng(1).normal(size=(6, 5)), jnp.float32)
    everything = jnp.ones((6, 5), bool)
    found = distributions.entropy(distributions.log_policy(logits, everything))
    np.testing.assert_allclose(found, stats.entropy(special.softmax(logits, -1), axis=-1), rtol=1e-5)
    # What is not available has probability 0, adds nothing and gets no gradient.
    mask = jnp.array([True, False, True])
    log_probs = distributions.log_policy(jnp.array([0.0, 9.0, np.log(3.0)]), mask)
    np.testing.assert_allclose(jnp.exp(log_probs), [0.25, 0, 0.75], rtol=1e-6)
    np.testing.assert_allclose(
        distributions.entropy(log_probs), -(0.25 * np.log(0.25) + 0.75 * np.log(0.75)), rtol=1e-6
    )
    slope = jax.grad(lambda logits: distributions.entropy(distributions.log_policy(logits, mask)))(
        jnp.array([0.0, 9.0, 1.0])
    )
    assert np.isfinite(slope).all() and slope[1] == 0 and slope[0] > 0


def test_value_norm_by_hand():
    """Moments with a step of 0.01, their start taken out: after (1, 3) and (5, 5), (0.99 · 2 + 5) / 1.99 is the mean.

    What a padded agent's return would be (100) does not count.
    """
    real = jnp.array([True, True, False])
    norm = follow_returns(no_returns(), jnp.array([1.0, 3.0, 100.0]), real)
    np.testing.assert_allclose([norm.mean, norm.sd], [2.0, 1.0], rtol=1e-4)
    norm = follow_returns(norm, jnp.array([5.0, 5.0, 100.0]), real)
    mean, square = (0.99 * 2 + 5) / 1.99, (0.99 * 5 + 25) / 1.99
    np.testing.assert_allclose([norm.mean, norm.sd], [mean, np.sqrt(square - mean**2)], rtol=1e-4)
    np.testing.assert_allclose(norm.normalise(jnp.array([mean, 5.0])), [0, (5 - mean) / norm.sd], atol=1e-4)
    np.testing.assert_allclose(norm.denormalise(norm.normalise(jnp.array([-3.0]))), [-3.0], rtol=1e-4)
    assert float(no_returns().normalise(jnp.float32(7.0))) == 7.0


def test_rewards_and_means_are_those_of_real_agents():
    reward, real, no = jnp.array([1.0, 2.0, 30.0]), jnp.array([True, True, False]), jnp.zeros((), bool)
    seen = observe(jnp.zeros((3, 1)), num_actions=2, alive=real)
    steps = Transition(seen, Decision(jnp.zeros(3, jnp.int32)), reward, no, no, no, seen, {})
    np.testing.assert_array_equal(share_reward(steps, True), [1.5, 1.5, 1.5])
    np.testing.assert_array_equal(share_reward(steps, False), reward)
    assert mean_real(reward, real) == 1.5
    come_and_go = steps._replace(left=jnp.zeros(3, bool))
    np.testing.assert_array_equal(share_reward(come_and_go, True), [1.0, 1.0, 1.0], "who is away earns 0")


@pytest.mark.parametrize("size", [1, 2, 7, 1600, 2**16, 2**16 + 1])
def test_a_permutation_holds_every_row_once(size: int):
    found = np.asarray(ppo.permutation(jax.random.key(size), size))
    np.testing.assert_array_equal(np.sort(found), np.arange(size))


def test_all_orders_are_equally_likely():
    """24 orders of four rows, 24,000 drawn: a chi-squared test, which fair ones fail once in ten thousand keys."""
    keys = jax.random.split(jax.random.key(3), 24_000)
    orders = np.asarray(jax.vmap(lambda key: ppo.permutation(key, 4))(keys))
    _, counts = np.unique(orders, axis=0, return_counts=True)
    assert len(counts) == 24
    assert stats.chisquare(counts).pvalue > 1e-4


def test_minibatches_take_every_row_once_an_epoch():
    rows = np.asarray(ppo.minibatches(jax.random.key(0), 12, 5, 3)).reshape(5, 12)
    assert (np.sort(rows, axis=1) == np.arange(12)).all()
    assert len({row.tobytes() for row in rows}) == 5
    assert ppo.minibatches(jax.random.key(0), 2, 1, 9).shape == (2, 1)


# The loss.

THREE = Probe(num_actions=3)
HYPER = ppo.Hyper(
    **dict.fromkeys(ppo.Hyper._fields, 0.0) | {"clip_eps": 0.2, "vf_coef": 0.7}  # the rest is not the loss's
)


def test_the_loss_and_its_gradient_are_the_printed_ones():
    """Head weights of 0: the biases are every agent's logits and value. Against NumPy, and central differences."""
    config = NetworkConfig(width=4, depth=1)
    network = drawn(
        lambda key: ppo.Network(ppo.AgentNetwork(THREE, config, 3, key), ppo.Critic(THREE, config, "local", key))
    )
    logits, value = np.array([0.3, -0.5, 0.9]), 0.4
    leaves = lambda net: (net.actor.head.weight, net.actor.head.bias, net.critic.head.weight, net.critic.head.bias)  # noqa: E731
    plain = [jnp.zeros((3, 4)), jnp.asarray(logits, jnp.float32), jnp.zeros((1, 4)), jnp.full(1, value)]
    network = eqx.tree_at(leaves, network, plain)

    numbers, rows = np.random.default_rng(2), 4
    observation = jax.tree.map(
        lambda leaf: jnp.broadcast_to(leaf, (1, rows, *leaf.shape)), THREE.reset(jax.random.key(0))[1]
    )
    real = np.array([[True, True], [True, False], [True, True], [False, True]])
    mask = np.ones((rows, 2, 3), bool)
    mask[2, :, 1] = False
    action = np.array([[0, 1], [2, 0], [0, 2], [1, 1]])
    behaviour = np.log(numbers.uniform(0.15, 0.6, (rows, 2)))
    advantage, target = numbers.normal(size=(rows, 2)), 2 * numbers.normal(size=(rows, 2))
    sample = ppo.Sample(
        observation=observation._replace(agent_mask=jnp.asarray(real)[None], action_mask=jnp.asarray(mask)[None]),
        first=jnp.zeros((1, rows), bool),
        action=jnp.asarray(action, jnp.int32)[None],
        key=jax.random.split(jax.random.key(0), rows)[None],
        log_prob=jnp.asarray(behaviour, jnp.float32)[None],
        advantage=jnp.asarray(advantage, jnp.float32)[None],
        target=jnp.asarray(target, jnp.float32)[None],
    )

    def printed(logits: np.ndarray, value: float) -> tuple[float, dict[str, float]]:
        weights = np.where(mask, np.exp(logits), 0.0)
        chances = weights / weights.sum(-1, keepdims=True)
        chosen = np.take_along_axis(chances, action[..., None], -1)[..., 0]
        ratio, error = chosen / np.exp(behaviour), value - target
        gain = np.minimum(ratio * advantage, np.clip(ratio, 0.8, 1.2) * advantage)
        linear = np.abs(error) > 1.5
        parts = {
            "loss_policy": -gain,
            "loss_critic": np.where(linear, 1.5 * (np.abs(error) - 0.75), 0.5 * error**2),
            "entropy": -(chances * np.log(np.where(mask, chances, 1.0))).sum(-1),
            "ratio_clipped": np.abs(ratio - 1) > 0.2,
            "kl": behaviour - np.log(chosen),
        }
        means = {name: values[real].mean() for name, values in parts.items()}
        return means["loss_policy"] + 0.7 * means["loss_critic"] - 0.03 * means["entropy"], means

    slope = jax.jit(jax.value_and_grad(ppo.loss, has_aux=True), static_argnums=(5, 6))
    nothing = ppo.PpoMemory((), ())
    family = distributions.categorical(choices(THREE))
    (total, parts), gradient = slope(network, sample, nothing, HYPER, jnp.float32(0.03), 1.5, family)
    expected, means = printed(logits, value)
    np.testing.assert_allclose(total, expected, rtol=1e-5)
    for name, mean in means.items():
        np.testing.assert_allclose(parts[name], mean, rtol=1e-4, atol=1e-6, err_msg=name)
    assert 0 < means["ratio_clipped"] < 1
    step = 1e-6
    for action_index in range(3):
        ahead, behind = (printed(logits + sign * step * np.eye(3)[action_index], value)[0] for sign in (1, -1))
        np.testing.assert_allclose(
            gradient.actor.head.bias[action_index], (ahead - behind) / (2 * step), rtol=1e-3, atol=1e-5
        )
    ahead, behind = (printed(logits, value + sign * step)[0] for sign in (1, -1))
    np.testing.assert_allclose(gradient.critic.head.bias[0], (ahead - behind) / (2 * step), rtol=1e-3)


# What an update learns from.


class Seen(NamedTuple):
    sample: ppo.Sample
    memory: ppo.PpoMemory


@pytest.fixture
def seen(monkeypatch: pytest.MonkeyPatch) -> list[Seen]:
    """The minibatches of updates that are traced from now on, in order; their loss is the critic's last bias."""
    collected: list[Seen] = []

    def stand_in(network: ppo.Network, sample: ppo.Sample, memory: ppo.PpoMemory, *rest: Any):
        jax.debug.callback(
            lambda *given: collected.append(Seen(*given)), sample._replace(key=()), memory, ordered=True
        )
        return network.critic.head.bias.sum(), {"loss": jnp.zeros(())}

    monkeypatch.setattr(ppo, "loss", stand_in)
    return collected


def by_hand(num_agents: int = 2) -> Rollout:
    """Three steps of two environments; an action, and the first feature, say when, where and whose they are."""
    env = Spread(num_agents, 1)
    time, place, agent = np.ix_(range(3), range(2), range(num_agents))
    names = jnp.asarray(100 * time + 10 * place + agent, jnp.int32)
    _, observation = env.reset(jax.random.key(0))
    observation = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (3, 2, *leaf.shape)), observation)
    observation = observation._replace(features=observation.features.at[..., 0].set(names))
    reward = jnp.asarray([[[1.0, 3.0], [0.0, 0.0]], [[4.0, 4.0], [2.0, 6.0]], [[-2.0, 0.0], [1.0, 1.0]]])
    extras = {
        "value": jnp.asarray([[[1.0, 2.0], [0.5, 0.5]], [[0.0, 1.0], [0.0, 0.0]], [[2.0, 2.0], [1.0, 3.0]]]),
        "choice": names,
        "log_prob": jnp.zeros((3, 2, num_agents)),
        "key": jax.random.split(jax.random.key(0), (3, 2)),
    }
    return Rollout(
        Transition(
            observation=observation,
            decision=Decision(names, extras=extras),
            reward=reward,
            terminated=jnp.array([[False, False], [True, False], [False, False]]),
            truncated=jnp.array([[False, False], [False, True], [False, False]]),
            first=jnp.array([[True, True], [False, False], [True, True]]),
            next_observation=observation,
            info={},
        ),
        (),
    )


@pytest.mark.parametrize("reward", ["team", "own"])
def test_targets_minibatches_and_step_sizes(reward: Any, seen: list[Seen]):
    """γ = λ = ½. Environment 0 terminates at its second step, environment 1 is cut off there. V(s') = 8 where it is asked for."""
    env, given = Spread(2, 1), by_hand()
    config = IppoConfig(
        network=NetworkConfig(width=4, depth=1),
        gamma=0.5,
        gae_lambda=0.5,
        update_epochs=2,
        num_minibatches=3,
        value_norm=False,
        reward=reward,
        learning_rate=0.01,
        learning_rate_end=0.002,
    )
    algorithm = ippo.make(config, env, TrainingConfig(env_steps=6 * 4, num_envs=2, num_steps=3))
    learner, update = drawn_learner(algorithm), jax.jit(algorithm.update)
    network = eqx.tree_at(
        lambda net: (net.critic.head.weight, net.critic.head.bias),
        learner.network,
        (jnp.zeros((1, 4)), jnp.full(1, 8.0)),
    )
    after, metrics = update(learner._replace(network=network), given, jax.random.key(1))
    jax.effects_barrier()

    earned = np.asarray(given.transitions.reward)
    if reward == "team":
        earned = np.broadcast_to(earned.mean(-1, keepdims=True), earned.shape)
    value = np.asarray(given.transitions.decision.extras["value"])
    nothing, asked = np.zeros(2), np.full(2, 8.0)
    following = np.array([[value[1, 0], value[1, 1]], [nothing, asked], [asked, asked]])
    delta = earned + 0.5 * following - value
    advantage = np.stack([delta[0] + 0.25 * delta[1], delta[1], delta[2]])

    assert len(seen) == 2 * 3
    for epoch in (seen[:3], seen[3:]):
        found: dict[tuple[int, int], int] = {}
        for part, memory in epoch:
            assert memory == ppo.PpoMemory((), ()) and part.action.shape == (1, 2, 2)
            for row in range(2):
                name = int(part.action[0, row, 0])
                time, place = name // 100, name // 10 % 10
                found[time, place] = name
                # A step's agents stay together, and everything about it does.
                np.testing.assert_array_equal(part.action[0, row], [name, name + 1])
                np.testing.assert_array_equal(part.observation.features[0, row, :, 0], [name, name + 1])
                np.testing.assert_allclose(part.target[0, row], (advantage + value)[time, place], rtol=1e-5)
                standard = (advantage - advantage.mean()) / advantage.std()
                np.testing.assert_allclose(part.advantage[0, row], standard[time, place], rtol=1e-4, atol=1e-5)
        assert len(found) == 6
    np.testing.assert_allclose(metrics["value_error"], np.abs(advantage).mean(), rtol=1e-5)

    # Six steps of Adam along a constant gradient; the step size falls over the planned four updates, and stays.
    moved = float(after.network.critic.head.bias[0])
    np.testing.assert_allclose(moved, 8.0 - 6 * 0.01, rtol=1e-5)
    np.testing.assert_allclose(metrics["learning_rate"], 0.01, rtol=1e-6)
    late = update(after._replace(updates=jnp.int32(2)), given, jax.random.key(1))[1]
    np.testing.assert_allclose(late["learning_rate"], 0.006, rtol=1e-5)
    assert int(after.updates) == 1


# The policy that acted is the one that is learned from.


@dataclass(frozen=True)
class Slots(Spread):
    """The same shapes; the first agent's life ends with the second step of every episode."""

    def step(self, state: Any, action: Any, key: Any, params: Any = None) -> Any:
        state, after = super().step(state, action, key, params)
        return state, after._replace(left=(state.clock == 2) & (jnp.arange(self.num_agents) == 0))


class Case(NamedTuple):
    communication: str
    recurrent: bool = False
    augment: bool = False
    exploration: str = "none"
    lives: bool = False
    continuous: bool = False


CASES = {
    "discrete symbols": Case("discrete"),
    "commnet, recurrent": Case("commnet", recurrent=True),
    "dial, recurrent, turned": Case("dial", recurrent=True, augment=True),
    "discrete symbols, explored linearly": Case("discrete", exploration="linear"),
    "discrete symbols, explored as ever": Case("discrete", exploration="fixed"),
    "discrete symbols, explored by progress": Case("discrete", exploration="adaptive"),
    "commnet, recurrent, explored by progress": Case("commnet", recurrent=True, exploration="adaptive"),
    "commnet, recurrent, lives end inside the episode": Case("commnet", recurrent=True, lives=True),
    "dial, recurrent, lives end inside the episode": Case("dial", recurrent=True, lives=True),
    "discrete symbols, lives end inside the episode": Case("discrete", lives=True),
    "discrete symbols, continuous actions": Case("discrete", continuous=True),
}
KEPT = (
    "dial, recurrent, turned",
    "commnet, recurrent, explored by progress",
    "discrete symbols, lives end inside the episode",
    "discrete symbols, continuous actions",
)
"""Each kind of message, memory and life is in one of them; each way to explore in one of them or of the slow ones."""
SLOW = ("discrete symbols, explored linearly", "commnet, recurrent, lives end inside the episode")


@pytest.mark.parametrize("name", soaked(CASES, *KEPT, slow=SLOW))
def test_the_first_ratio_is_one(name: str, monkeypatch: pytest.MonkeyPatch):
    """In a rollout that begins mid-episode, with an episode's end in it.

    And targets bootstrap from the critic's value, with its memory, of what followed: λ = 0 and γ = 1 show it. Nothing
    follows a life's end.
    """
    case = CASES[name]
    augment, kind = case.augment, Slots if case.lives else Spread
    env = kind(3, 2, max_cycles=3, continuous_actions=case.continuous)
    config = MappoConfig(
        network=NetworkConfig(width=8, depth=1, recurrent=case.recurrent, communication=case.communication),
        augment=augment,
        exploration=case.exploration,
        epsilon=0.8,
        epsilon_end=0.4,
        temperature=2.0,
        temperature_end=0.5,
        exploration_steps=64,
        greedy_share=0.5,
        update_epochs=1,
        num_minibatches=1,
        clip_eps=1e-4,
        gamma=1.0,
        gae_lambda=0.0,
        value_norm=False,
        reward="own",
    )
    collected: list[Seen] = []
    original = ppo.loss

    def spy(network: ppo.Network, sample: ppo.Sample, memory: ppo.PpoMemory, *rest: Any):
        jax.debug.callback(lambda *given: collected.append(Seen(*given)), sample._replace(key=()), memory)
        return original(network, sample, memory, *rest)

    monkeypatch.setattr(ppo, "loss", spy)

    algorithm = mappo.make(config, env, TrainingConfig(env_steps=100, num_envs=4, num_steps=4), "coverage_0.2")
    memory, params = algorithm.initial_memory(3), env.default_params()
    # Half of the way down: after two updates of 16 steps.
    learner, other = (drawn_learner(algorithm, seed)._replace(updates=jnp.int32(2)) for seed in (0, 1))

    @jax.jit
    def collect(learner: Any) -> Any:
        """From the second step of episodes on."""
        carry = rollout.start(env, params, memory, jax.random.key(2), 4)
        clock = carry.env_state.clock + 1
        under_way = carry._replace(
            env_state=carry.env_state._replace(clock=clock),
            memory=jax.tree.map(lambda leaf: leaf + 0.3 if leaf.ndim > 1 else leaf, carry.memory),
            first=carry.first & False,
        )
        policy = algorithm.policy(learner, True)
        return rollout.collect(env, policy, memory, params, under_way, jax.random.key(3), 4)[1]

    experience = collect(learner)
    assert not experience.transitions.first[0].any() and experience.transitions.truncated.sum() == 4
    levels = {"linear": [0.6], "adaptive": [0.0, 0.8]}.get(case.exploration)
    if levels is not None:
        found = np.unique(experience.transitions.decision.extras["epsilon"])
        np.testing.assert_allclose(found, levels, rtol=1e-6)
    update = jax.jit(algorithm.update)
    _, metrics = update(learner, experience, jax.random.key(5))
    jax.effects_barrier()
    steps, (sample, remembered) = experience.transitions, collected[0]
    assert augment or (metrics["ratio_clipped"] == 0.0 and abs(metrics["kl"]) < 1e-6)
    _, metrics = update(other, experience, jax.random.key(5))
    assert metrics["ratio_clipped"] > 0.9

    left = np.zeros((4, 4, 3), bool) if steps.left is None else np.asarray(steps.left)
    assert left.any((1, 2)).tolist() == [case.lives, False, False, case.lives], "one life goes on with the rollout"
    expected = steps.reward[:-1] + np.where(left[:-1], 0.0, steps.decision.extras["value"][1:])
    going_on = ~np.asarray(steps.truncated)[:-1]
    if not case.recurrent:  # every step is a segment
        rows = [row.tobytes() for row in np.asarray(sample.observation.features)[0]]
        target = dict(zip(rows, np.asarray(sample.target)[0], strict=True))
        for t, place in np.argwhere(going_on):
            key = np.asarray(steps.observation.features)[t, place].tobytes()
            np.testing.assert_allclose(target[key], expected[t, place], atol=1e-4)
        return
    turned: list[bool] = []
    carried = experience.first_memory._replace(exploration=())  # of exploration nothing is learned
    for column in range(4):  # an environment is a segment, and has its own memory
        chosen_with = np.asarray(sample.log_prob)[:, column]  # stays, also where the world is turned
        (place,) = (e for e in range(4) if np.array_equal(steps.decision.extras["log_prob"][:, e], chosen_with))
        features = np.asarray(sample.observation.features)[:, column]
        turned.append(not np.array_equal(steps.observation.features[:, place], features))
        for found, leaf in zip(jax.tree.leaves(remembered), jax.tree.leaves(carried), strict=True):
            np.testing.assert_array_equal(
                found[column], (not augment) * leaf[place], "a turned world is not remembered"
            )
        on = going_on[:, place]
        np.testing.assert_allclose(sample.target[:-1, column][on], expected[:, place][on], atol=1e-4)
        gone = left[-1, place]
        np.testing.assert_allclose(sample.target[-1, column][gone], steps.reward[-1, place][gone], atol=1e-4)
    assert any(turned) == augment
