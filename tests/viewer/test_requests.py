"""What pages send is read with distrust: numbers in their bounds, or one sentence."""

import json
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gacrl.viewer.requests import (
    MOST_BYTES,
    MOST_EVENTS,
    Bounds,
    Event,
    Fate,
    Frames,
    Refused,
    Scene,
    Wanted,
    first_difference,
    read,
    standing,
)

BOUNDS = Bounds(least=2, most=5, length=25, rounds=2, vocabulary=16, movable=True, reach=True)
MUTE = Bounds(least=2, most=2, length=25)


def scene(*events: Any, **changed: Any) -> str:
    return json.dumps({"kind": "scene", "version": 1, "seed": 7, "count": 3, "events": events, **changed})


def test_a_scene_and_what_holds_in_it():
    events = (
        {"at": 0, "kind": "fate", "agent": 1, "fate": {"kind": "speak", "value": [3, 15]}},
        {"at": 0, "kind": "fate", "agent": 0, "fate": {"kind": "swap", "value": 2}},
        {"at": 2, "kind": "move", "thing": "mark", "index": 0, "x": 0.5, "y": -1},
        {"at": 2, "kind": "radius", "value": 0.25},
        {"at": 3, "kind": "cut", "a": 2, "b": 0, "on": True},
        {"at": 4, "kind": "fate", "agent": 1, "fate": None},
        {"at": 5, "kind": "add"},
    )
    wanted = read(scene(*events), BOUNDS)
    assert isinstance(wanted, Wanted) and wanted.version == 1
    found = wanted.scene
    assert (found.seed, found.count, found.events[2].place) == (7, 3, (0.5, -1.0))
    assert standing(found, 3).fates == {1: Fate("speak", spoken=(3, 15)), 0: Fate("swap", other=2)}
    assert standing(found, 3).cuts == {(0, 2)} and standing(found, 1).radius is None
    assert standing(found, 9).fates.keys() == {0} and standing(found, 9).radius == 0.25
    assert read('{"kind":"frames","version":1,"first":3,"last":9}', BOUNDS) == Frames(1, 3, 9)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (b"\x00", "text"),
        ("x" * (MOST_BYTES + 1), "at most"),
        ("[" * 50_000, "JSON object"),
        ("[]", "JSON object"),
        ('{"kind": "policy", "run": "/etc/passwd"}', "scene or frames"),
        (scene(count=6), "count is a whole number between 2 and 5"),
        (scene(count=True), "count"),
        (scene(count=3.0), "count"),
        (scene(seed=-1), "seed"),
        (scene(seed=10**400)[:-1] + "}", "seed|JSON"),
        (scene(run="pretrained:gacrl"), "fields that nobody knows"),
        (scene(events="abc"), "list"),
        (scene(*[{"at": 0, "kind": "add"}] * (MOST_EVENTS + 1)), "at most"),
        (scene({"at": 0, "kind": "add"}, {"at": 0, "kind": "add"}, {"at": 0, "kind": "add"}), "between 2 and 5 agents"),
        (scene({"at": 3, "kind": "add"}, {"at": 1, "kind": "remove"}), "order"),
        (scene({"at": 26, "kind": "add"}), "at is"),
        (scene({"at": 0, "kind": "eval"}), "kind is one of"),
        (scene({"at": 0, "kind": ["fate"]}), "kind is one of"),
        (scene({"at": 0, "kind": "fate", "agent": 5, "fate": None}), "agent"),
        (scene({"at": 0, "kind": "fate", "agent": 0, "fate": {"kind": "silence", "also": 1}}), "nobody knows"),
        (scene({"at": 0, "kind": "fate", "agent": 0, "fate": {"kind": "speak", "value": [16, 0]}}), "word"),
        (scene({"at": 0, "kind": "fate", "agent": 0, "fate": {"kind": "speak", "value": [1]}}), "2 words"),
        (scene({"at": 0, "kind": "radius", "value": float("nan")}), "value"),
        (scene({"at": 0, "kind": "radius", "value": -0.1}), "value"),
        (scene({"at": 0, "kind": "cut", "a": 1, "b": 1, "on": True}), "between two agents"),
        (scene({"at": 0, "kind": "cut", "a": 1, "b": 0, "on": 1}), "true or false"),
        (scene({"at": 0, "kind": "move", "thing": "mark", "index": 0, "x": 1e999, "y": 0}), "x is a number"),
        (scene({"at": 0, "kind": "move", "thing": "__proto__", "index": 0, "x": 0, "y": 0}), "thing"),
        ('{"kind":"frames","version":1,"first":9,"last":3}', "last"),
        ('{"kind":"frames","version":1,"first":0,"last":26}', "last"),
    ],
    ids=lambda it: it[:60].decode("latin1") if isinstance(it, bytes) else it[:60],
)  # fmt: skip
def test_anything_else_is_refused_in_a_sentence(text: str | bytes, says: str):
    with pytest.raises(Refused, match=says) as refused:
        read(text, BOUNDS)
    assert len(str(refused.value)) < 200


def test_a_task_without_words_or_hands_refuses_them():
    for event, says in (
        ({"kind": "fate", "agent": 0, "fate": None}, "say nothing"),
        ({"kind": "cut", "a": 0, "b": 1, "on": True}, "say nothing"),
        ({"kind": "radius", "value": 1.0}, "radius"),
        ({"kind": "move", "thing": "agent", "index": 0, "x": 0, "y": 0}, "moved"),
        ({"kind": "add"}, "between 2 and 2 agents"),
    ):
        with pytest.raises(Refused, match=says):
            read(scene({"at": 0, **event}, count=2), MUTE)


JSON = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=6), inner, max_size=3),
    max_leaves=8,
)
NAMED = st.fixed_dictionaries(
    {"kind": st.sampled_from(["scene", "frames"])},
    optional={
        name: st.integers(-2, 30) | JSON for name in ("version", "seed", "count", "events", "first", "last")
    },
)


@settings(max_examples=60, deadline=None)
@given(JSON | NAMED)
def test_nothing_but_a_refusal_comes_out_of_nonsense(message: Any):
    try:
        read(json.dumps(message), BOUNDS)
    except Refused as refused:
        assert str(refused)


def test_the_first_step_that_differs_is_where_playing_begins_again():
    move = Event(3, "move", thing="mark", which=0)
    one = Scene(1, 2, (Event(1, "add"), move))
    assert first_difference(one, one) > 10**6
    assert first_difference(one, Scene(2, 2, one.events)) == 0
    assert first_difference(one, Scene(1, 2, (*one.events, Event(9, "remove")))) == 9
    assert first_difference(one, Scene(1, 2, (one.events[0], move._replace(place=(1.0, 0.0))))) == 3
