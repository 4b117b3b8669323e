"""Q-learning from replay: its targets against NumPy and rlax, windows of the ring, exploration, slow targets."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import rlax
from conftest import drawn_learner
from hypothesis import given, settings
from hypothesis import strategies as st

from gacrl.algorithms import objectives, q_learning, replay
from gacrl.algorithms.iql import independent
from gacrl.algorithms.q_learner import Network, Parts
from gacrl.algorithms.q_learning import epsilon_greedy
from gacrl.algorithms.vdn import summed
from gacrl.config.algorithms import IqlConfig, VdnConfig
from gacrl.config.run import TrainingConfig
from gacrl.networks.agent import AgentMemory, AgentNetwork, AgentOutput
from gacrl.tasks.spread.environment import Spread
from gacrl.types import Decision, Observation, Rollout, Transition

N, A = 3, 5
ENV = Spread(N, 1)
REAL = np.array([True, True, False])
GAMMA = 0.9


class Table(AgentNetwork):
    """Q-values that stand in the first features, times a number that is learned; and 0.5 for each step remembered."""

    scale: jax.Array
    remembers: bool = eqx.field(static=True)

    def __init__(self, remembers: bool):
        self.torso = self.code = self.memory = self.communication = self.look = self.head = None  # type: ignore
        self.radius, self.nearest, self.sight, self.telling = 0.0, None, ENV.sight, ENV.telling
        self.scale, self.remembers = jnp.ones(1), remembers

    def initial_memory(self, num_agents: int) -> Any:
        return AgentMemory(jnp.zeros((num_agents, 1)), ()) if self.remembers else ()

    def __call__(
        self, observation: Observation, memory: Any = (), *unused: Any, temperature: Any = None
    ) -> tuple[AgentOutput, Any]:
        head = self.scale[0] * observation.features[:, :A]
        if isinstance(memory, AgentMemory):
            head, memory = head + 0.5 * memory.carry, AgentMemory(memory.carry + 1, ())
        near = jnp.zeros((N, N), bool)
        return AgentOutput(head, head, None, near, 0.0), memory


def features(seed: int, steps: int) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(steps, N, ENV.observation_size)).astype(np.float32)


@dataclass(frozen=True)
class Slots(Spread):
    """The same shapes, of a task in which lives end inside an episode."""

    def step(self, state: Any, action: Any, key: Any, params: Any = None) -> Any:
        state, after = super().step(state, action, key, params)
        return state, after._replace(left=jnp.zeros(self.num_agents, bool))


class Case(NamedTuple):
    mixer: Any
    n_step: int
    learned: int
    remembers: bool
    double_q: bool = True
    reward_norm: bool = False
    time_limits: tuple[int, ...] = (3,)
    unknown: int | None = None
    """A time limit too many: its own value stands in for what followed."""
    ends: bool = True
    """The task ends at step 1."""
    lives: bool = False
    """The first agent's life ends at step 2, and another one takes its slot."""


def hand_made(steps: int, case: Case) -> Rollout:
    """One environment. What followed the last step of an episode stands apart."""
    rng = np.random.default_rng(7)
    _, observation = ENV.reset(jax.random.key(0))
    seen, after = (
        jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (steps, 1, *leaf.shape)), observation)._replace(
            features=jnp.asarray(features(seed, steps))[:, None], agent_mask=jnp.broadcast_to(REAL, (steps, 1, N))
        )
        for seed in (1, 2)
    )
    end = np.arange(steps)[:, None]
    terminated, truncated = (end == 1) & case.ends, np.isin(end, case.time_limits)
    done = terminated | truncated
    going_on = ~(done | (end == steps - 1))[..., None, None]
    after = after._replace(features=jnp.where(going_on, jnp.roll(seen.features, -1, axis=0), after.features))
    action = jnp.asarray(rng.integers(A, size=(steps, 1, N)), jnp.int32)
    memory = AgentMemory(jnp.full((steps, 1, N, 1), 2.0), ()) if case.remembers else ()
    return Rollout(
        Transition(
            observation=seen,
            decision=Decision(action, extras={"choice": action, "memory": memory, "mode": ()}),
            reward=jnp.asarray(rng.normal(size=(steps, 1, N)), jnp.float32),
            terminated=jnp.asarray(terminated),
            truncated=jnp.asarray(truncated),
            first=jnp.asarray(np.concatenate([[[False]], done[:-1]])),
            next_observation=after,
            info={},
            left=jnp.asarray((end == 2)[..., None] & (np.arange(N) == 0)) if case.lives else None,
        ),
        (),
    )


def expected_errors(case: Case, given: Rollout, scale: float, target_scale: float) -> np.ndarray:
    """value − target of each step learned from, and each value: loops over the text, in float64."""
    steps = jax.tree.map(lambda leaf: np.asarray(leaf)[:, 0], given.transitions)
    here, after = (np.asarray(o.features[..., :A], float) for o in (steps.observation, steps.next_observation))
    reward = np.asarray(steps.reward, float)
    team = case.mixer != "iql"
    if case.reward_norm:  # one step of the running moments: the batch's own
        earned = reward[:, REAL].mean(1) if team else reward[:, REAL]
        mean, unit = earned.mean(), earned.std()
        if case.ends or (case.lives and not team):  # or it would pay for a longer episode, or life
            mean, unit = 0.0, max(abs(mean), unit)
        reward = (reward[:, REAL] - mean) / unit
        reward = np.concatenate([reward, np.zeros((len(reward), 1))], axis=1)
    left = np.zeros((len(here), N), bool) if steps.left is None else steps.left
    carry, errors = np.full(N, 2.0), []
    remembered = []
    for t in range(len(here)):
        carry = np.zeros(N) if steps.first[t] else carry
        remembered.append(carry[:, None])
        carry = np.where(left[t], 0.0, carry + 1)
    bonus = 0.5 if case.remembers else 0.0
    for t in range(case.learned):
        total, k, alive = np.zeros(N), 0, np.ones(N, bool)
        while True:
            among = N if case.lives else REAL.sum()  # those who come and go share with empty slots
            shared = np.full(N, reward[t + k][REAL].sum() / among) if team else reward[t + k]
            total += np.where(alive, GAMMA**k * shared, 0.0)
            alive &= ~left[t + k] | team  # the team lives on
            last = t + k
            k += 1
            if k == case.n_step or steps.terminated[last] or steps.truncated[last]:
                break
        forgotten = np.where(left[last][:, None], 0.0, remembered[last] + 1)
        seen, heard = (after[last], forgotten) if last != case.unknown else (here[last], remembered[last])
        online, slow = scale * seen + bonus * heard, target_scale * seen + bonus * heard
        best = (online if case.double_q else slow).argmax(-1)
        future = slow[np.arange(N), best]
        value = (scale * here[t] + bonus * remembered[t])[np.arange(N), steps.decision.action[t]]
        if team:
            total, future, value = total[:1], future[REAL].sum(keepdims=True), value[REAL].sum(keepdims=True)
        going_on = alive if not team else alive[:1]
        target = total + (0.0 if steps.terminated[last] else np.where(going_on, GAMMA**k * future, 0.0))
        errors.append((value - target)[REAL] if not team else value - target)
    return np.array(errors)


CASES = {
    "IQL, one step": Case("iql", 1, 1, False),
    "IQL, three steps, not double": Case("iql", 3, 4, False, double_q=False),
    "VDN, three steps, recurrent, normed": Case("vdn", 3, 4, True, reward_norm=True),
    "VDN, normed, without an end": Case("vdn", 3, 4, False, reward_norm=True, ends=False),
    "IQL, three steps, recurrent, not double": Case("iql", 3, 4, True, double_q=False),
    "VDN, recurrent, with time limits sooner than the task says": Case(
        "vdn", 3, 4, True, time_limits=(0, 2, 3), unknown=3
    ),
    "IQL, lives end inside the episode": Case("iql", 3, 4, False, lives=True),
    "IQL, normed, lives end inside the episode": Case("iql", 3, 4, False, reward_norm=True, lives=True),
    "IQL, recurrent, lives end inside the episode": Case("iql", 3, 4, True, lives=True),
    "VDN, recurrent, lives end inside the episode": Case("vdn", 3, 4, True, lives=True),
}


@pytest.mark.parametrize("name", CASES)
def test_the_loss_is_that_of_the_text(name: str):
    """On a window with an end of the task and a time limit in it. VDN has the team's reward, also of 'own' ones."""
    case = CASES[name]
    steps = case.learned + case.n_step - 1
    kind, value = {"iql": (IqlConfig, independent), "vdn": (VdnConfig, summed)}[case.mixer]
    config = kind(
        n_step=case.n_step,
        sequence_length=case.learned,
        double_q=case.double_q,
        reward_norm=case.reward_norm,
        reward="own",
        gamma=GAMMA,
        replay_capacity=steps,
        batch_size=2,
        updates=1,
        learning_starts=0,
        learning_rate=0.01,
        learning_rate_end=0.01,
        target_step=0.25,
        epsilon_end=0.1,
        exploration_steps=100,
    )
    parts = Parts(lambda key: Network(Table(case.remembers), ()), value, own_values=case.mixer == "iql")
    training = TrainingConfig(env_steps=1_000, num_envs=1, num_steps=steps)
    env = Slots(N, 1) if case.lives else ENV
    algorithm = q_learning.make(config, env, training, None, parts)
    update = jax.jit(algorithm.update)

    def at(network: Network, scale: float) -> Network:
        return jax.tree.map(lambda leaf: jnp.full_like(leaf, scale), network)

    learner = drawn_learner(algorithm)
    learner = learner._replace(network=at(learner.network, 1.3), target=at(learner.target, -0.7))
    given = hand_made(steps, case)
    after, metrics = update(learner, given, jax.random.key(0))
    errors = expected_errors(case, given, 1.3, -0.7)
    assert np.abs(errors).max() < objectives.HUBER_DELTA
    np.testing.assert_allclose(metrics["loss_td"], 0.5 * np.square(errors).mean(), rtol=1e-5)

    if case.learned == case.n_step == 1:
        one = jax.tree.map(lambda leaf: leaf[0, 0], given.transitions)
        online, slow = (scale * one.next_observation.features[:, :A] for scale in (1.3, -0.7))
        theirs = jax.vmap(rlax.double_q_learning, (0, 0, 0, None, 0, 0))(
            1.3 * one.observation.features[:, :A], one.decision.action, one.reward, GAMMA, slow, online
        )
        np.testing.assert_allclose(-errors[0], theirs[REAL], rtol=1e-5)

    # One step of Adam, and the target network a quarter of the way.
    moved = float(after.network.agent.scale[0])
    np.testing.assert_allclose(abs(moved - 1.3), 0.01, rtol=1e-3)
    np.testing.assert_allclose(after.target.agent.scale[0], -0.7 + 0.25 * (moved + 0.7), rtol=1e-5)
    ahead, behind = (np.square(expected_errors(case, given, s, -0.7)).mean() for s in (moved, 1.3))
    assert int(after.env_steps) == steps and metrics["epsilon"] == pytest.approx(1 - 0.9 * steps / 100)
    if case.n_step == 1:
        assert ahead < behind

    # Too early nothing is learned, but everything is remembered.
    early = learner._replace(env_steps=jnp.int32(-10))
    after, metrics = update(early, given, jax.random.key(0))
    assert after.network.agent.scale[0] == learner.network.agent.scale[0] and metrics["loss_td"] == 0
    assert int(after.replay.added) == steps


# The ring.


@settings(deadline=None, max_examples=60)
@given(
    st.sampled_from([(4, 1), (4, 3), (9, 2), (9, 9)]),
    st.integers(0, 40),
    st.integers(0, 2**31 - 1),
)
def test_windows_never_straddle_the_newest_and_the_oldest(sizes: tuple[int, int], more: int, seed: int):
    """Items are numbered as they were added; whatever the ring holds, a window counts up by one."""
    capacity, length = sizes
    added = length + more
    numbers = np.full(capacity, -1)
    for number in range(added):
        numbers[number % capacity] = number
    ring = replay.Replay(jnp.asarray(numbers), jnp.int32(added))
    rows = replay.sample_windows(ring, jax.random.key(seed), 64, length)
    found = numbers[np.asarray(rows)]
    np.testing.assert_array_equal(np.diff(found, axis=0), np.ones((length - 1, 64)))
    oldest = max(0, added - capacity)
    assert found.min() >= oldest and found.max() < added
    possible = range(oldest, added - length + 1)
    assert len(set(found[0])) >= min(len(possible), 3), "all of the stored steps are drawn from"


def test_blocks_go_in_place_of_the_oldest():
    ring = replay.empty(jnp.zeros(()), 6)
    for start in range(0, 10, 2):
        ring = replay.add_block(ring, jnp.arange(start, start + 2) * 1.0)
    np.testing.assert_array_equal(ring.items, [6, 7, 8, 9, 4, 5])
    assert (int(ring.added), int(ring.size)) == (10, 6)


# Exploration.


def test_epsilon_greedy_frequencies():
    """ε = 0.3, three of four actions available: the best 0.7 + 0.1, the other two 0.1 each; agents by themselves."""
    values = jnp.array([[9.0, 1.0, 2.0, 0.0], [0.0, 3.0, 1.0, 2.0]])
    mask = jnp.array([[False, True, True, True], [True, True, True, False]])
    keys = jax.random.split(jax.random.key(0), 20_000)
    act = jax.jit(jax.vmap(lambda key, epsilon: epsilon_greedy(key, values, mask, epsilon), (0, None)))
    chosen = np.asarray(act(keys, jnp.float32(0.3)))
    slack = 5 * np.sqrt(0.25 / len(keys))
    for agent, expected in enumerate(([0, 0.1, 0.8, 0.1], [0.1, 0.8, 0.1, 0])):
        counts = np.bincount(chosen[:, agent], minlength=4) / len(keys)
        assert np.abs(counts - expected).max() < slack and counts[np.array(expected) == 0] == 0
    best = chosen == [2, 1]
    assert abs(best.all(1).mean() - 0.8 * 0.8) < slack
    assert (np.asarray(act(keys[:100], jnp.float32(0.0))) == [2, 1]).all()
