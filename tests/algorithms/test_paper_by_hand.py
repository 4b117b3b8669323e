"""The paper from the outside: equations (1) to (20) and Adam in NumPy, in float64, every derivative worked out by hand.

Written from the paper's text alone: loops over rows and agents, one vector at a time, weights under their printed
names and shapes. Only `Library`, at the end, knows how gacrl keeps them.
"""

import math
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gacrl.algorithms import gacrl_paper
from gacrl.algorithms.gacrl_paper_exploration import no_coverage
from gacrl.config.algorithms import GacrlPaperConfig
from gacrl.tasks.spread.environment import Spread
from gacrl.types import Arrives, Decision, Transition

AGENTS, LATENT, SYMBOLS, ACTIONS, OBSERVED, REPLAYED = 3, 16, 8, 5, 18, 4

SHAPES = {  # (2), (5), (6), (8), (9), (11), (12); W6 and W8 need a layer that the text does not name
    "E1": (64, 18), "E2": (32, 64), "Emu": (16, 32), "Elog": (16, 32),
    "W1": (32, 16), "W2": (8, 32), "W3": (32, 40), "W4": (8, 32),
    "W5": (64, 50), "P": (32, 64), "W6": (5, 32),
    "W7": (128, 54), "C": (64, 128), "W8": (1, 64),
}  # fmt: skip

Weights = dict[str, np.ndarray]


class Seen(NamedTuple):
    """A step: what agents see, whom they hear, what they did and earned, and the noise of (3) and (9)."""

    o: np.ndarray
    near: np.ndarray
    a: np.ndarray
    r: float
    epsilon: np.ndarray
    gumbel: np.ndarray


def relu(x: np.ndarray) -> np.ndarray:
    return np.where(x > 0, x, 0.0)


def softmax(x: np.ndarray) -> np.ndarray:
    e = np.exp(x - x.max())
    return e / e.sum()


def think(w: Weights, b: Weights, seen: Seen, tau: float) -> dict[str, list[np.ndarray]]:
    """(2) to (11): every vector of every agent, by name."""
    v: dict[str, list[np.ndarray]] = {
        name: [] for name in ("e1", "e2", "mu", "s", "z", "h1", "m", "sum", "h2", "out")
    }
    for i in range(AGENTS):
        v["e1"].append(relu(w["E1"] @ seen.o[i] + b["E1"]))
        v["e2"].append(relu(w["E2"] @ v["e1"][i] + b["E2"]))
        v["mu"].append(w["Emu"] @ v["e2"][i] + b["Emu"])  # (2)
        v["s"].append(w["Elog"] @ v["e2"][i] + b["Elog"])
        v["z"].append(v["mu"][i] + seen.epsilon[i] * np.exp(0.5 * v["s"][i]))  # (3)
        v["h1"].append(relu(w["W1"] @ v["z"][i] + b["W1"]))  # (5)
        v["m"].append(w["W2"] @ v["h1"][i] + b["W2"])  # (6)
    for i in range(AGENTS):
        v["sum"].append(sum((v["m"][j] for j in range(AGENTS) if seen.near[i, j]), np.zeros(SYMBOLS)))  # (7)
        v["h2"].append(relu(w["W3"] @ np.append(v["h1"][i], v["sum"][i]) + b["W3"]))  # (8)
        v["out"].append(softmax((w["W4"] @ v["h2"][i] + b["W4"] + seen.gumbel[i]) / tau))  # (9)
    v |= {"x": [], "p1": [], "p2": [], "pi": []}
    for i in range(AGENTS):
        others = [v["out"][j] for j in range(AGENTS) if j != i]
        v["x"].append(np.concatenate([seen.o[i], *others, v["z"][i]]))  # (10)
        v["p1"].append(relu(w["W5"] @ v["x"][i] + b["W5"]))
        v["p2"].append(relu(w["P"] @ v["p1"][i] + b["P"]))
        v["pi"].append(softmax(w["W6"] @ v["p2"][i] + b["W6"]))  # (11)
    return v


class Slope:
    """The derivative of the loss by every weight, added up layer by layer."""

    def __init__(self, w: Weights, b: Weights):
        self.of_w = {name: np.zeros_like(value) for name, value in w.items()}
        self.of_b = {name: np.zeros_like(value) for name, value in b.items()}
        self._w = w

    def through(self, name: str, above: np.ndarray, below: np.ndarray, y: np.ndarray | None = None) -> np.ndarray:
        """Past y = W x + b, or y = ReLU(W x + b): from dL/dy to dL/dx, with x below."""
        above = above if y is None else above * (y > 0)
        self.of_w[name] += np.outer(above, below)
        self.of_b[name] += above
        return self._w[name].T @ above


def slope_of_policy(slope: Slope, v: dict[str, list[np.ndarray]], seen: Seen, share: float, tau: float, kl: float):
    """(18) and (20) of one row, backwards. share: what the row weighs; kl: 0.05 / (N B), or 0 for the current row."""
    back = {name: [np.zeros_like(value) for value in v[name]] for name in ("z", "m", "h1", "out")}
    for i in range(AGENTS):
        chosen = np.zeros(ACTIONS)
        chosen[seen.a[i]] = 1.0
        logits = share * seen.r / AGENTS * (v["pi"][i] - chosen)  # −log softmax
        hidden = slope.through("W6", logits, v["p2"][i])
        hidden = slope.through("P", hidden, v["p1"][i], v["p2"][i])
        x = slope.through("W5", hidden, v["x"][i], v["p1"][i])
        for place, j in enumerate(j for j in range(AGENTS) if j != i):
            back["out"][j] += x[OBSERVED + place * SYMBOLS : OBSERVED + (place + 1) * SYMBOLS]
        back["z"][i] += x[-LATENT:]
    for i in range(AGENTS):
        y = v["out"][i]
        logits = y * (back["out"][i] - y @ back["out"][i]) / tau
        hidden = slope.through("W4", logits, v["h2"][i])
        both = slope.through("W3", hidden, np.append(v["h1"][i], v["sum"][i]), v["h2"][i])
        back["h1"][i] += both[:-SYMBOLS]
        for j in range(AGENTS):
            back["m"][j] += seen.near[i, j] * both[-SYMBOLS:]
    for i in range(AGENTS):
        back["h1"][i] += slope.through("W2", back["m"][i], v["h1"][i])
        back["z"][i] += slope.through("W1", back["h1"][i], v["z"][i], v["h1"][i])
        mu = back["z"][i] + kl * 2.0 * v["mu"][i]
        s = back["z"][i] * seen.epsilon[i] * 0.5 * np.exp(0.5 * v["s"][i]) + kl * (np.exp(v["s"][i]) - 1.0)
        hidden = slope.through("Emu", mu, v["e2"][i]) + slope.through("Elog", s, v["e2"][i])
        hidden = slope.through("E2", hidden, v["e1"][i], v["e2"][i])
        slope.through("E1", hidden, seen.o[i], v["e1"][i])


def loss_and_slope(
    w: Weights, b: Weights, rows: list[Seen], tau: float
) -> tuple[tuple[float, float, float], Slope]:
    """(17) to (20): the last row is the current step, the others are replayed."""
    slope, size = Slope(w, b), len(rows) - 1
    policy = critic = kl = 0.0
    for k, seen in enumerate(rows):
        replayed = k < size
        share, v = (1.0 / size if replayed else 1.0), think(w, b, seen, tau)
        policy += share * -sum(math.log(v["pi"][i][seen.a[i]]) for i in range(AGENTS)) / AGENTS * seen.r  # (18)
        slope_of_policy(slope, v, seen, share, tau, 0.05 / (AGENTS * size) if replayed else 0.0)
        if not replayed:
            continue
        state = np.concatenate(list(seen.o))
        c1 = relu(w["W7"] @ state + b["W7"])
        c2 = relu(w["C"] @ c1 + b["C"])
        off = (w["W8"] @ c2 + b["W8"])[0] - seen.r  # (12)
        critic += off**2 / size  # (19)
        hidden = slope.through("W8", np.array([0.1 * 2.0 * off / size]), c2)
        slope.through("W7", slope.through("C", hidden, c1, c2), state, c1)
        for mu, s in zip(v["mu"], v["s"], strict=True):
            kl += -(1.0 + s - mu**2 - np.exp(s)).sum() / AGENTS / size  # (20)
    return (policy, critic, kl), slope


def adam(value: np.ndarray, g: np.ndarray, m: np.ndarray, s: np.ndarray, step: int, rate: float) -> np.ndarray:
    """Kingma and Ba 2015, algorithm 1; m and s are changed in place."""
    m[...] = 0.9 * m + 0.1 * g
    s[...] = 0.999 * s + 0.001 * g * g
    return value - rate * (m / (1 - 0.9**step)) / (np.sqrt(s / (1 - 0.999**step)) + 1e-8)


def fresh(rng: np.random.Generator) -> tuple[Weights, Weights]:
    w = {name: rng.uniform(-1, 1, shape) / math.sqrt(shape[1]) for name, shape in SHAPES.items()}
    return w, {name: rng.uniform(-1, 1, shape[0]) / math.sqrt(shape[1]) for name, shape in SHAPES.items()}


# What gacrl makes of the same


class Library:
    """gacrl's learner with these weights."""

    def __init__(self, w: Weights, b: Weights):
        config = GacrlPaperConfig(batch_size=REPLAYED, replay_capacity=8)
        self.setup = gacrl_paper.make(config, Spread(AGENTS, AGENTS, max_cycles=75, reward="paper")).init.args[0]
        hyper = gacrl_paper.make(config, self.setup.env).hyper
        learner = gacrl_paper.init(self.setup, jax.random.key(0), hyper)
        network = eqx.tree_at(self._leaves, learner.network, self._values(w, b))
        state = self.setup.adam.init(network)
        self.learner = learner._replace(network=network, optimizer=state, coverage=no_coverage())

    @staticmethod
    def _leaves(network: Any) -> list[Any]:
        n, layers = network, []
        layers += [*n.encoder.hidden, n.encoder.heads]
        layers += [n.message_model.w1, n.message_model.w2, n.message_model.w3, n.message_model.w4]
        layers += [n.policy.w5, n.policy.hidden, n.policy.w6, n.critic.w7, n.critic.hidden, n.critic.w8]
        return [leaf for layer in layers for leaf in (layer.weight, layer.bias)]

    @staticmethod
    def _values(w: Weights, b: Weights) -> list[Any]:
        names = ["E1", "E2", ("Emu", "Elog"), "W1", "W2", "W3", "W4", "W5", "P", "W6", "W7", "C", "W8"]
        pairs = [
            (w[n], b[n]) if isinstance(n, str) else [np.concatenate([x[k] for k in n]) for x in (w, b)]
            for n in names
        ]
        return [jnp.asarray(value) for pair in pairs for value in pair]

    def distance(self, network: Any, w: Weights, b: Weights) -> float:
        """The largest difference of any weight."""
        pairs = zip(self._leaves(network), self._values(w, b), strict=True)
        return max(float(np.abs(np.asarray(leaf) - value).max()) for leaf, value in pairs)


def a_step(library: Library, rng: np.random.Generator, end: bool, coverage: float) -> Transition:
    """Observations, noise and graph made up; one reward for all."""
    _, observation = jax.eval_shape(library.setup.env.reset, jax.random.key(0))
    zeros = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), observation)
    seen = zeros._replace(features=jnp.asarray(rng.normal(size=(AGENTS, OBSERVED))), arrives=Arrives())
    near = np.triu(rng.uniform(size=(AGENTS, AGENTS)) < 0.6, 1)
    noise = gacrl_paper.Noise(
        jnp.asarray(rng.normal(size=(LATENT, AGENTS))), jnp.asarray(rng.gumbel(size=(SYMBOLS, AGENTS)))
    )
    action = jnp.asarray(rng.integers(ACTIONS, size=AGENTS), jnp.int32)
    return Transition(
        observation=seen,
        decision=Decision(action, None, jnp.asarray(near | near.T), {"noise": noise}),
        reward=jnp.full(AGENTS, rng.uniform(-5, 15)),
        terminated=jnp.asarray(False),
        truncated=jnp.asarray(end),
        first=jnp.asarray(False),
        next_observation=seen,
        info={"coverage_theta": jnp.asarray(coverage)},
    )


def rows_of(bits: tuple[Any, ...]) -> list[Seen]:
    """What the loss was given, from the halves of its float64s."""
    o, near, a, r, latent, gumbel = (np.ascontiguousarray(half).view(np.float64)[..., 0] for half in bits)
    return [
        Seen(o[k], near[k] > 0, a[k].astype(int), float(r[k]), latent[..., k].T, gumbel[..., k].T)
        for k in range(len(r))
    ]


def test_five_updates_are_those_of_the_paper(monkeypatch: pytest.MonkeyPatch):
    """Coverage 1/3, then 2/3, an episode's end, and on: weights, losses, ε and τ agree to float64's last digits.

    Only which rows were drawn, and the noise of (3) and (9), are taken from the library: they are chance.
    """
    rng, told_of, original = np.random.default_rng(11), [], gacrl_paper.loss

    def telling(network: Any, hyper: Any, rows: Any, temperature: Any, noise: Any, config: Any):
        given = (rows.features, rows.adjacency, rows.action, rows.reward, noise.latent, noise.gumbel)
        # As halves: a callback runs in a thread of its own, where float64 would be cut to float32.
        halves = [jax.lax.bitcast_convert_type(value.astype(float), jnp.uint32) for value in given]
        jax.debug.callback(lambda *bits: told_of.append(bits), *halves)
        return original(network, hyper, rows, temperature, noise, config)

    monkeypatch.setattr(gacrl_paper, "loss", telling)
    with jax.enable_x64(True):
        w, b = fresh(rng)
        library = Library(w, b)
        learner, moments = library.learner, {}
        learn = jax.jit(lambda learner, inputs: gacrl_paper.learn_from_steps(library.setup, learner, inputs))
        covered, episode = [], 0
        for t, (end, coverage) in enumerate(
            [(False, 1 / 3), (True, 2 / 3), (False, 0.0), (False, 1.0), (False, 1.0)]
        ):
            c = sum(covered) / len(covered) if covered else 0.0
            epsilon = max(0.1, 0.3 - episode * 0.2 / 1500) + 0.2 * (1 - c)  # (13), (15)
            tau = max(0.7, 2.0 - episode * 1.3 / 1500) + 0.5 * (1 - c)  # (14), (16)
            step = a_step(library, rng, end, coverage)
            keys = jax.random.split(jax.random.key(t), 1)
            learner, told = learn(learner, (jax.tree.map(lambda leaf: leaf[None], step), keys))
            jax.effects_barrier()
            rows = rows_of(told_of[t])
            np.testing.assert_array_equal(rows[-1].o, step.observation.features)
            (policy, critic, kl), slope = loss_and_slope(w, b, rows, tau)
            ours = [told[name] for name in ("loss_policy", "loss_critic", "loss_kl", "epsilon", "temperature")]
            np.testing.assert_allclose(ours, [policy, critic, kl, epsilon, tau], rtol=1e-10)
            rate = 0.0005 - episode * (0.0005 - 0.0001) / 1500
            for kind, values, slopes in (("w", w, slope.of_w), ("b", b, slope.of_b)):
                for name, g in slopes.items():
                    m, s = moments.setdefault((kind, name), (np.zeros_like(g), np.zeros_like(g)))
                    values[name] = adam(values[name], g, m, s, t + 1, rate)
            assert library.distance(learner.network, w, b) < 1e-9
            covered = [] if end else [*covered, coverage]
            episode += end
        assert library.distance(library.learner.network, w, b) > 1e-3, "and they have moved"


def test_the_derivatives_by_hand_are_derivatives():
    """Central differences of the loss along every layer."""
    rng = np.random.default_rng(5)
    w, b = fresh(rng)
    rows = [
        Seen(
            rng.normal(size=(AGENTS, OBSERVED)),
            (rng.uniform(size=(AGENTS, AGENTS)) < 0.5) & ~np.eye(AGENTS, dtype=bool),
            rng.integers(ACTIONS, size=AGENTS),
            float(rng.uniform(-5, 15)),
            rng.normal(size=(AGENTS, LATENT)),
            rng.gumbel(size=(AGENTS, SYMBOLS)),
        )
        for _ in range(3)
    ]

    def total(changed: Weights) -> float:
        policy, critic, kl = loss_and_slope(changed, b, rows, 1.3)[0]
        return policy + 0.1 * critic + 0.05 * kl  # (17)

    slope = loss_and_slope(w, b, rows, 1.3)[1]
    for name, value in w.items():
        along = rng.normal(size=value.shape)
        ahead, behind = (total({**w, name: value + sign * 1e-7 * along}) for sign in (1, -1))
        expected = (ahead - behind) / 2e-7
        assert abs((slope.of_w[name] * along).sum() - expected) < 1e-5 * max(abs(expected), 1.0), name


def test_equations_1_and_4_on_places():
    """One step of the environment, its places read afterwards; r_raw is MPE2's at the local ratio of the moment."""
    env = Spread(AGENTS, AGENTS, max_cycles=75, reward="paper")
    params, step = env.default_params()._replace(local_ratio=0.3, coverage_threshold=0.35), jax.jit(env.step)
    for k in range(6):
        state, _ = env.reset(jax.random.key(k), params)
        if k % 2:  # agents beside each other
            state = state._replace(
                positions=state.positions.at[1].set(state.positions[0] + jnp.array([0.12, 0.05]))
            )
        state, after = step(state, jnp.array([0, 1, 3]), jax.random.key(9), params)
        agents, landmarks = np.asarray(state.positions, float), np.asarray(state.landmarks, float)
        raw, total, covered = 0.0, 0.0, 0.0
        for i in range(AGENTS):
            touching = sum(math.dist(agents[i], agents[j]) < 0.3 for j in range(AGENTS) if j != i)
            missing = sum(min(math.dist(a, mark) for a in agents) for mark in landmarks)
            raw += (-0.3 * touching - 0.7 * missing) / AGENTS
            d = min(math.dist(agents[i], mark) for mark in landmarks)
            total += 10.0 * (1 - d / 2.0) ** 2 + (3.0 * (1 - d / 0.35) if d < 0.35 else 0.0)
            total -= min(math.dist(agents[i], agents[j]) for j in range(AGENTS) if j != i) < 0.2
        covered = sum(min(math.dist(a, mark) for a in agents) < 0.35 for mark in landmarks) / AGENTS
        assert float(after.info["reward_shaped"]) == pytest.approx(raw + total, rel=1e-5)
        assert float(after.info["coverage_theta"]) == pytest.approx(covered)
        near = [[i != j and math.dist(agents[i], agents[j]) < 1.5 for j in range(AGENTS)] for i in range(AGENTS)]
        np.testing.assert_array_equal(gacrl_paper.heard_adjacency(after.observation, 1.5), near)
