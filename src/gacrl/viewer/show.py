"""One visitor's episode, step by step: what was made of it, and beside it the untouched one, or another policy's.

A scene is a seed and a list of what was done at which step, so that everything else follows: what was computed is kept
up to the first step that changed, and the rest is played again when it is asked for.
"""

import math
import time
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from gacrl.envs.environment import EnvState
from gacrl.scene import Edit, Placed
from gacrl.types import Learner
from gacrl.viewer.cast import AnyRoom, Cast, Player
from gacrl.viewer.pictures import picture
from gacrl.viewer.requests import MOST_SEED, Event, Scene, Standing, first_difference, standing
from gacrl.viewer.rooms import Decided, Meddling, Stood

_MEDDLING = ("fate", "radius", "cut")
"""What is done to words and edges. Everything else happens in the untouched run as well."""
_ELSEWHERE = 7919
"""So many seeds away is the episode that scrambled words come from."""
LATE = 3
"""Steps that a delayed word takes."""
LOST = 0.5
"""Share of the edges that lose a word where words are dropped."""


class Moment(NamedTuple):
    """What is kept of a step."""

    room: AnyRoom
    places: int
    team: int
    """Agents that are there."""
    state: EnvState
    decided: Decided
    said: np.ndarray | None
    """What each agent says, [R, N, V]."""
    earned: float
    measured: dict[str, float]
    over: bool
    shown: dict[str, Any]
    """The picture, as plain data."""


class Lane:
    """An episode of one policy. meddled: whether what is done to words is done here."""

    def __init__(self, player: Player, meddled: bool, shift: int = 0) -> None:
        self.player, self.meddled, self._shift = player, meddled, shift
        self.moments: list[Moment] = []
        self.scene: Scene | None = None
        self.learner: Learner = player.learner
        self._elsewhere = Lane(player, False, _ELSEWHERE) if meddled else None
        self.size = 0.0

    def take(self, scene: Scene) -> None:
        """Play this scene from now on, and keep what of it is known. A new start takes the newest parameters."""
        seed = (scene.seed + self._shift) % MOST_SEED
        mine = Scene(seed, scene.count, scene.events if self.meddled else untouched(scene))
        same = 0 if self.scene is None else first_difference(self.scene, mine)
        del self.moments[same:]
        self.scene = mine
        if not self.moments:
            self.learner = self.player.learner
        if self._elsewhere is not None:
            self._elsewhere.take(scene)
            self._elsewhere.play_as(self)

    def play_as(self, other: "Lane") -> None:
        """Play with the parameters of another lane, from the beginning if they are others than until now."""
        if self.learner is not other.learner:
            self.moments.clear()
            self.learner = other.learner

    def through(self, t: int) -> Moment:
        """Return step t, or the last one of an episode that is over before."""
        while not self.knows(t):
            self.moments.append(self._next())
        return self.moments[min(t, len(self.moments) - 1)]

    def toward(self, t: int, ends: float) -> bool:
        """Play on to step t until the clock says `ends`; returns whether it is there."""
        if self._elsewhere is not None and self._scrambled(t) and not self._elsewhere.toward(t, ends):
            return False
        while not self.knows(t):
            self.moments.append(self._next())
            if time.monotonic() > ends:
                break
        return self.knows(t)

    def knows(self, t: int) -> bool:
        """Return whether step t is played, or the episode is over before."""
        return len(self.moments) > t or bool(self.moments and self.moments[-1].over)

    def _scrambled(self, t: int) -> bool:
        events = () if self.scene is None else self.scene.events
        return any(event.fate is not None and event.fate.kind == "scramble" for event in events if event.at <= t)

    def _next(self) -> Moment:
        scene, player, t = self.scene, self.player, len(self.moments)
        assert scene is not None, "a lane takes a scene first"
        places, count, stood, earned, measured, over = self._stepped(scene, t)
        here = [event for event in scene.events if event.at == t]
        now = count + sum((event.kind == "add") - (event.kind == "remove") for event in here)
        if now != count:
            places, stood = self._resized(stood, places, count, now, t)
        room, params = player.room(places), player.params(places, now)
        hand = _hand(here, places, now, room.marks)
        if hand is not None:
            stood = room.edited(params, stood, hand)
        meddling, rules = None, standing(scene, t)
        if self.meddled and any(event.kind in _MEDDLING for event in scene.events if event.at <= t):
            meddling = self._meddling(rules, t, places)
        decided = room.decide(self.learner, params, stood, scene.seed, t, meddling)
        seen = jax.device_get(decided._replace(memory=()))
        if t == 0:
            self.size = float(np.ptp(seen.scene.agents.positions, axis=0).max(initial=0.0)) / 20
        shown = picture(seen, now, meddling, self.size)
        shown |= {"earned": round(earned, 4), "measured": measured, "over": over, "count": now}
        drawn = room.drawn(stood.state)
        shown |= {} if drawn is None else {"drawn": drawn}
        return Moment(room, places, now, stood.state, decided, seen.messages, earned, measured, over, shown)

    def _stepped(self, scene: Scene, t: int) -> tuple[int, int, Stood, float, dict[str, float], bool]:
        """Take the step before step t: the room, who is in it and how it stands there, and what was earned so far."""
        player = self.player
        if t == 0:
            places, measures = player.places(scene.count), player.measures
            stood = player.room(places).reset(player.params(places, scene.count), scene.seed)
            return places, scene.count, stood, 0.0, dict.fromkeys(measures, 0.0), False
        before = self.moments[-1]
        params = player.params(before.places, before.team)
        stood, happened = before.room.step(params, before.state, before.decided, scene.seed, t - 1)
        happened = jax.device_get(happened)
        summed = player.summed
        measured = {
            name: round(float(happened.measured[measure]) + before.measured[name] * (measure in summed), 4)
            for name, measure in player.measures.items()
        }
        earned, over = before.earned + float(happened.reward), bool(happened.over)
        return before.places, before.team, stood, earned, measured, over

    def _resized(self, stood: Stood, places: int, count: int, now: int, t: int) -> tuple[int, Stood]:
        """Let agents come or go, in a larger room where this one has too few places."""
        player, scene = self.player, self.scene
        assert scene is not None, "a lane takes a scene first"
        wider = places if places >= now and places != player.home else player.places_beside(now)
        room, params = player.room(wider), player.params(wider, now)
        return wider, room.joined(params, stood.state, count, now, scene.seed, t)

    def _meddling(self, rules: Standing, t: int, places: int) -> Meddling | None:
        """Return what happens to the words of step t, in numbers."""
        shape = self.player.room(places).words
        if shape is None:
            return None
        rounds, agents, symbols = shape
        radius = (self.player.reach or 0.0) if rules.radius is None else rules.radius
        meddling = Meddling.none(shape)._replace(radius=float(radius))
        values, replaced, other, kept, _ = meddling
        for one, two in rules.cuts:
            if max(one, two) < agents:
                kept[one, two] = kept[two, one] = False
        for agent, fate in rules.fates.items():
            if agent >= agents:
                continue
            if fate.kind == "silence" or (fate.kind == "delay" and t < LATE):
                kept[:, agent] = False
            elif fate.kind == "drop":
                lost = np.random.default_rng([self._seed, t, agent]).random(agents) < LOST
                kept[lost, agent] = False
            elif fate.kind == "swap" and fate.other < agents:
                other[agent] = fate.other
            elif fate.kind in ("delay", "scramble"):
                words = self._words_of(fate.kind, t)
                if words is not None and agent < words.shape[1]:
                    values[:, agent], replaced[:, agent] = words[:, agent], True
            elif fate.kind == "speak":
                for number, word in enumerate(fate.spoken[:rounds]):
                    if word < symbols:
                        values[number, agent, word], replaced[number, agent] = 1.0, True
        return meddling

    @property
    def _seed(self) -> int:
        assert self.scene is not None
        return self.scene.seed

    def _words_of(self, kind: str, t: int) -> np.ndarray | None:
        """Return what is heard in place of the words of step t: earlier ones, or those of another episode."""
        if kind == "delay":
            return self.moments[t - LATE].said
        return None if self._elsewhere is None else self._elsewhere.through(t).said


class Show:
    """What one visitor sees: a scene in one lane, or in two that run in lockstep."""

    def __init__(self, cast: Cast) -> None:
        self._rivals = len(cast.players) > 1
        self.main = Lane(cast.players[0], True)
        self.twin = Lane(cast.players[-1], self._rivals)
        self.scene: Scene | None = None

    def take(self, scene: Scene) -> None:
        """Show this scene from now on."""
        self.main.take(scene)
        self.twin.take(scene)
        if not self._rivals:
            self.twin.play_as(self.main)  # untouched, and otherwise the same
        self.scene = scene

    def frame(self, t: int) -> dict[str, Any]:
        """Return step t as plain data: {t, main, twin}; no twin where nothing was done to words.

        An episode that ends before is at its last step there.
        """
        self.toward(t)
        twin = self.twin.through(t).shown if self._twinned else None
        return {"t": t, "main": self.main.through(t).shown, "twin": twin}

    def toward(self, t: int, patience: float = math.inf) -> bool:
        """Play on to step t for so many seconds; returns whether it can be shown now. Ask again to go on."""
        ends = time.monotonic() + patience
        if not self.main.toward(t, ends) or not self._twinned:
            return self.main.knows(t)
        if not self._rivals:  # until then nothing was meddled with
            known = len(self.twin.moments)
            self.twin.moments += self.main.moments[known : self._begins]
            self.twin.size = self.main.size
        return self.twin.toward(t, ends)

    @property
    def _begins(self) -> int | None:
        """The step in which words or edges are meddled with for the first time."""
        assert self.scene is not None, "a show takes a scene first"
        return next((event.at for event in self.scene.events if event.kind in _MEDDLING), None)

    @property
    def _twinned(self) -> bool:
        return self._rivals or self._begins is not None


def untouched(scene: Scene) -> tuple[Event, ...]:
    """Return what was done to a scene, without what was done to words and edges."""
    return tuple(event for event in scene.events if event.kind not in _MEDDLING)


def _hand(here: Sequence[Event], places: int, count: int, marks: int) -> Edit | None:
    """Return what a hand moves in a step, the last place of each thing; None where it moves nothing."""
    moves = [event for event in here if event.kind == "move"]
    if not moves:
        return None
    groups = {
        "agent": Placed(np.zeros((places, 2), np.float32), np.zeros(places, bool)),
        "mark": Placed(np.zeros((marks, 2), np.float32), np.zeros(marks, bool)),
    }
    for event in moves:
        positions, moved = groups[event.thing]
        if event.which < (count if event.thing == "agent" else marks):
            positions[event.which], moved[event.which] = event.place, True
    return Edit(groups["agent"], groups["mark"])
