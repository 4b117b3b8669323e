"""The record of `traffic_junction`."""

from pathlib import Path

from jaxtyping import Array, Float

from gacrl.tasks.task import Case, Task, Words
from gacrl.tasks.traffic.environment import TrafficJunction, TrafficParams
from gacrl.tasks.traffic.scene import scene
from gacrl.tasks.traffic.scripted import gas, yielder
from gacrl.tasks.traffic.settings import COMPARABLE, METRICS, TrafficSettings


def make(settings: TrafficSettings) -> TrafficJunction:
    """Make the environment of these settings."""
    return TrafficJunction(**vars(settings))


def difficulty(settings: TrafficSettings, params: TrafficParams, share: Float[Array, ""]) -> TrafficParams:
    """Let more and more cars arrive, in a straight line from `arrival_start`."""
    start = settings.arrival_start
    return params if start is None else TrafficParams(start + share * (params.arrival - start))


def ragged(settings: TrafficSettings) -> bool:
    """Say that cars arrive and leave."""
    return True


TASK = Task(
    name="traffic_junction",
    settings=TrafficSettings,
    make=make,
    difficulty=difficulty,
    metrics=METRICS,
    headline="success",
    # No measure of progress. A policy that crashes anywhere has no success, so that adaptive exploration would hold
    # random actions high, and they never show what a car meets where the others drive well.
    progress=None,
    references={"yielder": yielder, "gas": gas},
    silent="gas",
    told="yielder",
    anchors=Path(__file__).with_name("anchors.json"),
    # Where all cars are and where they go says all that can be known of the next step.
    needs_memory=False,
    needs_talk=True,
    scene=scene,
    comparable=COMPARABLE,
    ragged=ragged,
    words=Words(agent="car"),
    actions=lambda settings: ("drive", "brake"),
    cases={"traffic_junction": Case(800_000, "success", moves_tell=True)},
    summary="cars must cross junctions without a crash, and see next to nothing of each other (IC3Net)",
)
