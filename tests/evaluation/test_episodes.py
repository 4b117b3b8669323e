"""Recordings: the same numbers as the environment's own, cut at the end, and safe to read from any file."""

import dataclasses
import io
import pickle
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gacrl.evaluation.episodes import Episode, record_many, written_whole
from gacrl.evaluation.evaluate import evaluate
from gacrl.networks.graph import proximity_adjacency
from gacrl.tasks.spread.environment import Spread, unpack_state
from gacrl.types import Channel, Decision

KEY = jax.random.key(7)


def tell_the_state(memory, observation, key, channel):
    """Moves about; the messages show the state that they were sent in, the channel, and the memory."""
    action = jnp.abs(1000 * observation.positions[:, 0]).astype(jnp.int32) % 5
    noise = jnp.zeros(()) if channel.noise is None else channel.noise
    facts = jnp.concatenate([observation.state, noise[None], memory[None]])
    message = jnp.broadcast_to(facts, (len(action), len(facts)))
    adjacency = proximity_adjacency(observation.positions, observation.agent_mask, 0.9)
    return Decision(action, message, adjacency), memory + 1


def approach(memory, observation, key, channel):
    """Every agent pushes towards the first landmark."""
    push = 2 * observation.features[:, 4:6] - observation.features[:, :2]
    action = jnp.stack([0 * push[:, 0], -push[:, 0], push[:, 0], -push[:, 1], push[:, 1]], axis=1)
    return Decision(action), memory


def test_a_recording_is_what_the_environment_does():
    env = Spread(num_agents=2, num_landmarks=3, max_cycles=9, reward="paper")
    mask = jnp.array([True, True, False])
    params = env.default_params()._replace(
        landmark_speed=jnp.float32(0.3), arena_scale=jnp.float32(0.7), landmark_mask=mask
    )
    channel = Channel(noise=jnp.float32(0.25))
    recorded = record_many(env, tell_the_state, jnp.zeros(()), params, KEY, 2, channel)

    step = jax.jit(env.step)
    for episode in recorded:
        assert episode.num_steps == env.max_cycles
        packed = jnp.asarray(episode.messages[0, 0, :-2])
        state = unpack_state(packed, 2)
        for t in range(env.max_cycles):
            np.testing.assert_allclose(episode.positions[t], state.positions, atol=1e-5)
            np.testing.assert_allclose(episode.landmarks[t], state.landmarks, atol=1e-5)
            np.testing.assert_allclose(episode.messages[t, 1, :-2], packed, atol=1e-5)
            np.testing.assert_allclose(episode.messages[t, 1, -2:], [0.25, t])
            near = np.linalg.norm(np.subtract(*state.positions)) < 0.9
            np.testing.assert_array_equal(episode.adjacency[t], near & ~np.eye(2, dtype=bool))
            state, after = step(state, episode.actions[t], KEY, params)
            packed = after.observation.state
            np.testing.assert_allclose(episode.reward[t], after.reward, rtol=1e-4)
            np.testing.assert_allclose(episode.reward_raw[t], after.info["reward_raw"], rtol=1e-4)
            np.testing.assert_allclose(episode.coverage[t + 1], after.info["coverage_0.1"])
        np.testing.assert_allclose(episode.positions[-1], state.positions, atol=1e-5)
        assert not episode.covered[:, 2].any()
        assert (episode.agent_radius, episode.capture_radius) == (pytest.approx(0.15), 0.1)
        assert episode.arena_scale == pytest.approx(0.7)
        np.testing.assert_array_equal(episode.landmark_mask, mask)
    assert (recorded[0].positions[0] != recorded[1].positions[0]).all()


def test_an_episode_is_cut_where_it_ends_and_is_the_one_that_evaluation_measures():
    env = Spread(num_agents=1, num_landmarks=1, continuous_actions=True, terminate_on_success=True)
    arguments = (env, approach, (), env.default_params(), KEY)
    recorded = record_many(*arguments, 6)
    assert len({episode.num_steps for episode in recorded}) > 2
    for episode in recorded:
        assert episode.messages is None and episode.adjacency is None and episode.symbols is None
        assert 1 < episode.num_steps < env.max_cycles
        assert episode.actions.shape == (episode.num_steps, 1, 5)
        assert episode.positions.shape[0] == episode.num_steps + 1
        assert not episode.covered[1:-1].any() and episode.coverage[-1] == 1

    measured = jax.jit(lambda: evaluate(*arguments, 6))()
    returns = [episode.return_so_far[-1] for episode in recorded]
    np.testing.assert_allclose(returns, measured["return_agent_mean"], rtol=1e-5)
    assert recorded[0].return_so_far[0] == 0


def small_episode(**changes) -> Episode:
    steps, agents, landmarks = 4, 2, 3
    rng = np.random.default_rng(0)
    values = {
        "positions": rng.normal(size=(steps + 1, agents, 2)).astype(np.float32),
        "landmarks": rng.normal(size=(steps + 1, landmarks, 2)).astype(np.float32),
        "actions": rng.integers(0, 5, (steps, agents)),
        "reward": rng.normal(size=(steps, agents)),
        "reward_raw": rng.normal(size=steps),
        "agent_mask": np.ones(agents, bool),
        "landmark_mask": np.array([True, False, True]),
        "agent_radius": 0.15,
        "capture_radius": 0.1,
        "arena_scale": 2.0,
        "messages": rng.uniform(size=(steps, agents, 8)),
        "adjacency": rng.uniform(size=(steps, agents, agents)) < 0.5,
    }
    return Episode(**(values | changes))


@pytest.mark.parametrize("changes", [{}, {"messages": None, "adjacency": None}])
def test_a_saved_episode_comes_back(tmp_path, changes):
    path = tmp_path / "episode"  # no ending is added
    episode = small_episode(**changes)
    episode.save(path)
    loaded = Episode.load(path)
    for field in dataclasses.fields(Episode):
        before, after = getattr(episode, field.name), getattr(loaded, field.name)
        assert type(before) is type(after)
        np.testing.assert_array_equal(before, after)
        assert not isinstance(before, np.ndarray) or before.dtype == after.dtype
    assert [file.name for file in tmp_path.iterdir()] == ["episode"]


class Bomb:
    """Leaves a trace where it is unpickled."""

    def __init__(self, trace: Path):
        self.trace = trace

    def __reduce__(self):
        return Path.touch, (self.trace,)


def archive(**arrays) -> bytes:
    file = io.BytesIO()
    np.savez(file, **arrays)
    return file.getvalue()


def saved(tmp_path: Path) -> dict[str, np.ndarray]:
    small_episode().save(tmp_path / "whole.npz")
    return dict(np.load(tmp_path / "whole.npz"))


DAMAGE = {
    "empty": lambda arrays, trace: b"",
    "text": lambda arrays, trace: b"once upon a time\n" * 50,
    "truncated": lambda arrays, trace: archive(**arrays)[:700],
    "flipped": lambda arrays, trace: archive(**arrays).replace(b"NUMPY", b"NVMPY"),
    "pickle": lambda arrays, trace: pickle.dumps(Bomb(trace)),
    "pickled inside": lambda arrays, trace: archive(**arrays | {"reward": np.array([Bomb(trace)], object)}),
    "something else": lambda arrays, trace: archive(weights=np.ones(3)),
    "other length": lambda arrays, trace: archive(**arrays | {"positions": arrays["positions"][1:]}),
    "a flat graph": lambda arrays, trace: archive(**arrays | {"adjacency": np.ones(4, bool)}),
    "nothing": lambda arrays, trace: archive(**arrays | {"reward": np.float32(0)}),
    "not finite": lambda arrays, trace: archive(**arrays | {"landmarks": arrays["landmarks"] * np.nan}),
    "words": lambda arrays, trace: archive(**arrays | {"arena_scale": np.array("wide")}),
    "negative": lambda arrays, trace: archive(**arrays | {"agent_radius": np.array(-1.0)}),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_any_other_file_is_refused_in_one_sentence(tmp_path, damage):
    trace = tmp_path / "unpickled"
    path = tmp_path / "damaged.npz"
    path.write_bytes(DAMAGE[damage](saved(tmp_path), trace))
    with pytest.raises(ValueError, match=r"is not a recorded episode: .") as caught:
        Episode.load(path)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)
    assert not trace.exists()


def test_files_appear_whole_or_not_at_all(tmp_path):
    with pytest.raises(FileNotFoundError):
        Episode.load(tmp_path / "none.npz")
    with pytest.raises(OSError):
        small_episode().save(tmp_path / "no folder" / "episode.npz")
    path = tmp_path / "episode.npz"
    path.write_text("before")
    with pytest.raises(KeyboardInterrupt), written_whole(path) as file:
        file.write(b"half")
        raise KeyboardInterrupt
    assert path.read_text() == "before"
    assert [file.name for file in tmp_path.iterdir()] == ["episode.npz"]
