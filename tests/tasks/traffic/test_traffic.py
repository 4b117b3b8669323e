"""Traffic Junction: its rules by hand, its roads and steps beside IC3Net's program, and what its scripted policies reach."""

import hashlib
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gacrl import make_env, render, tasks
from gacrl.errors import ConfigError
from gacrl.evaluation import references
from gacrl.evaluation.episodes import record_many
from gacrl.tasks import own
from gacrl.tasks.traffic.environment import NOBODY, TrafficJunction, TrafficParams, TrafficState
from gacrl.tasks.traffic.roads import roads
from gacrl.tasks.traffic.scene import scene
from gacrl.tasks.traffic.settings import LEVELS, TrafficSettings
from gacrl.tasks.traffic.task import TASK
from gacrl.training.curriculum import _moves

KEY = jax.random.key(0)
GAS, BRAKE = 0, 1
NO_ONE, EVERYONE = TrafficParams(0.0), TrafficParams(1.0)
"""Who arrives."""
DOWN, EAST = 0, 1
"""The routes of `easy`, seven cells each; they cross in their cells 3."""


def on_easy(*cars: tuple[int, int, int] | None) -> TrafficState:
    """The state with cars of (route, place, age) in the first slots, None for an empty one."""
    slots = [*cars, *[None] * (5 - len(cars))]
    numbers = jnp.array([(0, 0, 0) if car is None else car for car in slots], jnp.int32)
    there = jnp.array([car is not None for car in slots])
    return TrafficState(there, *numbers.T, jnp.zeros(5, bool), jnp.asarray(False), jnp.asarray(0))


@pytest.fixture(scope="module")
def step() -> Callable[..., Any]:
    """A step of `easy` with these actions; slots that are not named give gas."""
    env = TrafficJunction()
    compiled = jax.jit(env.step)

    def play(state: TrafficState, *actions: int, params: TrafficParams = NO_ONE) -> Any:
        return compiled(state, jnp.array([*actions, *[GAS] * (5 - len(actions))]), KEY, params)

    return play


# The rules, by hand.


def test_cars_arrive_at_their_entries_in_free_slots(step: Callable[..., Any]):
    state, seen = TrafficJunction().reset(KEY)
    assert not state.there.any() and not seen.agent_mask.any() and not seen.features.any()
    for cars, ages in ((2, [0, 0]), (4, [0, 0, 1, 1]), (5, [0, 1, 1, 2, 2])):
        state, after = step(state, params=EVERYONE)
        there = np.asarray(state.there)
        assert there.sum() == cars
        assert sorted(np.asarray(state.age)[there].tolist()) == ages
        np.testing.assert_array_equal(after.observation.agent_mask, there)
        np.testing.assert_array_equal(state.place, np.where(there, state.age, 0))  # all give gas
    new = there & (np.asarray(state.age) == 0)
    assert np.asarray(state.route)[new].tolist() == [DOWN]  # entries are served in order
    assert float(after.info["success"]) == 1.0


def test_a_car_pays_for_each_step_since_it_arrived(step: Callable[..., Any]):
    state, after = step(on_easy((DOWN, 0, 0), None, (EAST, 1, 6)), BRAKE, GAS, GAS)
    np.testing.assert_allclose(after.reward, [-0.01, 0, -0.07, 0, 0], rtol=1e-5)
    assert float(after.info["reward_raw"]) == pytest.approx(-0.08 / 5)
    assert state.place.tolist() == [0, 0, 2, 0, 0]
    assert state.braked.tolist() == [True, False, False, False, False]
    assert after.observation.features[0, -2] == 1.0  # what it did last


def test_a_crash_counts_in_every_step_of_it_and_is_never_forgotten(step: Callable[..., Any]):
    """Two cars meet in the junction, stay there, and part; a third one is not in it."""
    state, after = step(on_easy((DOWN, 2, 2), (EAST, 2, 2), (EAST, 0, 0)))
    np.testing.assert_allclose(after.reward, [-10.03, -10.03, -0.01, 0, 0], rtol=1e-5)
    assert float(after.info["crashes"]) == 2.0 and float(after.info["success"]) == 0.0
    assert after.observation.features[:, -1].tolist() == [2.0, 2.0, 1.0, 0.0, 0.0]  # cars in one's own cell
    state, after = step(state, BRAKE, BRAKE)
    np.testing.assert_allclose(after.reward, [-10.04, -10.04, -0.02, 0, 0], rtol=1e-5)
    state, after = step(state, GAS, BRAKE)
    np.testing.assert_allclose(after.reward, [-0.05, -10.05, -10.03, 0, 0], rtol=1e-5)  # the next one drives in
    state, after = step(state, GAS, GAS, BRAKE)
    assert float(after.info["crashes"]) == 0.0 and float(after.info["success"]) == 0.0


def test_cars_may_follow_closely(step: Callable[..., Any]):
    _, after = step(on_easy((DOWN, 3, 3), (DOWN, 2, 2), (EAST, 5, 5)))
    assert float(after.info["crashes"]) == 0.0


def test_a_car_leaves_at_the_end_of_its_route(step: Callable[..., Any]):
    state, after = step(on_easy((DOWN, 6, 6), (EAST, 6, 6), (EAST, 5, 5)), GAS, BRAKE, BRAKE)
    assert state.there.tolist() == [False, True, True, False, False]
    np.testing.assert_allclose(after.reward, [0, -0.07, -0.06, 0, 0], rtol=1e-5)
    assert after.left.tolist() == [True, False, False, True, True]  # nobody's memory lives on in an empty slot
    assert not after.observation.features[0].any()


def test_who_takes_a_slot_at_once_is_another_one(step: Callable[..., Any]):
    """The only free slot is that of the car that leaves. Who arrives there stands on another car: both have crashed, but
    it has done nothing to earn that."""
    full = on_easy((EAST, 6, 6), (DOWN, 0, 4), (EAST, 2, 3), (EAST, 1, 2), (DOWN, 5, 9))
    state, after = step(full, GAS, BRAKE, BRAKE, BRAKE, BRAKE, params=EVERYONE)
    assert state.there.all() and (state.route[0], state.place[0], state.age[0]) == (DOWN, 0, 0)
    assert after.left.tolist() == [True, False, False, False, False]
    np.testing.assert_allclose(after.reward, [0, -10.05, -0.04, -0.03, -0.10], rtol=1e-5)
    assert float(after.info["reward_raw"]) == pytest.approx((-10 - 10.22) / 5)


def test_the_time_limit_is_the_levels_unless_it_is_set():
    ended = {}
    for name, settings in {"easy": {}, "hard": {"level": "hard"}, "short": {"max_cycles": 3}}.items():
        env = TrafficJunction(**settings)
        state = env.reset(KEY)[0]._replace(clock=jnp.asarray(env.max_cycles - 2))
        for _ in range(2):
            state, after = env.step(state, jnp.zeros(env.num_agents, jnp.int32), KEY)
            ended.setdefault(name, []).append((bool(after.truncated), bool(after.terminated)))
        ended[name].append(env.max_cycles)
    assert ended == {
        name: [(False, False), (True, False), n] for name, n in (("easy", 20), ("hard", 80), ("short", 3))
    }


def test_arrivals_are_drawn_as_they_should_be():
    """Every entry on its own, slots and routes alike often; where slots are rare the first entries have them."""
    env, draws = TrafficJunction(level="medium"), 20_000
    there = jnp.arange(10) < 3

    @jax.jit
    def draw(there: Any, arrival: float) -> Any:
        keys = jax.random.split(KEY, draws)
        return jax.vmap(lambda key: env.arrivals(there, key, TrafficParams(arrival)))(keys)

    found = np.asarray(draw(there, 0.2))
    assert (found[:, :3] == NOBODY).all()
    share = np.stack([(found == route).mean(0) for route in range(12)])[:, 3:]  # of each route in each slot
    np.testing.assert_allclose(share, 0.2 / 3 / 7, atol=5 * (0.2 / 21 / draws) ** 0.5)
    together = (found >= 0).sum(1)
    np.testing.assert_allclose(np.bincount(together)[:2] / draws, [0.8**4, 4 * 0.2 * 0.8**3], atol=0.02)
    single = np.asarray(draw(jnp.arange(10) != 4, 0.5))[:, 4]
    by_entry = np.bincount(single[single != NOBODY] // 3) / draws
    np.testing.assert_allclose(by_entry, [1 / 2, 1 / 4, 1 / 8, 1 / 16], atol=0.02)


# Beside IC3Net's program.


def test_the_roads_are_those_of_the_program():
    """The digests are of the `repr` of the routes, lists of (row, column), that `get_routes` of
    https://github.com/IC3Net/IC3Net (commit 69b7e0c) makes, one entry after the other."""
    counts = {name: (len(roads(name).routes), len(roads(name).cells), roads(name).entries) for name in LEVELS}
    assert counts == {"easy": (2, 13, 2), "medium": (12, 52, 4), "hard": (56, 128, 8)}
    driven = {name: [[tuple(cell) for cell in route] for route in coordinates(name)] for name in LEVELS}
    assert driven["easy"] == [[(k, 3) for k in range(7)], [(3, k) for k in range(7)]]
    for name, digest in (("medium", "53bbca696ef71a89"), ("hard", "8c801d0148065012")):
        assert hashlib.sha256(repr(driven[name]).encode()).hexdigest()[:16] == digest
    for route in (route for routes in driven.values() for route in routes):
        assert len(set(route)) == len(route)  # so that a cell tells how far one has come


def coordinates(level: str) -> list[list[list[int]]]:
    """Rows and columns of the cells of each route."""
    table = roads(level)
    return [
        table.cells[cells[:length]].tolist() for cells, length in zip(table.routes, table.lengths, strict=True)
    ]


class Program:
    """IC3Net's `TrafficJunctionEnv`, its step word for word; who arrives, which it draws, is given."""

    def __init__(self, level: str, vision: int):
        self.routes, self.ncar, size = coordinates(level), LEVELS[level].cars, LEVELS[level].grid
        self.vision, self.dims = vision, (size, size)
        self.has_failed = 0
        self.alive_mask, self.wait = np.zeros(self.ncar), np.zeros(self.ncar)
        self.car_loc = np.zeros((self.ncar, 2), dtype=int)
        self.car_last_act, self.car_route_loc = np.zeros(self.ncar, dtype=int), np.full(self.ncar, -1)
        self.route_id = [-1] * self.ncar
        self.chosen_path: list[Any] = [0] * self.ncar

    def step(self, action: np.ndarray, arrivals: list[tuple[int, int]]) -> np.ndarray:
        self.is_completed = np.zeros(self.ncar)
        for i, a in enumerate(action):
            self.take_action(i, a)
        for idx, route in arrivals:
            assert self.alive_mask[idx] == 0
            self.alive_mask[idx] = 1
            self.route_id[idx], self.chosen_path[idx] = route, self.routes[route]
            self.car_route_loc[idx], self.car_loc[idx] = 0, self.routes[route][0]
        return self.get_reward()

    def take_action(self, idx: int, act: int) -> None:
        if self.alive_mask[idx] == 0:
            return
        self.wait[idx] += 1
        if act == 1:
            self.car_last_act[idx] = 1
            return
        self.car_route_loc[idx] += 1
        curr = self.car_route_loc[idx]
        if curr == len(self.chosen_path[idx]):
            self.alive_mask[idx], self.wait[idx] = 0, 0
            self.car_loc[idx] = np.zeros(2, dtype=int)
            self.is_completed[idx] = 1
            return
        self.car_loc[idx] = self.chosen_path[idx][curr]
        self.car_last_act[idx] = 0

    def get_reward(self) -> np.ndarray:
        reward = np.full(self.ncar, -0.01) * self.wait
        for i, loc in enumerate(self.car_loc):
            if (
                len(np.where(np.all(self.car_loc[:i] == loc, axis=1))[0])
                or len(np.where(np.all(self.car_loc[i + 1 :] == loc, axis=1))[0])
            ) and loc.any():
                reward[i] += -10
                self.has_failed = 1
        return self.alive_mask * reward

    def get_obs(self) -> Iterator[tuple[int, np.ndarray, int, np.ndarray]]:
        """Route, cell, last action and the counts of cars around, of each car in its turn."""
        v, grid = self.vision, np.zeros(np.array(self.dims) + 2 * self.vision)
        for p in self.car_loc:
            grid[p[0] + v, p[1] + v] += 1
        for i, p in enumerate(self.car_loc):
            square = grid[p[0] : p[0] + 2 * v + 1, p[1] : p[1] + 2 * v + 1]
            yield self.route_id[i], p, self.car_last_act[i], square * self.alive_mask[i]


class Played(NamedTuple):
    """What happened in E episodes of T steps, [E, T, …], as our environment has it."""

    action: np.ndarray
    state: TrafficState
    after: Any


def play_randomly(env: TrafficJunction, episodes: int) -> Played:
    """Episodes of random actions, twice as often gas as brakes."""

    @jax.jit
    @jax.vmap
    def play(key: Any) -> Played:
        def one(state: TrafficState, key: Any) -> tuple[TrafficState, Played]:
            act_key, step_key = jax.random.split(key)
            action = jax.random.bernoulli(act_key, 1 / 3, (env.num_agents,)).astype(int)
            state, after = env.step(state, action, step_key)
            return state, Played(action, state, after)

        return jax.lax.scan(one, env.reset(key)[0], jax.random.split(key, env.max_cycles))[1]

    return jax.device_get(play(jax.random.split(KEY, episodes)))


@pytest.mark.parametrize(("level", "vision"), [("easy", 0), ("easy", 1), ("medium", 1), ("hard", 2)])
def test_every_step_is_that_of_the_program(level: Any, vision: int):
    env = TrafficJunction(level=level, vision=vision)
    played, crashed, reused = play_randomly(env, 12), 0, 0
    for episode in range(12):
        program, before = Program(level, vision), np.zeros(env.num_agents, bool)
        for t in range(env.max_cycles):
            action, state, after = jax.tree.map(lambda leaf: leaf[episode, t], played)  # noqa: B023 called at once
            new = state.there & (state.age == 0)
            reward = program.step(action, [(i, int(state.route[i])) for i in np.flatnonzero(new)])
            np.testing.assert_array_equal(state.there, program.alive_mask == 1)
            there = np.flatnonzero(state.there)
            np.testing.assert_array_equal(state.age, program.wait)
            np.testing.assert_array_equal(state.braked, program.car_last_act == 1)
            np.testing.assert_array_equal(state.place[there], program.car_route_loc[there])
            np.testing.assert_allclose(after.info["reward_raw"], reward.mean(), rtol=1e-5)
            np.testing.assert_allclose(after.reward, np.where(new, 0.0, reward), rtol=1e-5)
            assert after.info["success"] == 1 - program.has_failed
            np.testing.assert_array_equal(after.left & before, program.is_completed == 1)
            assert after.left[~before].all()
            shown = [told(env, *seen) for seen in program.get_obs()]
            np.testing.assert_array_equal(after.observation.features[there], np.array(shown)[there])
            assert not after.observation.features[~state.there].any()
            crashed, reused = crashed + (reward < -9).sum(), reused + (new & before).sum()
            before = state.there
    assert crashed > 50 and reused > 5  # it was about something


def told(env: TrafficJunction, route: int, cell: np.ndarray, act: int, counts: np.ndarray) -> np.ndarray:
    """What the program knows of a car, as features."""
    table = env.roads
    one_hots = np.arange(len(table.routes)) == route, (table.cells == cell).all(1)
    return np.concatenate([*one_hots, [act], counts.ravel()])


# The task.


@pytest.mark.parametrize(
    ("level", "gas"), [("easy", 0.279), ("medium", 0.032), pytest.param("hard", 0.077, marks=pytest.mark.slow)]
)
def test_scripted_policies_reach_what_is_known_of_them(level: Any, gas: float):
    """Gas: IC3Net's own program, 20,000 (medium 6,000) episodes. Within four standard errors."""
    settings = TrafficSettings(level=level)
    driven = references.play_scripted("gas", TASK.name, settings, 1_000)
    assert driven["success"] == pytest.approx(gas, abs=4 * (gas * (1 - gas) / 1_000) ** 0.5)
    yielded = references.play_scripted("yielder", TASK.name, settings, 400)
    assert yielded["success"] == 1.0 and yielded["crashes"] == 0.0
    if level == "easy":
        assert yielded["return_agent_mean"] == pytest.approx(-0.366, abs=0.01)
        assert references.shown(TASK) == ["random", "noop", "yielder"]


def test_the_record_keeps_its_word():
    for level in LEVELS:
        own.examine(tasks.Own(TASK, TrafficSettings(level=level, vision=1)))
    assert tasks.find("traffic_junction") is TASK and TASK.ragged(TrafficSettings())
    assert TASK.make(TrafficSettings(level="hard", vision=1)).observation_size == 56 + 128 + 1 + 9


def test_more_and_more_cars_arrive_where_that_is_asked_for():
    params, settings = TrafficJunction().default_params(), TrafficSettings(arrival_start=0.1)
    rates = [float(TASK.difficulty(settings, params, jnp.asarray(share)).arrival) for share in (0.0, 0.5, 1.0)]
    assert rates == pytest.approx([0.1, 0.2, 0.3])
    assert _moves(TASK, settings, params) and not _moves(TASK, TrafficSettings(), params)


def test_a_picture_shows_roads_cars_and_crashes():
    settings = TrafficSettings()
    state = on_easy((DOWN, 3, 3), (EAST, 3, 3), (EAST, 0, 0))
    found = scene(settings, state, NO_ONE)
    assert found.agents.positions[:3].tolist() == [[3.0, -3.0], [3.0, -3.0], [0.0, -3.0]]
    assert found.agents.there.tolist() == [True, True, True, False, False]
    assert found.agents.lit.tolist() == [True, True, False, False, False]
    assert found.agents.colour[:3].tolist() == [DOWN, EAST, EAST]
    assert found.lines.shape == (24, 2, 2)  # three cells of four arms have two sides each
    sides = {tuple(sorted(map(tuple, line))) for line in np.asarray(found.lines).tolist()}
    assert ((-0.5, -2.5), (0.5, -2.5)) in sides and ((2.5, -0.5), (2.5, 0.5)) in sides
    env = TASK.make(settings)
    actor = references.actor(TASK, "gas", env)
    look = references.look_of(TASK, settings)
    (episode,) = record_many(env, *actor, env.default_params(), KEY, 1, look=look)
    assert episode.scene is not None and episode.scene.agents.there.any()
    assert render.frame(episode, 10, words=TASK.words).width == 480


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        ({"level": "medum"}, "'medum'"),
        ({"vision": -1}, "env.vision must be between 0 and 6, not -1"),
        ({"level": "hard", "vision": 18}, "env.vision must be between 0 and 17, not 18"),
        ({"arrival_start": 1.5}, "env.arrival_start must be between 0 and 1, not 1.5"),
        ({"max_cycles": 0}, "env.max_cycles must be between 1 and 1000000, not 0"),
    ],
)
def test_settings_that_cannot_be_end_with_a_sentence(settings: dict[str, Any], sentence: str):
    with pytest.raises(ConfigError) as error:
        make_env("traffic_junction", **settings)
    assert sentence in str(error.value)


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--env.level", "medum"], "invalid choice 'medum' for argument '--env.level'"),
        (["--env.vision", "-1"], "env.vision must be between 0 and 6, not -1"),
        (["--preset", "paper"], "gacrl_paper knows teams of one size only"),
        (["--preset", "ippo", "--curriculum.gate", "0.5"], "curriculum.gate has nothing to hold back"),
    ],
)
def test_the_command_line_refuses_with_a_sentence(said: Callable[..., tuple[int, str]], words: Any, sentence: str):
    code, printed = said("train", "--env", "traffic_junction", *words)
    assert code == 2 and sentence in printed and len(printed.strip().splitlines()) == 1
