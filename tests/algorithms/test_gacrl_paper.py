"""Equations (2) to (20) as a whole: the loss, its gradient, how agents act, one update.

The oracle is the paper's text in NumPy: loops over rows and agents, float64, no line shared with the library.
"""

import dataclasses
from functools import partial
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gacrl.algorithms import gacrl_paper, gacrl_paper_networks, replay
from gacrl.algorithms.gacrl_paper_exploration import Coverage
from gacrl.config import presets
from gacrl.config.algorithms import GacrlPaperConfig
from gacrl.config.run import CurriculumConfig, TrainingConfig
from gacrl.errors import ConfigError
from gacrl.networks.layers import num_parameters
from gacrl.tasks.spread.environment import Spread
from gacrl.tasks.spread.task import TASK
from gacrl.training import curriculum
from gacrl.types import Arrives, Rollout, Transition

N, B = 3, 16
CONFIG = dataclasses.replace(GacrlPaperConfig(), batch_size=B, replay_capacity=3)
ALTERNATIVE = dataclasses.replace(CONFIG, messages="straight_through", kl_reduction="mean")
ENV = Spread(N, 3, max_cycles=75, reward="paper")
ALGORITHM = gacrl_paper.make(CONFIG, ENV)


# The paper's text.


def paper_weights(network):
    """The weights (or their gradients) under their printed names; those without a name get one."""
    layers = {
        "encoder 1": network.encoder.hidden[0],
        "encoder 2": network.encoder.hidden[1],
        "1": network.message_model.w1,
        "2": network.message_model.w2,
        "3": network.message_model.w3,
        "4": network.message_model.w4,
        "5": network.policy.w5,
        "policy": network.policy.hidden,
        "6": network.policy.w6,
        "7": network.critic.w7,
        "critic": network.critic.hidden,
        "8": network.critic.w8,
    }
    weights = {}
    for name, layer in layers.items():
        weights[f"W{name}"], weights[f"b{name}"] = layer.weight, layer.bias
    half = network.encoder.heads.bias.shape[0] // 2
    weights["W mean"], weights["W variance"] = np.split(np.asarray(network.encoder.heads.weight), [half])
    weights["b mean"], weights["b variance"] = np.split(np.asarray(network.encoder.heads.bias), [half])
    return {name: np.asarray(value, np.float64) for name, value in weights.items()}


def relu(x):
    return np.maximum(x, 0.0)


def softmax(x):
    exponentials = np.exp(x - x.max())
    return exponentials / exponentials.sum()


def one_hot(symbol_scores):
    return np.eye(len(symbol_scores))[symbol_scores.argmax()]


def paper_forward(w, o, A, tau=None, noise=None, gumbel=None, shift=None):
    """Equations (2) to (11) for the agents of one environment.

    Without noise: mean latent, most likely symbol. `shift` is added to the soft messages as a constant: with
    one-hot minus soft in it, derivatives are those of straight-through messages.
    """
    agents = range(len(o))
    mean, log_variance, z, h1, m, symbols, messages, pi = [], [], [], [], [], [], [], []
    for i in agents:
        hidden = relu(w["Wencoder 1"] @ o[i] + w["bencoder 1"])
        hidden = relu(w["Wencoder 2"] @ hidden + w["bencoder 2"])
        mean.append(w["W mean"] @ hidden + w["b mean"])  # (2)
        log_variance.append(w["W variance"] @ hidden + w["b variance"])
        z.append(mean[i] if noise is None else mean[i] + noise[i] * np.exp(log_variance[i] / 2))  # (3)
        h1.append(relu(w["W1"] @ z[i] + w["b1"]))  # (5)
        m.append(w["W2"] @ h1[i] + w["b2"])  # (6)
    for i in agents:
        m_sum = np.zeros_like(m[i])
        for j in agents:
            m_sum = m_sum + A[i][j] * m[j]  # (7)
        h2 = relu(w["W3"] @ np.concatenate([h1[i], m_sum]) + w["b3"])  # (8)
        symbols.append(w["W4"] @ h2 + w["b4"])
        if gumbel is None:
            messages.append(one_hot(symbols[i]))
        else:
            messages.append(softmax((symbols[i] + gumbel[i]) / tau))  # (9)
            if shift is not None:
                messages[i] = messages[i] + shift[i]
    for i in agents:
        x = np.concatenate([o[i], *[messages[j] for j in agents if j != i], z[i]])  # (10)
        hidden = relu(w["Wpolicy"] @ relu(w["W5"] @ x + w["b5"]) + w["bpolicy"])
        pi.append(softmax(w["W6"] @ hidden + w["b6"]))  # (11)
    return SimpleNamespace(
        pi=np.array(pi),
        sent=np.array(m),
        message=np.array(messages),
        mean=np.array(mean),
        log_variance=np.array(log_variance),
    )


def paper_value(w, o):
    hidden = relu(w["Wcritic"] @ relu(w["W7"] @ np.concatenate(list(o)) + w["b7"]) + w["bcritic"])
    return (w["W8"] @ hidden + w["b8"])[0]  # (12)


def paper_loss(w, rows, tau, kl_mean=False, shifts=None):
    """Equations (17) to (20): B replayed rows and, last, the current one."""
    batch_size = len(rows.r) - 1
    policy = critic = kl = 0.0
    for b in range(batch_size + 1):
        shift = None if shifts is None else shifts[b]
        out = paper_forward(w, rows.o[b], rows.A[b], tau, rows.noise[b], rows.gumbel[b], shift)
        weighted = -sum(np.log(out.pi[i, rows.a[b, i]]) for i in range(N)) / N * rows.r[b]
        if b == batch_size:
            policy += weighted  # the second line of (18)
            break
        policy += weighted / batch_size  # the first line of (18)
        critic += (paper_value(w, rows.o[b]) - rows.r[b]) ** 2 / batch_size  # (19)
        inside = 1 + out.log_variance - out.mean**2 - np.exp(out.log_variance)
        kl += -inside.sum() / N / batch_size / (out.mean.shape[1] if kl_mean else 1)  # (20)
    return policy + 0.1 * critic + 0.05 * kl, (policy, critic, kl)


def paper_adam(w, gradients, moments, step, learning_rate):
    """Kingma and Ba 2015, algorithm 1, with its default constants."""
    new = {}
    for name, g in gradients.items():
        m, v = moments.get(name, (0.0, 0.0))
        m, v = 0.9 * m + 0.1 * g, 0.999 * v + 0.001 * g**2
        moments[name] = m, v
        m_hat, v_hat = m / (1 - 0.9**step), v / (1 - 0.999**step)
        new[name] = w[name] - learning_rate * m_hat / (np.sqrt(v_hat) + 1e-8)
    return new


# Fixed weights, batch and noise.


def fixed_learner(seed=0):
    """A learner at its start whose weights come from NumPy, of the size that initial ones have."""
    rng = np.random.default_rng(seed)
    shapes = jax.eval_shape(ALGORITHM.init, jax.random.key(0), ALGORITHM.hyper)
    learner = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
    network = jax.tree.map(
        lambda leaf: jnp.asarray(rng.uniform(-1, 1, leaf.shape) * leaf.shape[-1] ** -0.5, jnp.float32),
        shapes.network,
    )
    return learner._replace(network=network, hyper=jax.tree.map(jnp.float32, ALGORITHM.hyper))


def fixed_rows(seed=1):
    """B + 1 rows; graphs that are not symmetric show which way messages run."""
    rng = np.random.default_rng(seed)
    return SimpleNamespace(
        o=rng.normal(size=(B + 1, N, 18)),
        A=(rng.uniform(size=(B + 1, N, N)) < 0.5) & ~np.eye(N, dtype=bool),
        a=rng.integers(0, 5, (B + 1, N)),
        r=rng.uniform(-5, 15, B + 1),
        noise=rng.normal(size=(B + 1, N, 16)),
        gumbel=rng.gumbel(size=(B + 1, N, 8)),
    )


def to_library(rows):
    experience = gacrl_paper.Experience(
        jnp.asarray(rows.o, jnp.float32),
        jnp.asarray(rows.A),
        jnp.asarray(rows.a, jnp.int32),
        jnp.asarray(rows.r, jnp.float32),
        Arrives(),
    )
    noise = gacrl_paper.Noise(
        jnp.asarray(rows.noise.transpose(2, 1, 0), jnp.float32),
        jnp.asarray(rows.gumbel.transpose(2, 1, 0), jnp.float32),
    )
    return experience, noise


GRADIENT = jax.jit(jax.value_and_grad(gacrl_paper.loss, has_aux=True), static_argnums=5)
ACT = jax.jit(
    lambda learner, observation, keys: jax.vmap(
        lambda key: ALGORITHM.policy(learner, True)((), observation, key)[0]
    )(keys)
)
KEYS = jax.random.split(jax.random.key(7), 4096)


def observe(seed=2):
    """Velocities, positions, offsets drawn at random; agents 0 and 1 hear each other, 2 is out of reach."""
    features = np.random.default_rng(seed).normal(size=(N, 18)).astype(np.float32)
    positions = np.array([[0.0, 0.0], [1.0, 0.5], [-1.0, 2.0]], np.float32)
    _, observation = jax.eval_shape(ENV.reset, jax.random.key(0))
    return observation._replace(
        features=jnp.asarray(features),
        positions=jnp.asarray(positions),
        agent_mask=jnp.ones(3, bool),
        landmark_mask=jnp.ones(3, bool),
        action_mask=jnp.ones((N, 5), bool),
        state=jnp.zeros(observation.state.shape),
    )


REACH = np.array([[0, 1, 0], [1, 0, 0], [0, 0, 0]])


# Architecture.


def test_weights_have_the_printed_shapes():
    network = jax.eval_shape(ALGORITHM.init, jax.random.key(0), ALGORITHM.hyper).network
    shapes = {name: tuple(layer.weight.shape) for name, layer in _layers(network).items()}
    assert shapes == {
        "W1": (32, 16),
        "W2": (8, 32),
        "W3": (32, 32 + 8),
        "W4": (8, 32),
        "W5": (64, 18 + 8 * (N - 1) + 16),
        "W6": (5, 32),
        "W7": (128, 18 * N),
        "W8": (1, 64),
    }
    # Encoder 18-64-32 and two heads of 16; the two hidden layers that W6 and W8 need: 64-32 and 128-64.
    encoder = (64 * 18 + 64) + (32 * 64 + 32) + 2 * (16 * 32 + 16)
    messages = (32 * 16 + 32) + (8 * 32 + 8) + (32 * 40 + 32) + (8 * 32 + 8)
    policy = (64 * 50 + 64) + (32 * 64 + 32) + (5 * 32 + 5)
    critic = (128 * 54 + 128) + (64 * 128 + 64) + (64 + 1)
    assert num_parameters(network) == encoder + messages + policy + critic == 27_606


def _layers(network):
    messages, policy, critic = network.message_model, network.policy, network.critic
    return {
        "W1": messages.w1,
        "W2": messages.w2,
        "W3": messages.w3,
        "W4": messages.w4,
        "W5": policy.w5,
        "W6": policy.w6,
        "W7": critic.w7,
        "W8": critic.w8,
    }


def test_preset_is_table_one():
    preset = presets.preset("paper")
    algorithm = preset.algorithm
    assert (algorithm.learning_rate, algorithm.learning_rate_end) == (0.0005, 0.0001)
    assert (algorithm.epsilon, algorithm.epsilon_end) == (0.3, 0.1)
    assert (algorithm.temperature, algorithm.temperature_end) == (2.0, 0.7)
    assert (algorithm.epsilon_bonus, algorithm.temperature_bonus) == (0.2, 0.5)
    assert (algorithm.critic_weight, algorithm.kl_weight, algorithm.batch_size) == (0.1, 0.05, 64)
    assert (algorithm.encoder_hidden, algorithm.message_hidden) == ((64, 32), 32)
    assert (preset.env.coverage_threshold, preset.env.coverage_threshold_end) == (0.5, 0.2)
    assert (preset.env.local_ratio, preset.env.local_ratio_end) == (0.5, 0.1)
    assert algorithm.schedule_episodes == preset.curriculum.episodes == 1500
    assert preset.num_updates == preset.training.env_steps == 1500 * preset.env.max_cycles == 1500 * 75
    assert (preset.env.reward, preset.env.reset_on_collision) == ("paper", "off")


def test_others_stand_in_ascending_order():
    """Entry [symbol, receiver, sender] reads receiver, sender and symbol off as digits."""
    received = jnp.asarray(np.fromfunction(lambda v, i, j: 100 * i + 10 * j + v, (2, 4, 4)))
    side_by_side = gacrl_paper_networks.others_side_by_side(received)
    np.testing.assert_array_equal(
        side_by_side.T,
        [
            [10, 11, 20, 21, 30, 31],
            [100, 101, 120, 121, 130, 131],
            [200, 201, 210, 211, 230, 231],
            [300, 301, 310, 311, 320, 321],
        ],
    )
    assert gacrl_paper_networks.others_side_by_side(jnp.zeros((2, 1, 1))).shape == (0, 1)


# The loss.


@pytest.mark.parametrize("config", [CONFIG, ALTERNATIVE], ids=["as printed", "straight-through, mean KL"])
def test_loss_and_gradient_are_the_papers(config):
    network, rows, tau = fixed_learner().network, fixed_rows(), 1.3
    experience, noise = to_library(rows)
    (total, parts), gradient = GRADIENT(network, ALGORITHM.hyper, experience, jnp.float32(tau), noise, config)

    w, shifts = paper_weights(network), None
    if config is ALTERNATIVE:
        soft = [
            paper_forward(w, rows.o[b], rows.A[b], tau, rows.noise[b], rows.gumbel[b]).message
            for b in range(B + 1)
        ]
        shifts = [np.array([one_hot(m) - m for m in messages]) for messages in soft]

    def loss(weights):
        return paper_loss(weights, rows, tau, config is ALTERNATIVE, shifts)

    expected, expected_parts = loss(w)
    np.testing.assert_allclose(total, expected, rtol=1e-5)
    np.testing.assert_allclose(
        [parts["loss_policy"], parts["loss_critic"], parts["loss_kl"]], expected_parts, rtol=1e-5
    )

    g = paper_weights(gradient)
    assert g.keys() == w.keys()
    assert all(np.linalg.norm(values) > 1e-3 for values in g.values())

    def check(direction):
        """The derivative along a direction in the space of all weights, by central differences."""
        step = 1e-7  # short enough that no ReLU is switched on the way
        ahead, behind = (
            loss({k: v + sign * step * direction.get(k, 0.0) for k, v in w.items()})[0] for sign in (1, -1)
        )
        analytic = sum((g[name] * along).sum() for name, along in direction.items())
        scale = np.sqrt(sum((g[name] ** 2).sum() * (along**2).sum() for name, along in direction.items()))
        assert abs(analytic - (ahead - behind) / (2 * step)) < 1e-4 * scale, list(direction)

    rng = np.random.default_rng(3)
    for _ in range(3):
        check({name: rng.normal(size=values.shape) for name, values in w.items()})
    for name, values in w.items():
        check({name: rng.normal(size=values.shape)})
        for index in {int(np.abs(g[name]).argmax()), int(rng.integers(values.size))}:
            check({name: np.eye(1, values.size, index).reshape(values.shape)})


def test_policy_loss_by_hand():
    """(18), B = N = 2. Replayed: the mean of -(-2 - 4)/2 · 2 = 6 and -(-1 - 1)/2 · -3 = -3. Now: 0.5 · 4."""
    log_pi = jnp.array([[-2.0, -1.0, -0.25], [-4.0, -1.0, -0.75]])
    reward = jnp.array([2.0, -3.0, 4.0])
    np.testing.assert_allclose(gacrl_paper.policy_loss(log_pi, reward, 2), (6 - 3) / 2 + 2, rtol=1e-6)


def test_critic_and_kl_loss_by_hand():
    # (19): the mean of (1 - 3)² and (2 - 2.5)².
    critic = gacrl_paper.critic_loss(jnp.array([1.0, 2.0]), jnp.array([3.0, 2.5]))
    np.testing.assert_allclose(critic, (4 + 0.25) / 2, rtol=1e-6)
    # (20), two latent dimensions of two agents in one row: N(0, 1) costs nothing, mean 1 costs 1, mean 2
    # costs 4, variance 4 costs 4 - 1 - ln 4. No factor ½.
    mean = jnp.array([[[0.0], [1.0]], [[2.0], [0.0]]])
    log_variance = jnp.log(jnp.array([[[1.0], [1.0]], [[1.0], [4.0]]]))
    total = (0 + 4) + (1 + 3 - np.log(4))
    np.testing.assert_allclose(gacrl_paper.kl_loss(mean, log_variance), total / 2, rtol=1e-6)
    np.testing.assert_allclose(gacrl_paper.kl_loss(mean, log_variance, True), total / 4, rtol=1e-6)


# Acting.


def test_behaviour_is_the_mixture_and_log_pi_is_not():
    pi = np.array([0.5, 0.25, 0.125, 0.0625, 0.0625])
    logits = jnp.log(jnp.asarray(pi, jnp.float32)) + 3.0
    np.testing.assert_allclose(
        gacrl_paper.behaviour_probabilities(logits, jnp.float32(0.4)),
        [0.38, 0.23, 0.155, 0.1175, 0.1175],  # 0.6 π + 0.08
        rtol=1e-6,
    )
    taken = gacrl_paper.log_probability(jnp.stack([logits, logits], axis=1), jnp.array([1, 4]))
    np.testing.assert_allclose(taken, np.log([0.25, 0.0625]), rtol=1e-6)


def test_unavailable_actions_are_never_explored():
    logits = jnp.array([0.0, -jnp.inf, 0.0, -jnp.inf, 0.0])
    np.testing.assert_allclose(
        gacrl_paper.behaviour_probabilities(logits, jnp.float32(0.3)),
        np.array([1, 0, 1, 0, 1]) / 3,
        rtol=1e-6,
    )


def test_acting_is_the_papers_forward_pass():
    """At c = 0.5 the temperature of episode 300 is 2 - 300 · 1.3/1500 + 0.25 = 1.99."""
    learner, observation = fixed_learner(), observe()
    learner = learner._replace(coverage=_coverage(total=1.5, steps=3, episode=300))
    decision = ACT(learner, observation, KEYS)

    w, o = paper_weights(learner.network), np.asarray(observation.features, np.float64)
    for k in (0, 1):
        noise = jax.tree.map(lambda leaf: np.asarray(leaf[k], np.float64), decision.extras["noise"])  # noqa: B023
        out = paper_forward(w, o, REACH, 1.99, noise.latent.T, noise.gumbel.T)
        np.testing.assert_allclose(decision.messages[k], [out.sent, out.message], rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(decision.extras["value"][0], paper_value(w, o), rtol=1e-5)
    np.testing.assert_array_equal(decision.adjacency[0], REACH)

    # The noise is what (3) and (9) say: standard normal, and Gumbel with mean 0.5772 and variance π²/6.
    latent, gumbel = decision.extras["noise"]
    assert abs(latent.mean()) < 0.01 and abs(latent.var() - 1) < 0.02
    assert abs(gumbel.mean() - np.euler_gamma) < 0.02 and abs(gumbel.var() - np.pi**2 / 6) < 0.05


def test_actions_are_as_frequent_as_the_mixture_says():
    """With W6 = 0 the policy is softmax(b6) in every state. ε = 0.3 + 0.2 · (1 - 0.5) = 0.4."""
    pi = np.array([0.5, 0.25, 0.125, 0.0625, 0.0625])
    learner = fixed_learner()
    learner = learner._replace(
        coverage=_coverage(total=0.5, steps=1, episode=0),
        network=_with_constant_policy(learner.network, np.log(pi)),
    )
    action = np.asarray(ACT(learner, observe(), KEYS).action)

    def chi_square(observed, probability):
        expected = probability * len(KEYS)
        return ((observed - expected) ** 2 / expected).sum()

    for agent in range(N):
        observed = np.bincount(action[:, agent], minlength=5)
        assert chi_square(observed, 0.6 * pi + 0.08) < 23.5  # the 0.9999 quantile at 4 degrees of freedom
        assert chi_square(observed, pi) > 100
    # Agents draw apart: two agree as often as two independent draws from the mixture.
    agree = (action[:, 0] == action[:, 1]).mean()
    assert abs(agree - ((0.6 * pi + 0.08) ** 2).sum()) < 4 * np.sqrt(0.25 / len(KEYS))


def test_greedy_policy_draws_nothing():
    learner, observation = fixed_learner(), observe()
    greedy = jax.jit(jax.vmap(lambda key: ALGORITHM.policy(learner, False)((), observation, key)[0]))
    decision = greedy(KEYS[:2])
    jax.tree.map(lambda leaf: np.testing.assert_array_equal(leaf[0], leaf[1]), decision)
    assert set(decision.extras) == {"value"}

    out = paper_forward(paper_weights(learner.network), np.asarray(observation.features, np.float64), REACH)
    np.testing.assert_array_equal(decision.messages[0, 1], out.message)
    np.testing.assert_array_equal(decision.action[0], out.pi.argmax(1))


@pytest.mark.parametrize(("reading", "followed"), [("episode_so_far", 0.25), ("last_episode", 0.75)])
def test_coverage_signal_switches_what_exploration_follows(monkeypatch, reading, followed):
    algorithm = gacrl_paper.make(dataclasses.replace(CONFIG, coverage_signal=reading), ENV)
    seen = []
    original = gacrl_paper.adaptive_level
    monkeypatch.setattr(
        gacrl_paper, "adaptive_level", lambda *levels: seen.append(levels[-1]) or original(*levels)
    )
    algorithm.policy(fixed_learner()._replace(coverage=_coverage(0.5, 2, 9, last_episode=0.75)), True)
    np.testing.assert_allclose(seen, [followed, followed], rtol=1e-6)


def _coverage(total, steps, episode, last_episode=0.0):
    return Coverage(jnp.float32(total), jnp.int32(steps), jnp.float32(last_episode), jnp.int32(episode))


def _with_constant_policy(network, logits):
    """W6 = 0: action logits are b6 whatever agents see, think and hear."""
    last = network.policy.w6
    layers = (jnp.zeros_like(last.weight), jnp.asarray(logits, jnp.float32))
    leaves, tree = jax.tree.flatten(network)
    replaced = {id(old): new for old, new in zip((last.weight, last.bias), layers, strict=True)}
    return jax.tree.unflatten(tree, [replaced.get(id(leaf), leaf) for leaf in leaves])


# Learning.


@dataclasses.dataclass
class Updates:
    """Three updates in a row, from episode 749 on; the second step ends that episode."""

    learners: list
    steps: list
    metrics: list
    seen: list
    """(rows, temperature, noise) as each update hands them to the loss."""


_, UNPACK = replay.packing(partial(gacrl_paper.no_experience, ALGORITHM.init.args[0]))
COVERAGE = (1 / 3, 2 / 3, 1 / 3)
STORED = np.array([100.0, 101.0, 102.0])


@pytest.fixture(scope="module")
def updates():
    rng = np.random.default_rng(5)
    learner = fixed_learner()._replace(coverage=_coverage(0.0, 0, 749))
    stored = gacrl_paper.Experience(
        jnp.asarray(rng.normal(size=(3, N, 18)), jnp.float32),
        jnp.asarray(rng.uniform(size=(3, N, N)) < 0.5),
        jnp.asarray(rng.integers(0, 5, (3, N)), jnp.int32),
        jnp.asarray(STORED, jnp.float32),
        Arrives(),
    )
    learner = learner._replace(replay=replay.Replay(jax.vmap(replay.pack)(stored), jnp.int32(6)))

    result = Updates([learner], [], [], [])
    original = gacrl_paper.loss

    def spy(network, hyper, rows, temperature, noise, config):
        jax.debug.callback(lambda *given: result.seen.append(given), rows, temperature, noise)
        return original(network, hyper, rows, temperature, noise, config)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(gacrl_paper, "loss", spy)
        update = jax.jit(ALGORITHM.update)
        for t, coverage in enumerate(COVERAGE):
            decision = jax.tree.map(lambda leaf: leaf[t], ACT(learner, observe(t), KEYS))  # noqa: B023
            step = Transition(
                observation=observe(t),
                decision=decision,
                reward=jnp.array([9.0, 12.0, 15.0]) + t,
                terminated=jnp.asarray(False),
                truncated=jnp.asarray(t == 1),
                first=jnp.asarray(t != 1),
                next_observation=observe(t + 1),
                info={"coverage_theta": jnp.float32(coverage)},
            )
            rollout = Rollout(jax.tree.map(lambda leaf: leaf[None, None], step), ())
            learner, metrics = update(learner, rollout, jax.random.key(t))
            jax.effects_barrier()
            result.learners.append(learner)
            result.steps.append(step)
            result.metrics.append(metrics)
    return result


def test_an_update_learns_from_replay_and_the_current_step(updates):
    """A ring of three: the rewards in it after each step, all of them drawn in 16 draws with these keys."""
    assert len(updates.seen) == 3  # one gradient step for each environment step
    for t, kept in enumerate([{101, 102, 12}, {102, 12, 13}, {12, 13, 14}]):
        rows, _, _ = updates.seen[t]
        step = updates.steps[t]
        assert rows.reward.shape == (B + 1,)
        assert set(np.asarray(rows.reward[:-1]).tolist()) == kept  # stored rewards stay as they were
        # The last row is the current step; the team's reward is the mean over agents.
        assert rows.reward[-1] == 12 + t
        np.testing.assert_array_equal(rows.features[-1], step.observation.features)
        np.testing.assert_array_equal(rows.action[-1], step.decision.action)
        np.testing.assert_array_equal(rows.adjacency[-1], step.decision.adjacency)
        # And so are the replayed rows that drew it.
        same = np.asarray(rows.reward[:-1]) == 12 + t
        assert (np.asarray(rows.features[:-1])[same] == np.asarray(step.observation.features)).all()


def test_latents_and_messages_are_drawn_afresh_but_for_the_current_step(updates):
    for t, (_, _, noise) in enumerate(updates.seen):
        acted = updates.steps[t].decision.extras["noise"]
        for drawn, own in zip(noise, acted, strict=True):
            np.testing.assert_array_equal(drawn[..., -1], own)
            columns = np.moveaxis(np.asarray(drawn), -1, 0).reshape(B + 1, -1)
            assert len(np.unique(columns[:, 0])) == B + 1
    first, second = updates.seen[0][2], updates.seen[1][2]
    assert not np.isin(np.asarray(first.latent), np.asarray(second.latent)).any()


def test_levels_follow_coverage_and_episode(updates):
    """c is 0, then 1/3, then 0 again as episode 750 opens; replayed rows get the acting temperature."""
    for t, (episode, c) in enumerate([(749, 0), (749, 1 / 3), (750, 0)]):
        epsilon = 0.3 - episode * 0.2 / 1500 + 0.2 * (1 - c)
        temperature = 2.0 - episode * 1.3 / 1500 + 0.5 * (1 - c)
        np.testing.assert_allclose(updates.metrics[t]["epsilon"], epsilon, rtol=1e-5)
        np.testing.assert_allclose(updates.metrics[t]["temperature"], temperature, rtol=1e-5)
        np.testing.assert_allclose(updates.seen[t][1], temperature, rtol=1e-5)
    end = updates.learners[-1].coverage
    assert (int(end.episode), int(end.steps)) == (750, 1)
    np.testing.assert_allclose(end.last_episode, 0.5, rtol=1e-6)


def test_an_update_is_one_step_of_adam(updates):
    """At 0.0005 - episode · 0.0004/1500, on the summed loss, with the weights of the moment."""
    moments = {}
    for t, episode in enumerate([749, 749, 750]):
        rows, temperature, noise = jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf)), updates.seen[t])
        network = updates.learners[t].network
        (_, parts), gradient = GRADIENT(network, ALGORITHM.hyper, rows, temperature, noise, CONFIG)
        for name, value in parts.items():
            np.testing.assert_allclose(updates.metrics[t][name], value, rtol=1e-5, err_msg=name)

        before, after = paper_weights(network), paper_weights(updates.learners[t + 1].network)
        learning_rate = 0.0005 - episode * 0.0004 / 1500
        expected = paper_adam(before, paper_weights(gradient), moments, t + 1, learning_rate)
        along = length = 0.0
        for name, values in expected.items():
            np.testing.assert_allclose(after[name], values, atol=2e-3 * learning_rate, rtol=0, err_msg=name)
            along += ((after[name] - before[name]) * (values - before[name])).sum()
            length += ((values - before[name]) ** 2).sum()
        assert abs(along / length - 1) < 1e-4  # the rates of neighbouring episodes differ by 9e-4


@pytest.mark.parametrize(
    ("progress", "measured", "followed"),
    [
        ("served", {"served": 0.25}, 0.25),
        ("served", {"served": 0.25, "coverage_theta": 0.75}, 0.75),  # the paper's own, where there is one
        (None, {"served": 0.25}, 0.0),
    ],
)
def test_other_tasks_are_explored_by_their_own_progress(monkeypatch, progress, measured, followed):
    """Two steps, in which it is the same: the second is at ε = 0.3 + 0.2 · (1 - c)."""
    monkeypatch.setattr(
        gacrl_paper,
        "loss",
        lambda network, *rest: (network.critic.w8.bias.sum(), {"loss": rest[1].reward[-1]}),
    )
    update = jax.jit(gacrl_paper.make(CONFIG, ENV, TrainingConfig(), progress).update)
    step = Transition(
        observation=observe(),
        decision=jax.tree.map(lambda leaf: leaf[0], ACT(fixed_learner(), observe(), KEYS)),
        reward=jnp.zeros(N),
        terminated=jnp.asarray(False),
        truncated=jnp.asarray(False),
        first=jnp.asarray(True),
        next_observation=observe(),
        info={name: jnp.float32(value) for name, value in measured.items()},
    )
    rollout = Rollout(jax.tree.map(lambda leaf: leaf[None, None], step), ())
    learner, metrics = update(fixed_learner(), rollout, jax.random.key(0))
    np.testing.assert_allclose(metrics["epsilon"], 0.5, rtol=1e-6)
    _, metrics = update(learner, rollout, jax.random.key(1))
    np.testing.assert_allclose(metrics["epsilon"], 0.3 + 0.2 * (1 - followed), rtol=1e-6)


def test_continuous_actions_are_refused():
    with pytest.raises(ConfigError, match="gacrl_paper needs discrete actions"):
        gacrl_paper.make(CONFIG, dataclasses.replace(ENV, continuous_actions=True))


def test_environments_side_by_side_share_one_coverage(monkeypatch):
    """Two environments, two steps, a stand-in loss: four gradient steps, two episodes of mean coverage 5/12.

    Coverage is 1/3 and 2/3 at first, 0 and 2/3 in the step that ends both episodes.
    """
    monkeypatch.setattr(
        gacrl_paper,
        "loss",
        lambda network, *rest: (network.critic.w8.bias.sum(), {"loss": rest[1].reward[-1]}),
    )
    learner = fixed_learner()
    learner = learner._replace(replay=replay.empty(jax.tree.map(lambda leaf: leaf[0], learner.replay.items), 9))
    decision = jax.tree.map(lambda leaf: leaf[:4].reshape(2, 2, *leaf.shape[1:]), ACT(learner, observe(), KEYS))
    observation = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (2, 2, *leaf.shape)), observe())
    ends = jnp.array([[False, False], [True, True]])
    steps = Transition(
        observation=observation,
        decision=decision,
        reward=jnp.broadcast_to(jnp.array([[1.0, 2.0], [3.0, 4.0]])[..., None], (2, 2, N)),
        terminated=ends & False,
        truncated=ends,
        first=~ends,
        next_observation=observation,
        info={"coverage_theta": jnp.array([[1 / 3, 2 / 3], [0.0, 2 / 3]])},
    )
    after, metrics = jax.jit(ALGORITHM.update)(learner, Rollout(steps, ()), jax.random.key(0))
    np.testing.assert_array_equal(jax.vmap(UNPACK)(after.replay.items).reward, [1, 2, 3, 4, 0, 0, 0, 0, 0])
    assert int(after.optimizer.count) == 4
    assert metrics["loss"] == 2.5
    np.testing.assert_allclose(metrics["epsilon"], 0.3 + 0.2 * (1 + 0.5) / 2, rtol=1e-6)
    assert (int(after.coverage.episode), int(after.coverage.steps)) == (2, 0)
    np.testing.assert_allclose(after.coverage.last_episode, 5 / 12, rtol=1e-6)


# The task grows harder.


def test_curriculum_moves_once_an_episode():
    """Local ratio .5 → .1 and θ .5 → .2 over 1500 episodes; steps within an episode change nothing."""
    env = Spread(N, 3, max_cycles=75, reward="paper")
    paper = presets.preset("paper")
    base = env.default_params()
    advancing = curriculum.make(paper.curriculum, TASK, paper.env, base)

    def advance(state, done):
        done = jnp.asarray(done)
        transitions = SimpleNamespace(terminated=done & False, truncated=done)
        return advancing.advance(state, jnp.int32(0), Rollout(transitions, ()))

    def levels(params):
        return float(params.local_ratio), float(params.coverage_threshold)

    state, params = advancing.init(base)
    assert levels(params) == (0.5, 0.5)
    for _ in range(3):
        state, params = advance(state, [[False]])
        assert levels(params) == (0.5, 0.5)
    state, params = advance(state, [[True]])
    np.testing.assert_allclose(levels(params), (0.5 - 0.4 / 1500, 0.5 - 0.3 / 1500), rtol=1e-6)
    assert levels(advance(state, [[False]])[1]) == levels(params)
    for episode, expected in ((749, (0.3, 0.35)), (1499, (0.1, 0.2)), (2000, (0.1, 0.2))):
        _, params = advance(state._replace(episode=jnp.int32(episode)), [[True]])
        np.testing.assert_allclose(levels(params), expected, rtol=1e-6)
        assert params.arena_scale == base.arena_scale and params.physics is base.physics


def test_no_curriculum_leaves_the_task_alone():
    params = ENV.default_params()
    still = curriculum.make(CurriculumConfig(), TASK, ENV, params)
    done = jnp.ones((1, 1), bool)
    rollout = Rollout(SimpleNamespace(terminated=done, truncated=done), ())
    assert still.advance(still.init(params)[0], jnp.int32(9), rollout)[1] is params
