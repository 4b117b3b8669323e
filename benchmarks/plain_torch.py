"""The plain way to run the paper's GACRL: MPE2's simple_spread_v3 and eager PyTorch.

One environment, one summed loss, one Adam, one update per environment step. It is the yardstick for
the library's speed and shares no code with it. Numbers in brackets are the paper's equations.
Needs `torch` and `mpe2`. Axes: B batch, N agents, 18 observation numbers, 5 actions.

    python benchmarks/plain_torch.py --steps 1500 --warmup 300 [--core K] [--seed S] [--fused] [--json]
"""

# ruff: noqa: E402
import os

for _name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ[_name] = "1"  # read when the libraries load, so it has to come before the imports

import argparse
import json
import statistics
import time

import numpy as np
import torch
import torch.nn.functional as F
from mpe2 import simple_spread_v3
from torch import nn

N, OBS, ACTIONS, LATENT, MESSAGE = 3, 18, 5, 16, 8
EPISODES, EPISODE_STEPS, BATCH, CAPACITY, SEGMENTS = 1500, 75, 64, 10_000, 5
AGENTS = [f"agent_{i}" for i in range(N)]
NOT_SELF = 1.0 - torch.eye(N)
OTHERS = torch.tensor([j for i in range(N) for j in range(N) if j != i])


class Agents(nn.Module):
    """Encoder, message network, policy and central critic, shared by all agents."""

    def __init__(self):
        super().__init__()
        self.encoder = nn.Sequential(nn.Linear(OBS, 64), nn.ReLU(), nn.Linear(64, 32), nn.ReLU())
        self.mean, self.log_var = nn.Linear(32, LATENT), nn.Linear(32, LATENT)
        self.w1, self.w2 = nn.Linear(LATENT, 32), nn.Linear(32, MESSAGE)
        self.w3, self.w4 = nn.Linear(32 + MESSAGE, 32), nn.Linear(32, MESSAGE)
        self.policy = nn.Sequential(
            nn.Linear(OBS + MESSAGE * (N - 1) + LATENT, 64), nn.ReLU(),
            nn.Linear(64, 32), nn.ReLU(), nn.Linear(32, ACTIONS),
        )  # fmt: skip
        self.critic = nn.Sequential(
            nn.Linear(OBS * N, 128), nn.ReLU(), nn.Linear(128, 64), nn.ReLU(), nn.Linear(64, 1)
        )

    def forward(self, obs, tau):
        """obs [B N 18] -> log pi [B N 5], mean and log variance of the latent [B N 16]."""
        hidden = self.encoder(obs)
        mean, log_var = self.mean(hidden), self.log_var(hidden)  # (2)
        z = mean + torch.randn_like(mean) * torch.exp(0.5 * log_var)  # (3)
        position = obs[..., 2:4]
        adjacency = (torch.cdist(position, position) < 1.5) * NOT_SELF  # (4)
        h1 = F.relu(self.w1(z))  # (5)
        received = adjacency @ self.w2(h1)  # (6), (7)
        h2 = F.relu(self.w3(torch.cat([h1, received], dim=-1)))  # (8)
        sent = F.gumbel_softmax(self.w4(h2), tau=tau)  # (9)
        from_others = sent.index_select(1, OTHERS).reshape(len(obs), N, -1)
        logits = self.policy(torch.cat([obs, from_others, z], dim=-1))  # (10), (11)
        return F.log_softmax(logits, dim=-1), mean, log_var

    def value(self, obs):
        return self.critic(obs.flatten(1)).squeeze(-1)  # (12)


class Replay:
    """The last CAPACITY transitions, sampled uniformly with replacement."""

    def __init__(self, rng):
        self.rng, self.count = rng, 0
        self.obs = np.zeros((CAPACITY, N, OBS), np.float32)
        self.actions = np.zeros((CAPACITY, N), np.int64)
        self.rewards = np.zeros(CAPACITY, np.float32)

    def add(self, obs, actions, reward):
        slot = self.count % CAPACITY
        self.obs[slot], self.actions[slot], self.rewards[slot] = obs, actions, reward
        self.count += 1

    def sample(self):
        rows = self.rng.integers(min(self.count, CAPACITY), size=BATCH)
        columns = self.obs[rows], self.actions[rows], self.rewards[rows]
        return tuple(torch.from_numpy(column) for column in columns)


def stack(per_agent):
    return np.stack([per_agent[name] for name in AGENTS])


def shaped_reward(raw, obs, theta):
    """Equation (1) for the state that obs [N 18] shows, and the share of landmarks within theta."""
    to_landmarks = np.linalg.norm(obs[:, 4:10].reshape(N, N, 2), axis=-1)
    to_others = np.linalg.norm(obs[:, 10:14].reshape(N, N - 1, 2), axis=-1)
    nearest = to_landmarks.min(axis=1)
    proximity = 10.0 * (1.0 - nearest / 2.0) ** 2
    cover = 3.0 * (nearest < theta) * (1.0 - nearest / theta)
    collision = to_others.min(axis=1) < 0.2
    return raw + (proximity + cover - collision).sum(), (to_landmarks.min(axis=0) < theta).mean()


def chosen(log_pi, actions):
    return log_pi.gather(-1, actions.unsqueeze(-1)).squeeze(-1)


def act(model, obs, tau, epsilon):
    """Draws actions from epsilon * uniform + (1 - epsilon) * pi; returns them and log pi [1 N]."""
    log_pi, _, _ = model(torch.from_numpy(obs).unsqueeze(0), tau)
    with torch.no_grad():
        mixture = (1.0 - epsilon) * log_pi[0].exp() + epsilon / ACTIONS
        actions = torch.multinomial(mixture, 1).squeeze(-1)
    return actions, chosen(log_pi, actions.unsqueeze(0))


def update(model, optimiser, batch, log_prob, reward, tau):
    """One Adam step on the loss (17); log_prob and reward are the current step's."""
    obs, actions, rewards = batch
    log_pi, mean, log_var = model(obs, tau)
    replay_term = -(chosen(log_pi, actions).mean(dim=1) * rewards).mean()
    policy_loss = replay_term - log_prob.mean() * reward  # (18)
    critic_loss = F.mse_loss(model.value(obs), rewards)  # (19)
    kl = -(1.0 + log_var - mean.square() - log_var.exp()).sum(dim=-1).mean()  # (20)
    optimiser.zero_grad()
    (policy_loss + 0.1 * critic_loss + 0.05 * kl).backward()  # (17)
    optimiser.step()


def train(steps, seed, fused=False):
    """Yields after each environment step: seconds in environment, seconds in update, reward."""
    torch.manual_seed(seed)
    env = simple_spread_v3.parallel_env(N=N, max_cycles=EPISODE_STEPS)
    model, replay = Agents(), Replay(np.random.default_rng(seed))
    optimiser = torch.optim.Adam(model.parameters(), fused=fused or None)
    for step in range(steps):
        episode, t = divmod(step, EPISODE_STEPS)
        clock = time.perf_counter()
        if t == 0:
            progress = min(episode / EPISODES, 1.0)
            theta = 0.5 - 0.3 * progress
            optimiser.param_groups[0]["lr"] = 5e-4 - 4e-4 * progress
            env.unwrapped.local_ratio = 0.5 - 0.4 * progress
            obs = stack(env.reset(seed=seed if step == 0 else None)[0])
            covered = 0.0
        env_seconds = time.perf_counter() - clock
        coverage = covered / max(t, 1)
        epsilon = max(0.1, 0.3 - episode * 0.2 / EPISODES) + 0.2 * (1.0 - coverage)  # (13), (15)
        tau = max(0.7, 2.0 - episode * 1.3 / EPISODES) + 0.5 * (1.0 - coverage)  # (14), (16)
        actions, log_prob = act(model, obs, tau, epsilon)

        clock = time.perf_counter()
        next_obs, raw, _, _, _ = env.step(dict(zip(AGENTS, actions.tolist(), strict=True)))
        next_obs = stack(next_obs)
        reward, now_covered = shaped_reward(stack(raw).mean(), next_obs, theta)
        covered += now_covered
        env_seconds += time.perf_counter() - clock

        clock = time.perf_counter()
        replay.add(obs, actions.numpy(), reward)
        update(model, optimiser, replay.sample(), log_prob, float(reward), tau)
        yield env_seconds, time.perf_counter() - clock, reward
        obs = next_obs


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=1500, help="environment steps to time")
    parser.add_argument("--warmup", type=int, default=300, help="environment steps before them")
    parser.add_argument("--core", type=int, help="pin the process to this core")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--fused", action="store_true", help="PyTorch's fused Adam, quicker than the default")
    parser.add_argument("--json", action="store_true", help="end with one line of JSON")
    args = parser.parse_args()
    if args.steps < SEGMENTS or args.warmup < 1:
        parser.error(f"--steps must be at least {SEGMENTS} and --warmup at least 1")
    if args.core is not None:
        os.sched_setaffinity(0, {args.core})
    torch.set_num_threads(1)

    length = args.steps // SEGMENTS
    run = train(args.warmup + length * SEGMENTS, args.seed, args.fused)
    # columns: when the step ended, seconds in environment, seconds in update, reward
    rows = np.array([(time.perf_counter(), *row) for row in run])
    ends = rows[args.warmup - 1 :: length, 0][: SEGMENTS + 1]
    segments = (length / np.diff(ends)).tolist()
    env_share, update_share = rows[args.warmup :, 1:3].sum(axis=0) / (ends[-1] - ends[0])
    median = statistics.median(segments)
    print(f"mean shaped reward: {rows[:, 3].mean():.2f} over all {len(rows)} steps")
    print(f"share of time: environment {env_share:.2f}, update {update_share:.2f}, rest acting")
    print(f"steps per second: median {median:.1f}, {min(segments):.1f} to {max(segments):.1f}")
    if args.json:
        result = {"steps_per_second": median, "segments": segments}
        print(json.dumps(result | {"update_share": float(update_share)}))


if __name__ == "__main__":
    main()
