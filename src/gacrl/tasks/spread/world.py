"""The rules of `spread` as plain data, for the page that steps it in JavaScript (`export/page/spread.js`)."""

from collections.abc import Mapping
from typing import Any

from gacrl.tasks.spread.environment import CAPTURE_RADIUS, Spread, SpreadParams
from gacrl.tasks.spread.team import MOST_AGENTS, least


def world(env: Spread, params: SpreadParams) -> Mapping[str, Any] | None:
    """Write down the rules; None for readings of the task that the page does not know."""
    unknown = (
        env.continuous_actions
        or env.num_agent_neighbors is not None
        or env.num_landmark_neighbors is not None
        or env.terminate_on_success
        or env.landmark_speed > 0
        or env.reset_on_collision != "off"
    )
    if unknown or type(env) is not Spread:
        return None
    return {
        "kind": "spread",
        "physics": {name: float(number) for name, number in params.physics._asdict().items()},
        "num_agents": env.num_agents,
        "num_landmarks": env.num_landmarks,
        "max_cycles": env.max_cycles,
        "arena_scale": float(params.arena_scale),
        "capture_radius": CAPTURE_RADIUS,
        "least_agents": least(env),
        "most_agents": MOST_AGENTS,
        "measures": {"share": f"coverage_{CAPTURE_RADIUS}", "collisions": "collisions"},
    }
