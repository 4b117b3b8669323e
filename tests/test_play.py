"""Policies as things to hold: the very policy that was trained, in our task and in the real one.

A run folder with fresh parameters is enough here; nothing is trained.
"""

from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mpe2 import simple_spread_v3

import gacrl
from gacrl import play
from gacrl.config.files import fingerprint
from gacrl.config.presets import preset
from gacrl.config.run import RunConfig
from gacrl.training import build, checkpoint
from gacrl.training.devices import one_seed, without_padding
from gacrl.training.recorder import RunFolder

pytestmark = pytest.mark.xdist_group("runs")

N, V, SEEN = 3, 8, 18


def untrained(config: RunConfig, path: Path) -> Path:
    """The folder of a run that has a checkpoint before its first step."""
    folder = RunFolder.create(path, config)
    state = without_padding(build.make_trainer(config).init(config.seeds), config.num_seeds)
    tensors = checkpoint.serialise(checkpoint.arrays(state))
    checkpoint.save(folder.checkpoints, tensors, 0, fingerprint(config), {})
    return folder.path


@pytest.fixture(scope="module")
def config() -> RunConfig:
    paper = preset("paper")
    return replace(paper, num_seeds=2, algorithm=replace(paper.algorithm, replay_capacity=500))


@pytest.fixture(scope="module")
def run(config: RunConfig, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return untrained(config, tmp_path_factory.mktemp("play") / "run@1")


@pytest.fixture(scope="module")
def policy(run: Path) -> gacrl.LoadedPolicy:
    return gacrl.load_policy(run)


@pytest.fixture(scope="module")
def observations() -> np.ndarray:
    """As from MPE2: in single precision or double, [K, N, O]."""
    return np.random.default_rng(0).normal(size=(40, N, SEEN))


def test_it_acts_as_the_trained_policy_does(
    run: Path, config: RunConfig, policy: gacrl.LoadedPolicy, observations: np.ndarray
):
    trainer = build.make_trainer(config)
    learner = one_seed(trainer.init(config.seeds).learner, 0)
    act = jax.jit(trainer.algorithm.policy(learner, False))
    actions = []
    for features in observations:
        seen = trainer.env.from_features(jnp.asarray(features, jnp.float32))
        decision, _ = act((), seen, jax.random.key(0))
        actions.append(policy(features))
        np.testing.assert_array_equal(actions[-1], decision.action)
        np.testing.assert_array_equal(policy.messages, decision.messages)
    assert len(np.unique(actions)) > 1, "actions depend on what is seen"
    assert isinstance(actions[0], np.ndarray)
    assert actions[0].shape == (N,)
    assert policy.messages is not None and policy.messages.shape == (2, N, V), "what is summed, and a symbol"
    np.testing.assert_array_equal(np.sort(policy.messages[-1])[:, -2:], [[0, 1]] * N)


@pytest.mark.parametrize("name", ["mappo", "qmix", "graph-qmix", "dial", "ippo"])
def test_observations_are_enough_to_act_where_a_critic_saw_the_state(
    name: str, observations: np.ndarray, tmp_path: Path
):
    config = preset(name)
    small = {"network": replace(config.algorithm.network, width=8, parameters=None)}
    small |= {"replay_capacity": 500} if hasattr(config.algorithm, "replay_capacity") else {}
    training = replace(config.training, num_envs=2, num_steps=5)
    run = untrained(
        replace(config, training=training, algorithm=replace(config.algorithm, **small)), tmp_path / "run"
    )
    policy = gacrl.load_policy(run)
    for greedy in (True, False):
        actions = policy(observations[0], greedy)
        assert actions.shape == (N,) and set(actions) <= set(range(5))


def test_a_sampling_policy_repeats_its_draws_after_a_reset(policy: gacrl.LoadedPolicy, observations: np.ndarray):
    def episode(seed: int) -> tuple[np.ndarray, np.ndarray]:
        policy.reset(seed=seed)
        steps = [(policy(seen, greedy=False), policy.messages[-1]) for seen in observations]
        return np.stack([action for action, _ in steps]), np.stack([message for _, message in steps])

    (first, said), (again, said_again), (other, _) = episode(1), episode(1), episode(2)
    np.testing.assert_array_equal(first, again)
    np.testing.assert_array_equal(said, said_again)
    assert (first != other).any()
    assert (first[1:] != first[:-1]).any()
    assert set(np.unique(first)) == set(range(5)), "explores every action"
    np.testing.assert_allclose(said.sum(-1), 1.0, rtol=1e-5)
    assert (said.max(-1) < 1.0).all(), "soft, as in training"
    policy.reset(seed=1)
    np.testing.assert_array_equal(policy(observations[0], greedy=True), episode_greedy(policy, observations[0]))


def episode_greedy(policy: gacrl.LoadedPolicy, seen: np.ndarray) -> np.ndarray:
    """Greedy actions draw nothing: whatever was drawn before, they are the same."""
    policy.reset(seed=99)
    for _ in range(3):
        policy(seen, greedy=False)
    return policy(seen)


@pytest.mark.parametrize("shape", [(N, SEEN - 1), (N + 1, SEEN), (SEEN, N)])
def test_observations_of_another_shape_are_refused(shape: tuple[int, int], policy: gacrl.LoadedPolicy):
    with pytest.raises(gacrl.ConfigError, match=rf"= \[{N}, {SEEN}\], not \[{shape[0]}, {shape[1]}\]"):
        policy(np.zeros(shape))


def test_a_member_is_named_by_its_number(run: Path, policy: gacrl.LoadedPolicy, observations: np.ndarray):
    """Also where a folder's own name has an @ in it."""
    members = [gacrl.load_policy(f"{run}@{member}") for member in (0, 1)]
    acted = [np.stack([member(seen) for seen in observations]) for member in members]
    np.testing.assert_array_equal(acted[0], [policy(seen) for seen in observations])
    assert (acted[0] != acted[1]).any()
    with pytest.raises(gacrl.UserError, match="has the members 0 to 1: there is no @2"):
        gacrl.load_policy(f"{run}@2")
    with pytest.raises(gacrl.UserError, match="there is no run"):
        gacrl.load_policy(run.with_name("run@3"))


def test_a_changed_task_keeps_the_parameters(run: Path):
    opened = play.open_run(run, lambda env: replace(env, max_cycles=7, arena_scale=2.0))
    assert opened.env.max_cycles == 7
    assert opened.trainer.evaluation_params.arena_scale == 2.0
    with pytest.raises(gacrl.UserError, match="trained with 3 agents"):
        play.open_run(run, lambda env: replace(env, num_agents=4))


def test_it_drives_the_real_mpe2(policy: gacrl.LoadedPolicy):
    env = simple_spread_v3.parallel_env(N=N, max_cycles=25)
    seen, _ = env.reset(seed=7)
    policy.reset(seed=7)
    steps, total = 0, 0.0
    while env.agents:
        actions = policy(np.stack([seen[agent] for agent in env.agents]))
        seen, rewards, _, _, _ = env.step(dict(zip(env.agents, actions, strict=True)))
        total += np.mean(list(rewards.values()))
        steps += 1
    assert steps == 25
    assert -100 < total < 0
    env.close()


def test_scripted_policies_can_be_held_too():
    observations = np.zeros((N, SEEN))
    np.testing.assert_array_equal(gacrl.load_policy("noop")(observations), [0, 0, 0])
    random = gacrl.load_policy("random")
    drawn = np.stack([random(observations, greedy=False) for _ in range(40)])
    assert set(np.unique(drawn)) == set(range(5))
    assert random.messages is None
    with pytest.raises(gacrl.UserError, match="oracle needs the exact state"):
        gacrl.load_policy("oracle")


def test_what_is_no_run_is_refused(tmp_path: Path):
    with pytest.raises(gacrl.UserError, match="there is no run"):
        gacrl.load_policy(tmp_path / "none")
    with pytest.raises(gacrl.UserError, match="is not a run folder"):
        gacrl.load_policy(tmp_path)


def test_an_environment_is_made_by_its_settings():
    env = gacrl.make_env("spread", num_agents=5, num_landmark_neighbors=2)
    assert (env.num_agents, env.landmarks, env.observation_size) == (5, 5, 4 + 2 * 2 + 4 * 4)
    state, seen = jax.eval_shape(env.reset, jax.random.key(0))
    assert seen.features.shape == (5, env.observation_size)
    _, after = jax.eval_shape(env.step, state, jnp.zeros(5, jnp.int32), jax.random.key(0))
    assert after.reward.shape == (5,)
    with pytest.raises(
        gacrl.ConfigError, match=r"unknown setting 'env.num_agent': did you mean 'env.num_agents'?"
    ):
        gacrl.make_env("spread", num_agent=5)


def test_a_policy_is_saved_without_what_only_learning_needs(run: Path, observations: np.ndarray, tmp_path: Path):
    saved = play.save_policy(f"{run}@1", tmp_path / "policy")
    whole = sum(path.stat().st_size for path in run.rglob("*") if path.is_file())
    assert sum(path.stat().st_size for path in saved.rglob("*") if path.is_file()) < 0.25 * whole
    mine, theirs = gacrl.load_policy(saved), gacrl.load_policy(f"{run}@1")
    for seen in observations[:8]:
        np.testing.assert_array_equal(mine(seen), theirs(seen))
        np.testing.assert_array_equal(mine.messages, theirs.messages)
    with pytest.raises(gacrl.UserError, match="exists: choose another folder"):
        play.save_policy(run, saved)


def test_pretrained_policies_have_names():
    assert set(play.pretrained()) == {
        *("gacrl", "gacrl-112k", "gacrl-teams"),
        *("gacrl-reference", "gacrl-colours", "gacrl-traffic"),
    }
    with pytest.raises(gacrl.UserError, match="unknown pretrained policy 'nobody'"):
        gacrl.load_policy("pretrained:nobody")


def test_the_pretrained_policy_plays_the_real_task():
    """Six episodes of MPE2: it ends near the landmarks, where random ends anywhere (coverage 0.2: .98 against .05)."""
    policy, env = gacrl.load_policy("pretrained:gacrl"), simple_spread_v3.parallel_env(N=3, max_cycles=25)
    covered = []
    for seed in range(6):
        seen, _ = env.reset(seed=seed)
        policy.reset(seed)
        while env.agents:
            actions = policy(np.stack([seen[name] for name in env.agents]))
            seen, *_ = env.step(dict(zip(env.agents, map(int, actions), strict=True)))
        world = env.unwrapped.world
        places = np.stack([agent.state.p_pos for agent in world.agents])
        marks = np.stack([landmark.state.p_pos for landmark in world.landmarks])
        covered.append((np.linalg.norm(marks[:, None] - places, axis=-1).min(1) < 0.2).mean())
    assert np.mean(covered) > 0.8
