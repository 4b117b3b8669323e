"""MPE2's simple_tag_v3: three pursuers learn to catch a prey, which runs by a script.

gacrl train --env examples/pettingzoo_tag.py:tag --preset ippo --env-steps 100000
"""

import numpy as np
from mpe2 import simple_tag_v3

import gacrl

LEFT, RIGHT, DOWN, UP = 1, 2, 3, 4


def flee(seen: np.ndarray) -> int:
    """Run from the nearest pursuer, and stay where the pursuers are: near the middle.

    seen: velocity 2, place 2, two obstacles 4, three pursuers 6, all but the first two as offsets.
    """
    place, pursuers = seen[2:4], seen[8:14].reshape(3, 2)
    nearest = pursuers[np.linalg.norm(pursuers, axis=1).argmin()]
    x, y = -nearest / max(np.linalg.norm(nearest), 1e-6) - place**3
    if abs(x) > abs(y):
        return RIGHT if x > 0 else LEFT
    return UP if y > 0 else DOWN


def make(max_cycles: int = 25, render_mode: str | None = None):
    """Make an environment; arguments that are numbers are the task's settings (--env.max-cycles 50)."""
    return simple_tag_v3.parallel_env(max_cycles=max_cycles, render_mode=render_mode)


tag = gacrl.from_pettingzoo(make, "tag", scripted={"agent_0": flee})
