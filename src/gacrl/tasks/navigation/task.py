"""The records of `speaker_listener`, `reference` and `colours`."""

from pathlib import Path

from gacrl.envs.particles import PUSHES, edited
from gacrl.tasks.navigation.environment import make
from gacrl.tasks.navigation.scene import scene
from gacrl.tasks.navigation.scripted import centroid, guess, told
from gacrl.tasks.navigation.settings import (
    METRICS,
    RADII,
    ColoursSettings,
    NavigationSettings,
    ReferenceSettings,
    SpeakerListenerSettings,
)
from gacrl.tasks.navigation.uttered import uttered
from gacrl.tasks.navigation.world import world
from gacrl.tasks.task import Case, Task, Words


def actions(settings: NavigationSettings) -> list[str]:
    """Name the pushes; with a word before each where utterances are actions."""
    env = make(settings)
    says = [f"say {word}, " for word in range(env.rules.words)] if env.utters else [""]
    return [word + push for word in says for push in PUSHES]


_ON_GOAL = f"success_final_{RADII[0]}"
_UTTERED = {"talk": "actions"}
ANCHORS = Path(__file__).with_name("anchors")

REFERENCE = Task(
    name="reference",
    settings=ReferenceSettings,
    make=make,
    metrics=METRICS,
    progress="reached_0.2",
    references={"told": told, "silent": centroid},
    anchors=ANCHORS / "reference.json",
    scene=scene,
    edit=edited,
    world=world,
    comparable=("max_cycles",),
    uttered=uttered,
    words=Words(mark="landmark", lit="reached"),
    actions=actions,
    needs_talk=True,
    cases={"reference": Case(40_000, _ON_GOAL, utterances=_UTTERED)},
    summary="each of two agents knows the other's goal alone (MPE2 simple_reference_v3)",
)

SPEAKER_LISTENER = REFERENCE._replace(
    name="speaker_listener",
    settings=SpeakerListenerSettings,
    anchors=ANCHORS / "speaker_listener.json",
    cases={"speaker_listener": Case(30_000, _ON_GOAL, utterances=_UTTERED)},
    summary="one agent knows the goal, the other one moves (MPE2 simple_speaker_listener_v4)",
)
COLOURS = REFERENCE._replace(
    name="colours",
    settings=ColoursSettings,
    anchors=ANCHORS / "colours.json",
    references={"told": told, "silent": centroid, "guess": guess},
    cases={
        "colours": Case(60_000, _ON_GOAL, moves_tell=True),
        "colours-full": Case(120_000, _ON_GOAL, {"graph": "full"}, moves_tell=True),
        "colours-unnamed": Case(150_000, _ON_GOAL, {"named": False}, moves_tell=True),
    },
    comparable=("num_agents", "num_landmarks", "graph", "named", "max_cycles"),
    summary="agents in a ring: each must stand on a landmark that only the one before it knows",
)
