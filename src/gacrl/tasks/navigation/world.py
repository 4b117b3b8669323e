"""The rules of the navigation tasks as plain data, for the page that steps them (`export/page/navigation.js`)."""

from collections.abc import Mapping
from typing import Any

from gacrl.tasks.navigation.environment import Navigation, NavigationParams
from gacrl.tasks.navigation.scene import SIZE
from gacrl.tasks.navigation.settings import RADII


def world(env: Navigation, params: NavigationParams) -> Mapping[str, Any] | None:
    """Write down the rules; None where utterances are among the actions, which the page does not know."""
    if env.utters:
        return None
    rules = env.rules._asdict()
    return {
        **{name: rules[name] for name in ("num_agents", "landmarks", "moves", "seeks", "knows", "hears")},
        **{name: rules[name] for name in ("bodies", "squared", "named")},
        "kind": "navigation",
        "physics": {name: float(number) for name, number in params.physics._asdict().items()},
        "max_cycles": env.max_cycles,
        "identity": env.identity,
        "local_ratio": float(params.local_ratio),
        "capture_radius": float(RADII[0]),
        "agent_radius": SIZE,
        "measures": {"share": f"reached_{RADII[0]}"},
    }
