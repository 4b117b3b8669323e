"""The record of `spread`."""

from pathlib import Path
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from gacrl.config.checks import require
from gacrl.envs.particles import PUSHES, edited
from gacrl.tasks.spread import scouts
from gacrl.tasks.spread.environment import Spread, SpreadParams, params_of
from gacrl.tasks.spread.scene import scene
from gacrl.tasks.spread.scripted import local, oracle, silent
from gacrl.tasks.spread.settings import COMPARABLE, METRICS, SCOUTS_METRICS, ScoutsSettings, SpreadSettings
from gacrl.tasks.spread.team import TEAM
from gacrl.tasks.spread.world import world
from gacrl.tasks.task import Case, Part, Task, Words


def make(settings: SpreadSettings) -> Spread:
    """Make the environment of these settings."""
    return Spread(**vars(settings))


def params(settings: SpreadSettings, gamma: float, padded: bool) -> SpreadParams:
    """Return the task's numbers; with masks where agents join while it is learned."""
    return params_of(settings, gamma, padded or ragged(settings))


def ragged(settings: SpreadSettings) -> bool:
    """Return whether agents may be absent: those that join later."""
    return settings.num_agents_start is not None


def difficulty(settings: SpreadSettings, params: SpreadParams, share: Float[Array, ""]) -> SpreadParams:
    """Return the task on its way from start to end: in a straight line.

    The paper's: local ratio and θ. Agents that join do so at once, where they happen to be: the environments share
    their parameters.
    """
    moving = settings.local_ratio_end, settings.coverage_threshold_end, settings.arena_scale_start
    if moving == (None, None, None) and settings.num_agents_start is None:
        return params

    def between(start: float | None, end: float | None, constant: Any) -> Any:
        """Move linearly; an end that is not configured is the task's own, and without both nothing moves."""
        if start is None and end is None:
            return constant
        first, last = (constant if bound is None else bound for bound in (start, end))
        return first + share * (last - first)

    moved = params._replace(
        local_ratio=between(None, settings.local_ratio_end, params.local_ratio),
        coverage_threshold=between(None, settings.coverage_threshold_end, params.coverage_threshold),
        arena_scale=between(settings.arena_scale_start, None, params.arena_scale),
    )
    start = settings.num_agents_start
    if start is None:
        return moved
    num_agents, num_landmarks = settings.num_agents, settings.landmarks
    require(
        start <= num_agents,
        f"env.num_agents_start must be at most env.num_agents, {num_agents}, not {start}",
    )
    assert params.agent_mask is not None and params.landmark_mask is not None
    agents = jnp.floor(start + share * (num_agents - start))
    landmarks = jnp.ceil(agents * num_landmarks / num_agents)
    return moved._replace(
        agent_mask=params.agent_mask & (jnp.arange(num_agents) < agents),
        landmark_mask=params.landmark_mask & (jnp.arange(num_landmarks) < landmarks),
    )


TASK = Task(
    name="spread",
    settings=SpreadSettings,
    make=make,
    params=params,
    difficulty=difficulty,
    metrics=METRICS,
    progress="coverage_0.2",
    references={"oracle": oracle, "local": local},
    anchors=Path(__file__).with_name("anchors") / "spread.json",
    scene=scene,
    edit=edited,
    team=TEAM,
    world=world,
    comparable=COMPARABLE,
    ragged=ragged,
    words=Words(mark="landmark", lit="covered"),
    actions=lambda settings: PUSHES,
    parts={"no-coverage-bonus": Part("MPE2's reward alone", {"env": {"reward": "mpe2"}})},
    summary="agents must cover landmarks without touching each other (MPE2 simple_spread_v3)",
)

SCOUTS = TASK._replace(
    name="scouts",
    settings=ScoutsSettings,
    make=scouts.make,
    metrics=SCOUTS_METRICS,
    references={"told": oracle, "silent": silent},
    anchors=Path(__file__).with_name("anchors") / "scouts.json",
    scene=scouts.scene,
    comparable=(*COMPARABLE, "num_blind"),
    needs_talk=True,
    cases={"scouts": Case(75_000, "coverage_final_0.1", moves_tell=True)},
    summary="spread where one agent sees no landmarks: the others must tell it where to go",
)
