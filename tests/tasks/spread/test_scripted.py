"""The scripted policies reach what is known of them, and the oracle copes with every shape of the task."""

import functools
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist, pdist

from gacrl import tasks
from gacrl.envs.particles import Physics
from gacrl.errors import ConfigError
from gacrl.evaluation import references
from gacrl.evaluation.evaluate import evaluate
from gacrl.tasks.spread import scripted
from gacrl.tasks.spread.environment import Spread, SpreadState, pack_state, unpack_state
from gacrl.tasks.spread.settings import METRICS, SpreadSettings
from gacrl.tasks.spread.task import TASK
from gacrl.types import Actor, Decision

KEY = jax.random.key(7)
SCRIPTED = ("random", "noop", "oracle")
"""Stand beside every number."""


def scripted_actor(name: str, env: Spread) -> Actor:
    return references.actor(TASK, name, env)


def at_rest(positions, landmarks) -> SpreadState:
    still = jnp.zeros_like
    return SpreadState(positions, still(positions), landmarks, still(landmarks), jnp.int32(0))


def observe(env: Spread, positions, landmarks):
    return env.observe(at_rest(positions, landmarks), env.default_params())


def starts(num_envs: int, num_agents: int, num_landmarks: int, arena_scale: float = 1.0):
    """Places of agents [E N 2] and landmarks [E L 2]."""
    shape = (num_envs, num_agents + num_landmarks, 2)
    places = arena_scale * np.random.default_rng(0).uniform(-1, 1, shape).astype(np.float32)
    return places[:, :num_agents], places[:, num_agents:]


def play_on(env: Spread, positions, landmarks, num_steps: int, name: str = "oracle") -> np.ndarray:
    """Where a scripted policy brings the agents that start at rest: [E N 2]."""
    actor = scripted_actor(name, env)

    def play(positions, landmarks):
        def step(loop, _):
            state, memory = loop
            observation = env.observe(state, env.default_params())
            decision, memory = actor.policy(memory, observation, KEY)
            return (env.step(state, decision.action, KEY)[0], memory), None

        start = at_rest(positions, landmarks), actor.initial_memory
        return jax.lax.scan(step, start, length=num_steps)[0][0].positions

    return np.asarray(jax.jit(jax.vmap(play))(positions, landmarks))


def covered(positions: np.ndarray, landmarks: np.ndarray) -> float:
    """Share of landmarks with an agent within 0.1."""
    distances = np.linalg.norm(positions[:, :, None] - landmarks[:, None], axis=-1)
    return float((distances.min(axis=1) < 0.1).mean())


def test_an_unknown_name_is_refused():
    assert references.shown(TASK) == list(SCRIPTED)
    assert references.playable(TASK) == [*SCRIPTED, "local"]
    with pytest.raises(ConfigError, match="unknown scripted policy 'orcale': did you mean 'oracle'"):
        scripted_actor("orcale", Spread())
    with pytest.raises(ConfigError, match="known: local, noop, oracle, random"):
        scripted_actor("xyz", Spread())


# Three agents, 25 steps


@functools.cache
def player():
    """One compiled program for the three policies: (name's index, landmark speed, share of it seen) -> metrics."""
    env = Spread()
    policies = [scripted_actor(name, env) for name in SCRIPTED]
    memories = tuple(policy.initial_memory for policy in policies)

    @jax.jit
    def play(which, landmark_speed, seen_share):
        def policy(memories, observation, key):
            state = unpack_state(observation.state, env.num_agents)
            state = state._replace(landmark_velocities=seen_share * state.landmark_velocities)
            observation = observation._replace(state=pack_state(state))
            decided = [one.policy(m, observation, key) for one, m in zip(policies, memories, strict=True)]
            action = jnp.stack([decision.action for decision, _ in decided])[which]
            return Decision(action), tuple(memory for _, memory in decided)

        params = env.default_params()._replace(landmark_speed=landmark_speed)
        return evaluate(env, policy, memories, params, KEY, 2048, metrics=METRICS)

    def by_name(name, landmark_speed=0.0, seen_share=1.0):
        metrics = play(SCRIPTED.index(name), landmark_speed, seen_share)
        return {name: np.asarray(values, np.float64) for name, values in metrics.items()}

    return by_name


@pytest.mark.parametrize(("name", "known"), [("random", -26.2), ("noop", -24.0)])
def test_floors(name, known):
    """The returns of MPE2's task that anyone can measure."""
    returns = player()(name)["return_agent_mean"]
    assert returns.mean() == pytest.approx(known, abs=3 * returns.std() / len(returns) ** 0.5)


def test_oracle():
    metrics = player()("oracle")
    assert metrics["coverage_final_0.1"].mean() >= 0.98
    assert metrics["success_final_0.1"].mean() >= 0.95
    assert metrics["return_agent_mean"].mean() >= -7.0


def test_oracle_leads_moving_landmarks():
    leading = player()("oracle", landmark_speed=0.25)
    chasing = player()("oracle", landmark_speed=0.25, seen_share=0.0)
    assert leading["coverage_final_0.1"].mean() >= 0.92
    assert chasing["coverage_final_0.1"].mean() <= 0.2
    assert leading["coverage_mean_0.2"].mean() >= chasing["coverage_mean_0.2"].mean() + 0.03


def test_oracle_with_continuous_actions():
    positions, landmarks = starts(400, 3, 3)
    ends = play_on(Spread(continuous_actions=True), positions, landmarks, 25)
    assert covered(ends, landmarks) >= 0.99
    assert np.mean([(pdist(end) < 2 * Physics().agent_radius).any() for end in ends]) <= 0.02


def test_floors_with_continuous_actions():
    env = Spread(continuous_actions=True)
    random, noop = references.random(env).policy, references.noop(env).policy
    observation = jax.jit(functools.partial(observe, env))(jnp.zeros((3, 2)), jnp.zeros((3, 2)))
    np.testing.assert_array_equal(noop((), observation, KEY)[0].action, np.zeros((3, 5)))
    pushes = random((), observation, KEY)[0].action
    assert pushes.shape == (3, 5)
    assert 0 <= pushes.min() < 0.3 < 0.7 < pushes.max() <= 1


# Any shape of the task


@pytest.mark.parametrize(
    ("num_agents", "num_landmarks", "num_steps", "coverage"),
    [(1, 1, 30, 1.0), (10, 2, 15, 0.885), (2, 4, 30, 0.5)],
    ids=["alone", "surplus agents make way", "surplus landmarks"],
)
def test_any_number_of_agents_and_landmarks(num_agents, num_landmarks, num_steps, coverage):
    positions, landmarks = starts(400, num_agents, num_landmarks)
    ends = play_on(Spread(num_agents, num_landmarks), positions, landmarks, num_steps)
    assert covered(ends, landmarks) >= coverage


def test_landmarks_closer_than_two_discs():
    """0.1 apart they share one agent and the other keeps away; 0.25 apart each gets one, without contact."""
    positions = np.tile(np.array([[-0.5, 0.1], [0.6, -0.2]], np.float32), (2, 1, 1))
    landmarks = np.array([[[0.0, 0.0], [0.1, 0.0]], [[0.0, 0.0], [0.25, 0.0]]], np.float32)
    ends = play_on(Spread(2, 2), positions, landmarks, 20)
    shared, apart = (cdist(*pair) < 0.1 for pair in zip(ends, landmarks, strict=True))
    assert sorted(shared.sum(axis=1)) == [0, 2]
    np.testing.assert_array_equal(apart, np.eye(2))
    for end in ends:
        assert pdist(end) >= 2 * Physics().agent_radius


@pytest.mark.parametrize(("num_agents", "num_landmarks"), [(4, 3), (3, 4)])
def test_the_assignment_is_optimal_and_kept(num_agents, num_landmarks):
    # The agents see little, which is nothing to the oracle.
    env = Spread(num_agents, num_landmarks, num_agent_neighbors=1, num_landmark_neighbors=1)
    oracle = scripted.oracle(env)

    @jax.jit
    @jax.vmap
    def remember(memory, positions, landmarks):
        return oracle.policy(memory, observe(env, positions, landmarks), KEY)[1]

    positions, landmarks = starts(100, num_agents, num_landmarks)
    memory = remember(jnp.tile(oracle.initial_memory, (100, 1)), positions, landmarks)
    np.testing.assert_array_equal(remember(memory, positions[::-1], landmarks[::-1]), memory)
    for agents, places, chosen in zip(positions, landmarks, np.asarray(memory), strict=True):
        if pdist(places).min() > scripted.SHARED_DISTANCE:
            rows, columns = linear_sum_assignment(cdist(agents, places, "sqeuclidean"))
            np.testing.assert_array_equal(chosen[rows], columns)
            assert (np.delete(chosen, rows) == -1).all()


def test_padding_changes_nothing():
    def decide(env: Spread, positions, landmarks, **masks):
        oracle, params = scripted.oracle(env), env.default_params()._replace(**masks)

        def act(positions, landmarks):
            seen = env.observe(at_rest(positions, landmarks), params)
            return oracle.policy(oracle.initial_memory, seen, KEY)

        return jax.jit(jax.vmap(act))(positions, landmarks)

    positions, landmarks = starts(200, 4, 4)
    masks = {"agent_mask": jnp.arange(4) < 2, "landmark_mask": jnp.arange(4) < 3}
    decision, memory = decide(Spread(2, 3), positions[:, :2], landmarks[:, :3])
    padded_decision, padded_memory = decide(Spread(4, 4), positions, landmarks, **masks)
    np.testing.assert_array_equal(padded_memory[:, :2], memory)
    np.testing.assert_array_equal(padded_decision.action[:, :2], decision.action)


def test_large_teams_pay_for_the_assignment_once():
    env = Spread(200, 200)
    oracle = scripted.oracle(env)
    places = starts(2, 200, 200, arena_scale=8.0)
    observations = jax.jit(jax.vmap(functools.partial(observe, env)))(*places)
    act = jax.jit(jax.vmap(lambda memory, observation: oracle.policy(memory, observation, KEY)[1]))

    def fastest(memory):
        """Seconds of the best of seven calls, and the memory after."""
        seconds = []
        for _ in range(7):
            begin = time.perf_counter()
            after = jax.block_until_ready(act(memory, observations))
            seconds.append(time.perf_counter() - begin)
        return min(seconds), after

    assigning, landmarks = fastest(jnp.broadcast_to(oracle.initial_memory, (2, 200)))
    acting, kept = fastest(landmarks)
    np.testing.assert_array_equal(np.sort(landmarks), np.tile(np.arange(200), (2, 1)))
    np.testing.assert_array_equal(kept, landmarks)
    assert acting < 0.6 * assigning


# The local policy


def test_the_local_policy_leaves_a_landmark_to_who_is_nearer():
    """Two agents left of two landmarks in a row: the nearer one takes the first, the other passes on to the second."""
    env = Spread(2, 2, max_cycles=40)
    positions = np.array([[[0.0, 0.0], [-0.4, 0.2]]])
    landmarks = np.array([[[0.3, 0.0], [0.95, 0.3]]])
    ends = play_on(env, positions, landmarks, 30, "local")
    apart = np.linalg.norm(ends[0][:, None] - landmarks[0], axis=-1)
    assert apart[0, 0] < 0.1
    assert apart[1, 1] < 0.1


def test_the_local_policy_lies_between_random_and_the_oracle():
    env = tasks.find("spread").make(SpreadSettings(num_agents=10, arena_scale=(10 / 3) ** 0.5))
    positions, landmarks = starts(300, 10, 10, (10 / 3) ** 0.5)
    ends = {
        name: covered(play_on(env, positions, landmarks, 60, name), landmarks)
        for name in ("random", "local", "oracle")
    }
    assert ends["random"] < 0.1
    assert 0.7 < ends["local"] < ends["oracle"] - 0.05
