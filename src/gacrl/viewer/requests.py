"""What a page may ask for, read from text that nobody can be trusted to have written. Imports no jax.

A message asks for a scene (a seed, a number of agents, and what was done at which step) or for frames of it. Each
number is whole or finite and in its bounds; everything else is refused in one sentence.
"""

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import pairwise, zip_longest
from types import MappingProxyType
from typing import Any, NamedTuple, TypeAlias

from gacrl.errors import UserError

MOST_BYTES = 64 * 1024
"""Of one message."""
MOST_EVENTS = 400
MOST_FRAMES = 64
"""That are asked for at once."""
MOST_SEED = 2**31 - 1
FAR = 1000.0
"""Beyond it nothing is put, in the task's own units."""


class Refused(UserError):
    """A message that cannot be followed."""


class Bounds(NamedTuple):
    """What numbers of a message must fit."""

    least: int
    most: int
    """Agents."""
    length: int
    """Steps of an episode."""
    rounds: int = 0
    vocabulary: int = 0
    """Words that a visitor can say; 0 where agents do not say symbols."""
    movable: bool = False
    """A hand may move things."""
    reach: bool = False
    """Agents hear each other within a radius."""


class Fate(NamedTuple):
    """What happens to the words of one agent: silence, swap, scramble, delay, drop, or speak."""

    kind: str
    other: int = -1
    """With whose words it is swapped."""
    spoken: tuple[int, ...] = ()
    """A visitor's word for each round."""


class Event(NamedTuple):
    """Something that a visitor did before step `at`."""

    at: int
    kind: str
    """fate, radius, cut, move, add or remove."""
    agent: int = -1
    fate: Fate | None = None
    value: float = 0.0
    edge: tuple[int, int] = (-1, -1)
    on: bool = False
    thing: str = ""
    which: int = -1
    place: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class Scene:
    """An episode: where it starts, and all that was done. Two equal ones are the same episode."""

    seed: int
    count: int
    events: tuple[Event, ...] = ()


class Wanted(NamedTuple):
    """A request for the scene `version` as it is from now on."""

    version: int
    scene: Scene


class Frames(NamedTuple):
    """A request for the frames from `first` up to `last` of the scene `version`."""

    version: int
    first: int
    last: int


Request: TypeAlias = Wanted | Frames


def read(text: str | bytes, bounds: Bounds) -> Request:
    """Return what a message asks for. Raises Refused, with a sentence for who sent it."""
    if not isinstance(text, str):
        raise Refused("messages are text, not bytes")
    if len(text.encode("utf-8", "surrogatepass")) > MOST_BYTES:
        raise Refused(f"a message has at most {MOST_BYTES:,} bytes")
    try:
        message = json.loads(text)
    except (ValueError, RecursionError):
        raise Refused("a message is a JSON object") from None
    if not isinstance(message, dict):
        raise Refused("a message is a JSON object")
    kind = message.pop("kind", None)
    if kind == "scene":
        return _scene(_Fields(message), bounds)
    if kind == "frames":
        return _frames(_Fields(message), bounds)
    raise Refused("the kind of a message is scene or frames")


class _Fields:
    """The fields of an object, each taken once and checked."""

    def __init__(self, fields: Mapping[Any, Any]) -> None:
        self._left = dict(fields)

    def whole(self, name: str, least: int, most: int) -> int:
        value = self._left.pop(name, None)
        if type(value) is not int or not least <= value <= most:
            raise Refused(f"{name} is a whole number between {least} and {most}")
        return value

    def number(self, name: str, least: float, most: float) -> float:
        value = self._left.pop(name, None)
        if type(value) not in (int, float):
            raise Refused(f"{name} is a number")
        try:
            value = float(value)
        except OverflowError:
            value = math.inf
        if not (math.isfinite(value) and least <= value <= most):
            raise Refused(f"{name} is a number between {least:g} and {most:g}")
        return value

    def flag(self, name: str) -> bool:
        value = self._left.pop(name, None)
        if type(value) is not bool:
            raise Refused(f"{name} is true or false")
        return value

    def one_of(self, name: str, known: tuple[str, ...]) -> str:
        value = self._left.pop(name, None)
        if not isinstance(value, str) or value not in known:
            raise Refused(f"{name} is one of {', '.join(known)}")
        return value

    def several(self, name: str, most: int) -> list[Any]:
        value = self._left.pop(name, None)
        if not isinstance(value, list) or len(value) > most:
            raise Refused(f"{name} is a list of at most {most}")
        return value

    def inner(self, name: str) -> "_Fields | None":
        value = self._left.pop(name, None)
        if value is not None and not isinstance(value, dict):
            raise Refused(f"{name} is an object or null")
        return None if value is None else _Fields(value)

    def end(self) -> None:
        if self._left:
            raise Refused(f"there are fields that nobody knows, {len(self._left)} of them")


def _scene(fields: _Fields, bounds: Bounds) -> Wanted:
    version = fields.whole("version", 0, MOST_SEED)
    seed, count = fields.whole("seed", 0, MOST_SEED), fields.whole("count", bounds.least, bounds.most)
    events = tuple(_event(it, bounds) for it in fields.several("events", MOST_EVENTS))
    fields.end()
    _require_order(events, count, bounds)
    return Wanted(version, Scene(seed, count, events))


def _require_order(events: tuple[Event, ...], count: int, bounds: Bounds) -> None:
    if any(later.at < earlier.at for earlier, later in pairwise(events)):
        raise Refused("events stand in the order of their steps")
    for event in events:
        count += (event.kind == "add") - (event.kind == "remove")
        if not bounds.least <= count <= bounds.most:
            raise Refused(f"there are between {bounds.least} and {bounds.most} agents")


def _frames(fields: _Fields, bounds: Bounds) -> Frames:
    version = fields.whole("version", 0, MOST_SEED)
    first = fields.whole("first", 0, bounds.length)
    last = fields.whole("last", first, min(first + MOST_FRAMES - 1, bounds.length))
    fields.end()
    return Frames(version, first, last)


def _event(given: Any, bounds: Bounds) -> Event:
    if not isinstance(given, dict):
        raise Refused("an event is an object")
    fields = _Fields(given)
    at, kind = fields.whole("at", 0, bounds.length), fields.one_of("kind", tuple(_EVENTS))
    event = _EVENTS[kind](fields, bounds)._replace(at=at, kind=kind)
    fields.end()
    return event


def _require(able: bool, what: str) -> None:
    if not able:
        raise Refused(what)


def _fate(fields: _Fields, bounds: Bounds) -> Event:
    _require(bounds.rounds > 0, "these agents say nothing")
    agent, inner = fields.whole("agent", 0, bounds.most - 1), fields.inner("fate")
    if inner is None:
        return Event(0, "", agent=agent)
    kind = inner.one_of("kind", ("silence", "swap", "scramble", "delay", "drop", "speak"))
    fate = Fate(kind)
    if kind == "swap":
        fate = fate._replace(other=inner.whole("value", 0, bounds.most - 1))
    if kind == "speak":
        _require(bounds.vocabulary > 0, "these agents do not speak in symbols")
        spoken = inner.several("value", bounds.rounds)
        words = tuple(_Fields({"word": word}).whole("word", 0, bounds.vocabulary - 1) for word in spoken)
        _require(len(words) == bounds.rounds, f"to speak takes {bounds.rounds} words, one for each round")
        fate = fate._replace(spoken=words)
    inner.end()
    return Event(0, "", agent=agent, fate=fate)


def _radius(fields: _Fields, bounds: Bounds) -> Event:
    _require(bounds.reach, "who hears whom does not depend on a radius here")
    return Event(0, "", value=fields.number("value", 0.0, FAR))


def _cut(fields: _Fields, bounds: Bounds) -> Event:
    _require(bounds.rounds > 0, "these agents say nothing")
    ends = fields.whole("a", 0, bounds.most - 1), fields.whole("b", 0, bounds.most - 1)
    _require(ends[0] != ends[1], "an edge lies between two agents")
    return Event(0, "", edge=(min(ends), max(ends)), on=fields.flag("on"))


def _move(fields: _Fields, bounds: Bounds) -> Event:
    _require(bounds.movable, "nothing can be moved in this task")
    thing, which = fields.one_of("thing", ("agent", "mark")), fields.whole("index", 0, 9_999)
    place = fields.number("x", -FAR, FAR), fields.number("y", -FAR, FAR)
    return Event(0, "", thing=thing, which=which, place=place)


def _team(fields: _Fields, bounds: Bounds) -> Event:
    return Event(0, "")


_EVENTS: Mapping[str, Callable[[_Fields, Bounds], Event]] = MappingProxyType(
    {"fate": _fate, "radius": _radius, "cut": _cut, "move": _move, "add": _team, "remove": _team}
)


class Standing(NamedTuple):
    """What holds at a step."""

    fates: dict[int, Fate]
    radius: float | None
    cuts: frozenset[tuple[int, int]]


def standing(scene: Scene, t: int) -> Standing:
    """Return what holds in step t of a scene."""
    fates: dict[int, Fate] = {}
    radius: float | None = None
    cuts: set[tuple[int, int]] = set()
    for event in scene.events:
        if event.at > t:
            break
        if event.kind == "fate" and event.fate is None:
            fates.pop(event.agent, None)
        elif event.kind == "fate" and event.fate is not None:
            fates[event.agent] = event.fate
        elif event.kind == "radius":
            radius = event.value
        elif event.kind == "cut":
            (cuts.add if event.on else cuts.discard)(event.edge)
    return Standing(fates, radius, frozenset(cuts))


def first_difference(one: Scene, other: Scene) -> int:
    """Return the first step in which two scenes may differ; a step past every episode where they do not."""
    if (one.seed, one.count) != (other.seed, other.count):
        return 0
    for ours, theirs in zip_longest(one.events, other.events):
        if ours != theirs:
            return min(event.at for event in (ours, theirs) if event is not None)
    return MOST_SEED
