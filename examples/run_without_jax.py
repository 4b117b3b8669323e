"""Play an exported policy of `spread` with NumPy alone: this file needs neither JAX nor gacrl.

gacrl export pretrained:gacrl --out policy.npz
python examples/run_without_jax.py policy.npz

It holds the network of the preset gacrl by the names of docs/guides/export.md, and MPE2's physics.
"""

import sys

import numpy as np

RADIUS, SHARPNESS, SLOPE = 1.5, 4.0, 0.1  # on the card: radius, look_sharpness, seen_slope and heard_slope


def linear(w, name, x):
    """W x + b over the last axis; what attends has no b."""
    return x @ w[f"{name}.weight"].T + w.get(f"{name}.bias", 0)


def rectified(x, slope=0.0):
    """A ReLU, or a leaky one."""
    return np.where(x >= 0, x, slope * x)


def mlp(w, name, x, slope=0.0):
    """All layers of this name."""
    for layer in range(sum(key.startswith(f"{name}.layers.") and key.endswith("weight") for key in w)):
        x = rectified(linear(w, f"{name}.layers.{layer}", x), slope)
    return x


def with_length(offsets):
    """An offset and its length."""
    return np.concatenate([offsets, np.sqrt(np.square(offsets).sum(-1, keepdims=True) + 1e-8)], -1)


def scales(offsets):
    """The same, and the offset near by magnified."""
    return np.concatenate([with_length(offsets), np.tanh(offsets / 0.2)], -1)


def attend(values, score):
    """The mean of values [N, M, H] weighted by the softmax of the score [N, M]; 0 where all scores are -inf."""
    weight = np.exp(score - np.max(score, axis=1, keepdims=True, initial=-1e9))
    return np.einsum("nm,nmh->nh", weight, values) / np.maximum(weight.sum(1, keepdims=True), 1e-9)


def look(w, seen):
    """What each agent makes of what it sees [N, 6 N]: its vector, and one for each landmark."""
    n = len(seen)
    own, landmarks = seen[:, :2], seen[:, 4 : 4 + 2 * n].reshape(n, n, 2)
    agents = seen[:, 4 + 2 * n : 2 + 4 * n].reshape(n, n - 1, 2)
    between = scales(agents[:, None] - landmarks[:, :, None])
    mine = np.broadcast_to(scales(-landmarks)[:, :, None], between.shape)
    contest = mlp(w, "torso.rival", np.concatenate([between, mine], -1)).max(2)
    repeated = np.repeat(own[:, None], n, axis=1)
    places = mlp(w, "torso.landmark", np.concatenate([repeated, scales(landmarks), contest], -1), SLOPE)
    chosen = attend(places, linear(w, "torso.attention", places)[..., 0])
    crowd = mlp(w, "torso.agent", np.concatenate([repeated[:, 1:], scales(agents)], -1)).max(1)
    return mlp(w, "torso.out", np.concatenate([own, chosen, places.max(1).clip(0), crowd], -1)), places


def decide(w, seen):
    """Return the action of each agent, [N], and the symbols that they said, [R, N]."""
    hidden, places = look(w, seen)
    code = linear(w, "code.encode", hidden)[:, : w["code.merge.weight"].shape[1]]
    hidden = hidden + rectified(linear(w, "code.merge", code))
    offsets = seen[None, :, 2:4] - seen[:, None, 2:4]
    hears = (np.square(offsets).sum(-1) < RADIUS**2) & ~np.eye(len(seen), dtype=bool)
    said = []
    for number in range(sum(key.startswith("communication.merge.") and key.endswith("bias") for key in w)):
        said.append(linear(w, f"communication.encode.{number}", code if number == 0 else hidden).argmax(-1))
        words = np.eye(len(w[f"communication.encode.{number}.bias"]), dtype=np.float32)[said[-1]]
        words = np.broadcast_to(words[None], (*hears.shape, words.shape[-1]))
        edges = mlp(w, f"communication.edge.{number}", np.concatenate([words, with_length(offsets)], -1), SLOPE)
        score = np.einsum("nh,nkh->nk", linear(w, f"communication.query.{number}", hidden), edges)
        heard = attend(edges, np.where(hears, score / np.sqrt(edges.shape[-1]), -np.inf))
        merged = linear(w, f"communication.merge.{number}", np.concatenate([hidden, heard], -1))
        hidden = hidden + rectified(merged, SLOPE)
    score = np.einsum("nh,nlh->nl", linear(w, "look.query", hidden), places)
    chosen = attend(places, score * SHARPNESS / np.sqrt(places.shape[-1]))
    hidden = hidden + rectified(linear(w, "look.merge", np.concatenate([hidden, chosen], -1)), SLOPE)
    return linear(w, "head", hidden).argmax(-1), np.stack(said)


def observe(positions, velocities, landmarks):
    """What MPE2 shows: velocity, position, landmarks, other agents, and their silent channel."""
    n = len(positions)
    others = (positions[None] - positions[:, None])[~np.eye(n, dtype=bool)].reshape(n, -1)
    to_landmarks = (landmarks[None] - positions[:, None]).reshape(n, -1)
    seen = [velocities, positions, to_landmarks, others, np.zeros((n, 2 * n - 2))]
    return np.concatenate(seen, 1).astype(np.float32)


def step(positions, velocities, actions):
    """MPE2's physics: a push of 5, a soft contact at 0.3, damping by a quarter."""
    push = 5.0 * np.array([[0, 0], [-1, 0], [1, 0], [0, -1], [0, 1]])[actions]
    offsets = positions[None] - positions[:, None]
    distance = np.sqrt(np.square(offsets).sum(-1)) + np.eye(len(positions))
    strength = 100.0 * 1e-3 * np.logaddexp(0.0, (0.3 - distance) / 1e-3) / distance
    contact = (strength * ~np.eye(len(positions), dtype=bool))[:, :, None] * offsets
    return positions + 0.1 * velocities, 0.75 * velocities + 0.1 * (push - contact.sum(1))


def main(path, episodes=100, n=3, steps=25):
    """Play episodes and return the share of landmarks that have an agent within 0.1 at their end."""
    weights, random, covered = dict(np.load(path)), np.random.default_rng(0), []
    for _ in range(episodes):
        positions, velocities, landmarks = (
            random.uniform(-1, 1, (n, 2)),
            np.zeros((n, 2)),
            random.uniform(-1, 1, (n, 2)),
        )
        for _ in range(steps):
            actions, _ = decide(weights, observe(positions, velocities, landmarks))
            positions, velocities = step(positions, velocities, actions)
        distance = np.sqrt(np.square(positions[:, None] - landmarks[None]).sum(-1))
        covered.append((distance.min(0) < 0.1).mean())
    return float(np.mean(covered))


if __name__ == "__main__":
    print(f"covers {main(*sys.argv[1:]):.1%} of the landmarks at the end of 100 episodes")
