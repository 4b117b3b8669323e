"""Recordings: the same numbers as the environment's own, cut at the end, and safe to read from any file."""

import functools
import io
import pickle
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gacrl.envs.environment import Environment, TimeStep, observe
from gacrl.envs.probes import Probe
from gacrl.evaluation import references
from gacrl.evaluation.episodes import Episode, Look, record_many
from gacrl.evaluation.evaluate import evaluate
from gacrl.networks.graph import proximity_adjacency
from gacrl.replacing import replaced
from gacrl.scene import PLAIN, Discs, Scene
from gacrl.tasks.spread.environment import Spread, unpack_state
from gacrl.tasks.spread.scene import scene
from gacrl.tasks.spread.settings import METRICS
from gacrl.tasks.spread.task import TASK
from gacrl.types import Arrives, Decision, Intervention

KEY = jax.random.key(7)


def looking_at(env: Spread) -> Look:
    """What there is to see of spread."""
    return functools.partial(scene, env)


def seen_in(episode: Episode) -> Scene:
    assert episode.scene is not None
    return episode.scene


def covered(episode: Episode) -> np.ndarray:
    """Which landmarks are covered, of those that are there [T + 1, L]."""
    marks = seen_in(episode).marks
    return np.asarray(marks.lit) & np.asarray(marks.there)


def tell_the_state(memory, observation, key):
    """Moves about; the messages show the state that they were sent in, what arrives, and the memory."""
    action = jnp.abs(1000 * observation.positions[:, 0]).astype(jnp.int32) % 5
    values = observation.arrives.values
    heard = jnp.zeros(()) if values is None else values.mean()
    facts = jnp.concatenate([observation.state, heard[None], memory[None]])
    messages = jnp.broadcast_to(facts, (1, len(action), len(facts)))
    adjacency = proximity_adjacency(observation.positions, observation.agent_mask, 0.9)
    return Decision(action, messages, adjacency), memory + 1


def approach(memory, observation, key):
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
    quarters = Intervention("quarters", lambda state, ask, *_: Arrives(0 * ask(Arrives()) + 0.25))
    recorded = record_many(env, tell_the_state, jnp.zeros(()), params, KEY, 2, quarters, looking_at(env))

    step = jax.jit(env.step)
    for episode in recorded:
        assert episode.num_steps == env.max_cycles
        agents, marks, lines, ground = seen_in(episode)
        packed = jnp.asarray(episode.messages[0, 0, 0, :-2])
        state = unpack_state(packed, 2)
        for t in range(env.max_cycles):
            np.testing.assert_allclose(agents.positions[t], state.positions, atol=1e-5)
            np.testing.assert_allclose(marks.positions[t, :2], state.landmarks[:2], atol=1e-5)
            np.testing.assert_allclose(episode.messages[t, 0, 1, :-2], packed, atol=1e-5)
            np.testing.assert_allclose(episode.messages[t, 0, 1, -2:], [0.25, t])
            near = np.linalg.norm(np.subtract(*state.positions)) < 0.9
            np.testing.assert_array_equal(episode.adjacency[t], near & ~np.eye(2, dtype=bool))
            state, after = step(state, episode.actions[t], KEY, params)
            packed = after.observation.state
            np.testing.assert_allclose(episode.reward[t], after.reward, rtol=1e-4)
            np.testing.assert_allclose(episode.reward_raw[t], after.info["reward_raw"], rtol=1e-4)
            np.testing.assert_allclose(covered(episode)[t + 1].sum() / 2, after.info["coverage_0.1"])
        np.testing.assert_allclose(agents.positions[-1], state.positions, atol=1e-5)
        np.testing.assert_allclose(marks.positions[-1, :2], state.landmarks[:2], atol=1e-5)
        assert not covered(episode)[:, 2].any()
        rows = env.max_cycles + 1
        np.testing.assert_allclose(agents.radius, np.full((rows, 2), 0.15), rtol=1e-6)
        np.testing.assert_allclose(marks.radius, np.full((rows, 3), 0.1), rtol=1e-6)
        np.testing.assert_allclose(ground, np.tile([[-0.7, -0.7], [0.7, 0.7]], (rows, 1, 1)), rtol=1e-6)
        np.testing.assert_array_equal(marks.there, np.tile(mask, (rows, 1)))
        assert agents.there.all() and episode.agent_mask.shape == (9, 2) and episode.agent_mask.all()
        assert not agents.lit.any() and (agents.colour == PLAIN).all() and (marks.colour == PLAIN).all()
        assert lines.shape == (rows, 0, 2, 2)
    first, second = (seen_in(episode).agents.positions[0] for episode in recorded)
    assert (first != second).all()


def test_who_is_not_there_covers_nothing():
    """In either way of padding: the second agent stands on a landmark, and nobody knows."""
    env = Spread(num_agents=2, num_landmarks=2)
    state = env.reset(KEY)[0]._replace(
        positions=jnp.array([[0.05, 0.0], [0.5, 0.5]]), landmarks=jnp.array([[0.0, 0.0], [0.5, 0.55]])
    )
    params = env.default_params()
    np.testing.assert_array_equal(scene(env, state, params).marks.lit, [True, True])
    found = scene(env, state, params._replace(agent_mask=jnp.array([True, False])))
    np.testing.assert_array_equal(found.marks.lit, [True, False])
    np.testing.assert_array_equal(found.agents.there, [True, False])
    found = scene(env, state, params._replace(landmark_mask=jnp.array([False, True])))
    np.testing.assert_array_equal(found.marks.there, [False, True])


def test_an_episode_is_cut_where_it_ends_and_is_the_one_that_evaluation_measures():
    env = Spread(num_agents=1, num_landmarks=1, continuous_actions=True, terminate_on_success=True)
    arguments = (env, approach, (), env.default_params(), KEY)
    recorded = record_many(*arguments, 6, look=looking_at(env))
    assert len({episode.num_steps for episode in recorded}) > 2
    for episode in recorded:
        assert episode.messages is None and episode.adjacency is None and episode.symbols is None
        assert 1 < episode.num_steps < env.max_cycles
        assert episode.actions.shape == (episode.num_steps, 1, 5)
        assert {len(rows) for rows in jax.tree.leaves(episode.scene)} == {episode.num_steps + 1}
        assert not covered(episode)[1:-1].any() and covered(episode)[-1].all()

    measured = jax.jit(lambda: evaluate(*arguments, 6, metrics=METRICS))()
    returns = [episode.return_so_far[-1] for episode in recorded]
    np.testing.assert_allclose(returns, measured["return_agent_mean"], rtol=1e-5)
    assert recorded[0].return_so_far[0] == 0


# Tasks that say less.


@dataclass(frozen=True)
class Passing(Environment):
    """Two agents go right, a step of 1 each; the second is there from the second step to the fourth."""

    num_agents: int = 2
    num_actions: int = 1
    observation_size: int = 1
    max_cycles: int = 5

    def reset(self, key: Any, params: Any = ()) -> Any:
        clock = jnp.zeros((), jnp.int32)
        return clock, self.see(clock)

    def step(self, state: Any, action: Any, key: Any, params: Any = ()) -> Any:
        state = state + 1
        reward = jnp.array([1.0, 10.0])
        return state, TimeStep(self.see(state), reward, jnp.zeros((), bool), state >= self.max_cycles)

    def see(self, clock: Any) -> Any:
        places = jnp.stack([clock * jnp.array([1.0, 0.0]), clock * jnp.array([1.0, 0.0]) + jnp.array([5.0, 2.0])])
        alive = jnp.stack([jnp.array(True), (clock >= 1) & (clock < 4)])
        return observe(jnp.zeros((2, 1)), num_actions=1, positions=places, alive=alive)


def test_without_a_scene_of_its_own_a_task_is_shown_by_where_its_agents_are():
    env = Passing()
    (episode,) = record_many(env, references.noop(env).policy, (), (), KEY, 1)
    agents, marks, lines, ground = seen_in(episode)
    x = np.arange(6.0)
    np.testing.assert_array_equal(agents.positions[:, 0], np.stack([x, 0 * x], axis=1))
    np.testing.assert_array_equal(agents.positions[:, 1], np.stack([x + 5, 0 * x + 2], axis=1))
    # Rows of the scene are moments, those of the mask steps: who is there when it is taken.
    np.testing.assert_array_equal(agents.there[:, 1], [False, True, True, True, False, False])
    np.testing.assert_array_equal(episode.agent_mask, [[True, k in (1, 2, 3)] for k in range(5)])
    assert agents.there[:, 0].all()
    np.testing.assert_allclose(agents.radius, 10 / 20)  # of the way from x = 0 to x = 10
    assert marks.radius.shape == (6, 0) and lines.shape == (6, 0, 2, 2) and not ground.any()
    # The mean of those who are there after the step.
    np.testing.assert_allclose(episode.reward_raw, [5.5, 5.5, 5.5, 1.0, 1.0])
    np.testing.assert_allclose(episode.reward, np.tile([1.0, 10.0], (5, 1)))


def test_where_nobody_knows_where_agents_are_there_is_nothing_to_see():
    env = Probe("discount")
    episodes = record_many(env, references.random(env).policy, (), env.default_params(), KEY, 2)
    for episode in episodes:
        assert episode.scene is None and episode.num_steps == 2
        np.testing.assert_array_equal(episode.reward_raw, [0.0, 1.0])
        np.testing.assert_array_equal(episode.return_so_far, [0.0, 0.0, 1.0])


def test_the_look_of_a_task_is_that_of_its_record():
    look = references.look_of(TASK, Spread())
    assert look is not None
    state = Spread().reset(KEY)[0]
    mine, theirs = look(state, Spread().default_params()), scene(Spread(), state, Spread().default_params())
    jax.tree.map(np.testing.assert_array_equal, mine, theirs)
    assert references.look_of(TASK._replace(scene=None), Spread()) is None


# Files.


def small_episode(**changes) -> Episode:
    steps, agents, landmarks = 4, 2, 3
    rng = np.random.default_rng(0)

    def some_discs(count: int, radius: float, there: list[bool]) -> Discs:
        return Discs(
            positions=rng.normal(size=(steps + 1, count, 2)).astype(np.float32),
            radius=np.full((steps + 1, count), radius, np.float32),
            there=np.tile(there, (steps + 1, 1)),
            lit=rng.uniform(size=(steps + 1, count)) < 0.5,
            colour=rng.integers(PLAIN, 3, (steps + 1, count)).astype(np.int32),
        )

    values = {
        "scene": Scene(
            agents=some_discs(agents, 0.15, [True, True]),
            marks=some_discs(landmarks, 0.1, [True, False, True]),
            lines=rng.normal(size=(steps + 1, 2, 2, 2)).astype(np.float32),
            ground=np.tile(np.float32([[-2, -2], [2, 2]]), (steps + 1, 1, 1)),
        ),
        "actions": rng.integers(0, 5, (steps, agents)),
        "reward": rng.normal(size=(steps, agents)),
        "reward_raw": rng.normal(size=steps),
        "agent_mask": rng.uniform(size=(steps, agents)) < 0.5,
        "messages": rng.uniform(size=(steps, 2, agents, 8)),
        "adjacency": rng.uniform(size=(steps, agents, agents)) < 0.5,
        "frames": rng.integers(0, 256, (steps + 1, 4, 6, 3), np.uint8),
    }
    return Episode(**(values | changes))


@pytest.mark.parametrize("changes", [{}, {"messages": None, "adjacency": None}, {"scene": None, "frames": None}])
def test_a_saved_episode_comes_back(tmp_path, changes):
    path = tmp_path / "episode"  # no ending is added
    episode = small_episode(**changes)
    episode.save(path)
    loaded = Episode.load(path)
    before, after = vars(episode), vars(loaded)
    assert jax.tree.structure(before) == jax.tree.structure(after)
    assert {name for name, part in after.items() if part is None} == set(changes)
    for one, other in zip(jax.tree.leaves(before), jax.tree.leaves(after), strict=True):
        assert type(one) is type(other) is np.ndarray
        np.testing.assert_array_equal(one, other)
        assert one.dtype == other.dtype
    assert [file.name for file in tmp_path.iterdir()] == ["episode"]


def test_symbols_are_what_is_said_of_one_thing_alone():
    """Two rounds of two agents: one-hot, a distribution; nothing at all, and numbers that are no distribution."""
    said = np.array([[[0, 0, 1, 0], [0.2, 0.5, 0.2, 0.1]], [[0, 0, 0, 0], [0.5, 0.5, -0.5, 0.5]]])
    messages = np.stack([said, said[::-1], said, said])
    symbols = [[2, 1], [-1, -1]]
    np.testing.assert_array_equal(
        small_episode(messages=messages).symbols, [symbols, symbols[::-1], symbols, symbols]
    )


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


PLACES = "scene.agents.positions"
DAMAGE = {
    "empty": lambda arrays, trace: b"",
    "text": lambda arrays, trace: b"once upon a time\n" * 50,
    "truncated": lambda arrays, trace: archive(**arrays)[:700],
    "flipped": lambda arrays, trace: archive(**arrays).replace(b"NUMPY", b"NVMPY"),
    "pickle": lambda arrays, trace: pickle.dumps(Bomb(trace)),
    "pickled inside": lambda arrays, trace: archive(**arrays | {"reward": np.array([Bomb(trace)], object)}),
    "something else": lambda arrays, trace: archive(weights=np.ones(3)),
    "other length": lambda arrays, trace: archive(**arrays | {PLACES: arrays[PLACES][1:]}),
    "as long as the steps": lambda arrays, trace: archive(**arrays | {"scene.lines": arrays["scene.lines"][1:]}),
    "one mark more": lambda arrays, trace: archive(
        **arrays | {"scene.marks.lit": np.ones((5, arrays["scene.marks.lit"].shape[1] + 1), bool)}
    ),
    "half a scene": lambda arrays, trace: archive(**{name: arrays[name] for name in arrays if name != PLACES}),
    "no rewards": lambda arrays, trace: archive(**{name: arrays[name] for name in arrays if name != "reward"}),
    "a mask for the episode": lambda arrays, trace: archive(**arrays | {"agent_mask": np.ones(2, bool)}),
    "a mask of numbers": lambda arrays, trace: archive(**arrays | {"agent_mask": np.ones((4, 2))}),
    "a number of masks": lambda arrays, trace: archive(**arrays | {"scene.agents.colour": np.ones((5, 2), bool)}),
    "a flat graph": lambda arrays, trace: archive(**arrays | {"adjacency": np.ones(4, bool)}),
    "nothing": lambda arrays, trace: archive(**arrays | {"reward": np.float32(0)}),
    "not finite": lambda arrays, trace: archive(
        **arrays | {"scene.marks.positions": arrays["scene.marks.positions"] * np.nan}
    ),
    "words": lambda arrays, trace: archive(**arrays | {"scene.ground": np.full((5, 2, 2), "wide")}),
    "negative": lambda arrays, trace: archive(**arrays | {"scene.agents.radius": np.full((5, 2), -1.0)}),
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


def test_a_scene_that_does_not_fit_is_no_episode():
    """A row for each moment, one more than steps; the agents are those that act."""
    whole = seen_in(small_episode())
    crowd = Discs(*(np.repeat(rows, 2, axis=1) for rows in whole.agents))
    for wrong, named in (
        (whole._replace(ground=np.zeros((4, 2, 2))), r"scene\.ground of the shape \(4, 2, 2\)"),
        (whole._replace(agents=crowd), r"scene\.agents\.positions of the shape \(5, 4, 2\)"),
        (whole._replace(marks=whole.marks._replace(radius=-whole.marks.radius)), r"scene\.marks\.radius must not"),
        (whole._replace(marks=whole.marks._replace(lit=np.ones((5, 3)))), r"scene\.marks\.lit holds float64"),
    ):
        with pytest.raises(ValueError, match=named):
            small_episode(scene=wrong)


def test_arrays_that_nobody_knows_are_left_alone(tmp_path):
    path = tmp_path / "more.npz"
    path.write_bytes(archive(**saved(tmp_path), weather=np.array("fine")))
    np.testing.assert_array_equal(Episode.load(path).reward, small_episode().reward)


def test_files_appear_whole_or_not_at_all(tmp_path):
    with pytest.raises(FileNotFoundError):
        Episode.load(tmp_path / "none.npz")
    with pytest.raises(OSError):
        small_episode().save(tmp_path / "no folder" / "episode.npz")
    path = tmp_path / "episode.npz"
    path.write_text("before")
    with pytest.raises(KeyboardInterrupt), replaced(path) as file:
        file.write(b"half")
        raise KeyboardInterrupt
    assert path.read_text() == "before"
    assert [file.name for file in tmp_path.iterdir()] == ["episode.npz"]
