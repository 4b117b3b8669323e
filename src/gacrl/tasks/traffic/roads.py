"""The roads of a level and the routes over them, as tables of NumPy arrays.

Rows count downwards, and traffic keeps to the right. Everything is in the order of IC3Net's program.
"""

from collections.abc import Iterator
from functools import cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Int

from gacrl.tasks.traffic.settings import LEVELS

Cell = tuple[int, int]
"""Row and column."""
STRAIGHT, RIGHT, LEFT = range(3)
_DOWN, _UP, _EAST, _WEST = (1, 0), (-1, 0), (0, 1), (0, -1)


class Roads(NamedTuple):
    """The cells of a level's roads and its routes. C cells, R routes of up to K cells, E entries."""

    cells: Int[np.ndarray, "C 2"]
    """Row and column of each cell of a road."""
    routes: Int[np.ndarray, "R K"]
    """The cells of each route in order; C beyond its end. The routes of an entry stand together."""
    lengths: Int[np.ndarray, " R"]
    """Cells of each route."""
    entries: int
    """E. Each has as many routes."""
    junction: Bool[np.ndarray, " C"]
    """Which cells are of a junction."""

    def around(self, vision: int) -> Int[np.ndarray, "C W"]:
        """Return the cells of the square of W = (2 vision + 1)² cells around each cell; C where no road is."""
        index = {tuple(cell): number for number, cell in enumerate(self.cells.tolist())}
        reach = range(-vision, vision + 1)
        square = [(dy, dx) for dy in reach for dx in reach]
        return np.array([[index.get((y + dy, x + dx), len(index)) for dy, dx in square] for y, x in index])


@cache
def roads(level: str) -> Roads:
    """Return the roads of a level."""
    routes = list(_routes(level))
    cells = sorted({cell for route in routes for cell in route})
    index = {cell: number for number, cell in enumerate(cells)}
    longest = max(map(len, routes))
    lanes = _lanes(level)
    return Roads(
        cells=np.array(cells),
        routes=np.array([[index[cell] for cell in it] + [len(cells)] * (longest - len(it)) for it in routes]),
        lengths=np.array([len(route) for route in routes]),
        entries=len(_entries(level)),
        junction=np.array([y in lanes and x in lanes for y, x in cells]),
    )


def _entries(level: str) -> list[tuple[Cell, Cell]]:
    """Return where cars arrive and which way they head, in the order in which entries are served."""
    size, last = LEVELS[level].grid, LEVELS[level].grid - 1
    if level == "easy":
        return [((0, size // 2), _DOWN), ((size // 2, 0), _EAST)]
    if level == "medium":
        far = size // 2
        near = far - 1
        return [((0, near), _DOWN), ((last, far), _UP), ((far, 0), _EAST), ((near, last), _WEST)]
    first, second = size // 3 - 2, 2 * size // 3
    return [
        *(((0, first), _DOWN), ((0, second), _DOWN)),
        *(((first + 1, 0), _EAST), ((second + 1, 0), _EAST)),
        *(((last, first + 1), _UP), ((last, second + 1), _UP)),
        *(((first, last), _WEST), ((second, last), _WEST)),
    ]


def _lanes(level: str) -> set[int]:
    """Return the rows, and columns, that are lanes."""
    size = LEVELS[level].grid
    if level == "easy":
        return {size // 2}
    if level == "medium":
        return {size // 2 - 1, size // 2}
    return {size // 3 - 2, size // 3 - 1, 2 * size // 3, 2 * size // 3 + 1}


def _routes(level: str) -> Iterator[list[Cell]]:
    """Yield the routes of each entry: one for each way to go at the first junction and, where that leads to another
    one, there. A third junction is crossed straight on; on easy all are."""
    ways = (STRAIGHT,) if level == "easy" else (STRAIGHT, RIGHT, LEFT)
    for start, heading in _entries(level):
        for first in ways:
            for second in ways:
                route, junctions = _drive(level, start, heading, (first, second))
                yield route
                if junctions == 1:
                    break


def _drive(level: str, start: Cell, heading: Cell, turns: tuple[int, int]) -> tuple[list[Cell], int]:
    """Return the cells from an entry to the grid's edge with these turns, and how many junctions are crossed.

    A turn to the right is made in a junction's first cell, one to the left in its second.
    """
    size, lanes = LEVELS[level].grid, _lanes(level)
    route, junctions, inside = [], 0, 0
    (y, x), (dy, dx) = start, heading
    while 0 <= y < size and 0 <= x < size:
        route.append((y, x))
        inside = inside + 1 if y in lanes and x in lanes else 0
        junctions += inside == 1
        turn = turns[junctions - 1] if 0 < junctions <= len(turns) else STRAIGHT
        if (turn, inside) == (RIGHT, 1):
            dy, dx = dx, -dy
        elif (turn, inside) == (LEFT, 2):
            dy, dx = -dx, dy
        y, x = y + dy, x + dx
    return route, junctions
