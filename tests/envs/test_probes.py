"""The switch riddle: its optima, found by playing all 729 ways in which three prisoners may be led into the room."""

import itertools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gacrl.envs.probes import NOBODY, TELL, RiddleState, SwitchRiddle

ENV = SwitchRiddle()
DAYS = ENV.max_cycles
KEY = jax.random.key(0)


class Walks(NamedTuple):
    """S = 3⁶ equally likely walks through D = 6 days, as the environment has them."""

    who: np.ndarray
    """Who is in the room [S D]."""
    worth: np.ndarray
    """What the team earns if that one tells [S D]."""
    inside: np.ndarray
    """Who sees that it is in the room, and may tell [S D N]."""
    hears: np.ndarray
    """Who hears whom [S D N N]."""


@pytest.fixture(scope="module")
def walks() -> Walks:
    who = jnp.array(list(itertools.product(range(ENV.num_agents), repeat=DAYS)))
    everyone_tells = jnp.full(ENV.num_agents, TELL)

    def walk(days: jax.Array):
        def one(state: RiddleState, day_who: tuple[jax.Array, jax.Array]):
            day, who = day_who
            state = ENV.enter(state, who)._replace(clock=day)
            seen, after = ENV.observe(state), ENV.step(state, everyone_tells, KEY)[1]
            inside = (seen.features[:, 0] == 1.0) & seen.action_mask[:, TELL]
            return state, (after.reward[0], inside, seen.adjacency)

        nobody = jnp.asarray(NOBODY)
        empty = RiddleState(nobody, nobody, jnp.zeros(ENV.num_agents, bool), jnp.asarray(0))
        return jax.lax.scan(one, empty, (jnp.arange(DAYS), days))[1]

    return Walks(np.asarray(who), *jax.device_get(jax.jit(jax.vmap(walk))(who)))


def value(walks: Walks, tells: np.ndarray) -> float:
    """What it brings to tell at the first day at which one does [S D]."""
    first = tells & (np.cumsum(tells, axis=1) == 1)
    return float((walks.worth * first).sum(1).mean())


def visits(walks: Walks) -> np.ndarray:
    """How often who is in the room has been there, this day included [S D]."""
    return np.array([[row[: day + 1].tolist().count(row[day]) for day in range(DAYS)] for row in walks.who])


def test_who_knows_at_once_earns_what_told_says(walks: Walks):
    assert value(walks, walks.worth == 1.0) == pytest.approx(ENV.told, abs=1e-6)
    assert ENV.told == pytest.approx(0.741, abs=1e-3)


def test_the_room_is_all_that_is_seen_and_yesterday_all_that_is_heard(walks: Walks):
    everyone = np.arange(ENV.num_agents)
    np.testing.assert_array_equal(walks.inside, walks.who[..., None] == everyone)
    yesterday = np.roll(walks.who, 1, axis=1)
    yesterday[:, 0] = NOBODY
    expected = walks.inside[..., :, None] & (everyone == yesterday[..., None])[..., None, :]
    np.testing.assert_array_equal(walks.hears, expected)


def test_one_bit_is_enough(walks: Walks):
    """Whoever comes for the first time says whether somebody came before; the others repeat what they hear."""
    tells = np.zeros(walks.who.shape, bool)
    for row, (who, hears) in enumerate(zip(walks.who, walks.hears, strict=True)):
        said = np.zeros(ENV.num_agents, bool)
        for day, here in enumerate(who):
            heard = bool((hears[day, here] & said).any())
            new = here not in who[:day]
            tells[row, day] = new and heard
            said[here] = (new and day > 0) or heard
    assert value(walks, tells) == pytest.approx(ENV.told, abs=1e-6)


def test_silence_brings_less(walks: Walks):
    """Without memory the best is to tell on the last day: .48. Of all sets of days and counts of one's own visits, the
    best is .53: on the last day except after more than three visits, and the day before on a first one."""
    days = np.arange(DAYS)
    sets = [np.isin(days, chosen) for n in range(DAYS + 1) for chosen in itertools.combinations(days, n)]
    forgetful = [value(walks, np.broadcast_to(chosen, walks.who.shape)) for chosen in sets]
    assert max(forgetful) == pytest.approx(2 * ENV.told - 1, abs=1e-6)
    assert sets[int(np.argmax(forgetful))].tolist() == [False] * 5 + [True]

    own = visits(walks)
    # At the other days and counts not all can have been there: to tell is a loss for certain.
    open_cases = [(day, count) for day in days for count in range(1, DAYS) if day + 1 - count >= 2]
    told_in = np.stack([(days == day) & (own == count) for day, count in open_cases])
    choices = list(itertools.product((False, True), repeat=len(open_cases)))
    counting = [value(walks, told_in[list(choice)].any(0)) for choice in choices]
    best = [case for case, chosen in zip(open_cases, choices[int(np.argmax(counting))], strict=True) if chosen]
    assert best == [(4, 1), (5, 1), (5, 2), (5, 3)]
    assert max(counting) == pytest.approx(130 / 243, abs=1e-6)


def test_the_riddle_ends_when_one_tells_or_time_is_up():
    state, seen = ENV.reset(KEY)
    assert seen.features.shape == (ENV.num_agents, ENV.observation_size) and seen.features[:, 0].sum() == 1.0
    for day in range(DAYS):
        state, after = ENV.step(state, jnp.zeros(ENV.num_agents, jnp.int32), KEY)
        assert bool(after.terminated) == (day == DAYS - 1) and not after.truncated
        np.testing.assert_array_equal(after.reward, 0.0)
    state, _ = ENV.reset(KEY)
    outside = jnp.where(jnp.arange(ENV.num_agents) == state.today, 0, TELL)
    assert not ENV.step(state, outside, KEY)[1].terminated
    after = ENV.step(state, jnp.full(ENV.num_agents, TELL), KEY)[1]
    assert after.terminated and after.reward.tolist() == [-1.0] * 3
