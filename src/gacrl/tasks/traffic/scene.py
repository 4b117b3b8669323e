"""What is to be seen of `traffic_junction`: the roads from above, and cars coloured by their route."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from gacrl.scene import Scene, compose, discs
from gacrl.tasks.traffic.environment import TrafficJunction, TrafficParams, TrafficState
from gacrl.tasks.traffic.roads import Roads
from gacrl.tasks.traffic.settings import LEVELS, TrafficSettings

CAR_RADIUS = 0.4
"""Of a cell's width."""


def scene(settings: TrafficSettings, state: TrafficState, params: TrafficParams) -> Scene:
    """Show the moment of one environment, lengths in cells: cars that have crashed are lit."""
    env = TrafficJunction(**vars(settings))
    cells = jnp.asarray(env.roads.cells)
    row, column = cells[jnp.minimum(env.cell(state), len(cells) - 1)].T
    places = jnp.stack([column, -row], axis=1).astype(float)
    return compose(
        agents=discs(places, CAR_RADIUS, state.there, env.crashes(state), state.route),
        lines=jnp.asarray(kerbs(env.roads, LEVELS[settings.level].grid), float),
    )


def kerbs(roads: Roads, size: int) -> Float[np.ndarray, "M 2 2"]:
    """Return the sides of the roads' cells beyond which no road is; open where the grid ends."""
    cells = {tuple(cell) for cell in roads.cells.tolist()}
    sides = []
    for y, x in sorted(cells):
        for dy, dx in ((1, 0), (-1, 0), (0, 1), (0, -1)):
            inside = 0 <= y + dy < size and 0 <= x + dx < size
            if inside and (y + dy, x + dx) not in cells:
                middle, along = np.array([x + dx / 2, -y - dy / 2]), np.array([dy, dx]) / 2
                sides.append([middle - along, middle + along])
    return np.array(sides)
