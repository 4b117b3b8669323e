"""What a page shows is what the policy does: the same words, places and rewards as everywhere else in the library."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import soaked
from serving import cast_of

from gacrl import Environment, Task, TimeStep, observe, rollout
from gacrl.messages import interventions
from gacrl.tasks import own
from gacrl.types import Arrives, Intervention
from gacrl.viewer.cast import open_cast
from gacrl.viewer.requests import Bounds, Event, Fate, Scene
from gacrl.viewer.show import Show

SPOKEN = Arrives(
    jnp.zeros((2, 2, 16)).at[:, 0].set(jax.nn.one_hot(jnp.array([2, 8]), 16)),
    jnp.zeros((2, 2), bool).at[:, 0].set(True),
)
CASES: dict[str, tuple[Intervention | None, dict[int, Fate]]] = {
    "nothing": (None, {}),
    "silence": (interventions.silence([1]), {1: Fate("silence")}),
    "swap": (interventions.swap(0, 1), {0: Fate("swap", other=1), 1: Fate("swap", other=0)}),
    "delay": (interventions.delay(3), {0: Fate("delay"), 1: Fate("delay")}),
    "speak": (interventions.arriving(SPOKEN), {0: Fate("speak", spoken=(2, 8))}),
}


def fated(fates: dict[int, Fate]) -> tuple[Event, ...]:
    return tuple(Event(0, "fate", agent=agent, fate=fate) for agent, fate in fates.items())


def test_the_untouched_lane_plays_with_the_parameters_of_the_other(monkeypatch: pytest.MonkeyPatch):
    """A run that is being trained has newer ones from each new start on, and not from a silence on."""
    cast = cast_of("pretrained:gacrl-reference")
    show, player, kept = Show(cast), cast.players[0], cast.players[0].learner
    whole = [(show.take(Scene(5, 2, ())), show.frame(t))[1]["main"]["agents"] for t in range(8)]
    newer = jax.tree.map(lambda leaf: -leaf if jnp.ndim(leaf) == 2 else leaf, kept)  # weights
    monkeypatch.setattr(player, "learner", newer)
    show.take(Scene(5, 2, (Event(3, "fate", agent=1, fate=Fate("silence")),)))
    assert [show.frame(t)["twin"]["agents"] for t in range(8)] == whole
    show.take(Scene(5, 2, fated({1: Fate("silence")})))
    assert show.frame(4)["twin"]["agents"] != whole[4]
    assert show.main.learner is show.twin.learner is newer


@pytest.mark.parametrize("case", soaked(CASES, "swap", "delay"))
def test_what_happens_to_words_happens_as_in_evaluation(case: str):
    cast = cast_of("pretrained:gacrl-reference")
    happens, fates = CASES[case]
    show, player = Show(cast), cast.players[0]
    show.take(Scene(5, 2, fated(fates)))
    frames = [show.frame(t) for t in range(26)]
    opened = player.opened
    assert opened is not None
    env, params, policy = opened.env, opened.trainer.evaluation_params, opened.policy(0, False)
    carry = rollout.start(env, params, (), jax.random.key(0), 1, happens, policy)
    start = player.room(2).reset(params, 5)
    state, seen = jax.tree.map(lambda leaf: leaf[None], (start.state, start.seen))
    carry = carry._replace(env_state=state, observation=seen)

    def one(carry: rollout.Carry, key: jax.Array):
        after, step = rollout.act(env, policy, params, carry, jax.random.split(key, (1, 3)), happens)
        return after, (carry.env_state.positions, step.decision.messages.argmax(-1), step.info["reward_raw"])

    _, (places, words, rewards) = jax.jit(lambda carry, keys: jax.lax.scan(one, carry, keys))(
        carry, jax.random.split(jax.random.key(4), 25)
    )
    mine = [frame["main"] for frame in frames]
    shown = np.array([[frame["agents"]["x"], frame["agents"]["y"]] for frame in mine[:25]])
    np.testing.assert_allclose(shown, np.moveaxis(np.asarray(places[:, 0]), 1, 2), atol=1e-3)
    assert [frame["said"] for frame in mine[:25]] == words[:, 0].tolist()
    assert mine[25]["earned"] == pytest.approx(float(rewards.sum()), abs=1e-2)
    assert mine[25]["over"] and not mine[24]["over"]
    assert (frames[3]["twin"] is None) == (case == "nothing")


def test_a_moment_comes_back_and_only_what_changed_is_played_again():
    show = Show(cast_of("pretrained:gacrl-reference"))
    show.take(Scene(3, 2))
    first = [show.frame(t)["main"] for t in range(26)]
    kept = list(show.main.moments)
    show.take(Scene(3, 2, (Event(9, "move", thing="mark", which=1, place=(0.25, -0.5)),)))
    assert [a is b for a, b in zip(show.main.moments, kept, strict=False)] == [True] * 9
    moved = show.frame(9)["main"]
    assert (moved["marks"]["x"][1], moved["marks"]["y"][1]) == (0.25, -0.5) and show.frame(9)["twin"] is None
    show.take(Scene(3, 2))
    assert [show.frame(t)["main"] for t in range(26)] == first
    show.take(Scene(3 + 7919, 2))
    elsewhere = [show.frame(t)["main"]["said"] for t in range(26)]
    show.take(Scene(3, 2, fated({0: Fate("scramble"), 1: Fate("scramble")})))
    assert [show.frame(t)["main"]["arrived"] for t in range(26)] == elsewhere
    assert show.frame(25)["twin"] == first[25]


def test_agents_come_and_go_and_a_radius_silences():
    """A team that grows in the middle of an episode goes on from where it stood, and plays as one that began so large."""
    cast = cast_of("pretrained:gacrl-teams")
    player, show = cast.players[0], Show(cast)
    assert cast.bounds[:2] == (1, 100) and player.sizes == (5, 32, 100)
    show.take(Scene(1, 5, (Event(4, "add"), Event(4, "add"), Event(6, "remove"))))
    before, after, fewer = (show.frame(t)["main"] for t in (3, 4, 6))
    assert (before["count"], after["count"], fewer["count"]) == (5, 7, 6)
    state = show.main.moments[4].state
    assert len(after["agents"]["x"]) == 7 and sum(after["marks"]["there"]) == 7
    moved = np.abs(np.subtract(after["agents"]["x"][:5], before["agents"]["x"])).max()
    assert moved < 0.25 and np.isfinite(state.positions).all() and after["earned"] < before["earned"]
    assert show.frame(5)["main"]["earned"] < after["earned"]
    show.take(Scene(1, 7))
    assert sum(map(len, show.frame(0)["main"]["hears"])) > 0
    show.take(Scene(1, 7, (Event(0, "radius", value=0.01),)))
    muted = show.frame(0)
    assert sum(map(len, muted["main"]["hears"])) == 0 < sum(map(len, muted["twin"]["hears"]))
    with pytest.raises(StopIteration):
        player.places(101)


@dataclass(frozen=True)
class Walk(Environment):
    """Two agents, a place to go to, and no scene: where they are is all that is known."""

    max_cycles: int = 6
    num_agents = 2
    num_actions = 2
    observation_size = 2

    def reset(self, key, params=()):
        state = jax.random.uniform(key, (2, 2)), jnp.asarray(0)
        return state, self.look(state)

    def step(self, state, action, key, params=()):
        places, clock = state
        state = places + 0.1 * action[:, None], clock + 1
        return state, TimeStep(self.look(state), action * 1.0, state[1] > 3, state[1] >= self.max_cycles)

    def seen_in(self, state, params=()):
        return self.look(state)

    def look(self, state):
        return observe(state[0], num_actions=2, positions=state[0])


def test_a_task_of_ones_own_can_be_watched_and_moved(from_outside: None):
    """Episodes that end early are over there; what a hand moves is where it was put, and goes on from there."""

    def edit(state, hand):
        return jnp.where(hand.agents.moved[:, None], hand.agents.positions, state[0]), state[1]

    own.bring(Task("walk", Walk, lambda settings: settings, edit=edit))
    cast = open_cast(["random"], task="walk")
    assert cast.bounds == Bounds(2, 2, 6, movable=True)
    show = Show(cast)
    show.take(Scene(1, 2, (Event(2, "move", thing="agent", which=1, place=(5.0, 7.0)),)))
    frames = [show.frame(t)["main"] for t in range(6)]
    assert [frame["over"] for frame in frames] == [False] * 4 + [True] * 2 and frames[4] == frames[5]
    assert (frames[2]["agents"]["x"][1], frames[2]["agents"]["y"][1]) == (5.0, 7.0)
    assert 5.0 <= frames[3]["agents"]["x"][1] <= 5.1 and frames[0]["agents"]["radius"][0] > 0


def test_any_task_can_be_watched():
    """Cars that come and go, with the actions of a script; and two policies beside each other."""
    cars = open_cast(["yielder"], task="traffic_junction")
    show = Show(cars)
    show.take(Scene(2, cars.bounds.least))
    frames = [show.frame(t)["main"] for t in range(20)]
    there = [sum(frame["agents"]["there"]) for frame in frames]
    assert max(there) > 1 and len(frames[0]["lines"]) > 4 and cars.bounds.rounds == 0 and not cars.bounds.movable
    both = open_cast(["told", "silent"], task="reference")
    rivals = Show(both)
    rivals.take(Scene(2, 2))
    pair = rivals.frame(25)
    assert rivals.frame(0)["main"]["agents"] == rivals.frame(0)["twin"]["agents"]
    assert pair["main"]["earned"] > pair["twin"]["earned"] + 1


def test_what_is_told_of_a_decision_is_how_it_came_about(quick_start: None):
    """The word that is said is the likeliest, the action that is taken looks best; attention is what listeners have."""
    show = Show(cast_of("pretrained:gacrl-reference"))
    show.take(Scene(5, 2, (Event(0, "move", thing="mark", which=2, place=(0.5, -0.25)),)))
    moments = [show.frame(t)["main"] for t in range(25)]
    for moment in moments:
        assert [[words[0] for words in said] for said in moment["words"]] == moment["said"]
        assert all(0 < words[1] <= 100 and words[1] >= words[3] for said in moment["words"] for words in said)
        assert [int(np.argmax(values)) for values in moment["values"]] == moment["actions"]
        assert moment["heeded"] == [[100], [100]], "whoever hears one agent alone heeds it alone"
        places = np.array([moment["marks"]["x"], moment["marks"]["y"]]).T
        for agent, (marks, others, more) in enumerate(moment["sees"]):
            here = np.array([moment["agents"]["x"][agent], moment["agents"]["y"][agent]])
            assert marks == np.argsort(np.hypot(*(places - here).T)).tolist() and (others, more) == ([], 0)
    goals = [moments[0]["marks"]["colour"].index(colour) for colour in moments[0]["agents"]["colour"]]
    assert [looks[0] for looks in moments[12]["looks"]] == goals, "they look at what they were told"
    show.take(Scene(5, 2, fated({0: Fate("silence")})))
    assert show.frame(3)["main"]["heeded"] == [[100], []]


def test_attention_in_a_crowd_is_shared_among_whom_one_hears(quick_start: None):
    show = Show(cast_of("pretrained:gacrl-teams"))
    show.take(Scene(1, 20, (Event(0, "radius", value=10.0),)))
    moment = show.frame(2)["main"]
    assert set(map(len, moment["hears"])) == {12}, "its nearest ones"
    for heard, shares in zip(moment["hears"], moment["heeded"], strict=True):
        assert len(heard) == len(shares) and abs(sum(shares) - 100) <= 7
    for marks, others, more in moment["sees"]:
        assert len(marks) == len(others) == 4 and more == 20 + 19 - 8


def test_a_jump_is_played_in_slices(quick_start: None):
    show = Show(cast_of("pretrained:gacrl-reference"))
    show.take(Scene(8, 2, fated({0: Fate("scramble")})))
    slices = 0
    while not show.toward(20, 0.0):
        slices += 1
    assert slices > 40, "a step at a time: of the run elsewhere, of this one and of the untouched one"
    whole = Show(cast_of("pretrained:gacrl-reference"))
    whole.take(Scene(8, 2, fated({0: Fate("scramble")})))
    assert whole.frame(20) == show.frame(20)
