"""A small map of what an agent has seen of the floor, around it and turned to its heading.

It is made of the observed cells alone, and of what stands beside them: the picture that shows a floor point also shows
whether the floor goes on 10 cm further. Nothing of a scene that the agent has not seen enters it.
"""

from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avp_habitat.navigation.area import NavigableArea

SIDE = 20
"""Map cells along a side; the agent stands in the middle, its heading points to row 0."""
CELL_M = 0.4
"""Side of a map cell in metres."""
CHANNELS = ("observed", "frontier", "rim")
"""observed: share of the map cell's ground that is observed floor. frontier: observed floor beside floor not yet
observed. rim: observed floor beside what is not navigable. The last two count cells along a map cell's side, up to 1."""
SIZE = len(CHANNELS) * SIDE * SIDE


class MapObserver:
    """Draws the maps of agents in one scene."""

    def __init__(self, area: NavigableArea) -> None:
        """Number the scene's cells."""
        self._origin = area.origin
        self._cell_m = area.cell_m
        # A border of cells outside, so that every cell has four neighbours.
        self._index = np.full((area.mask.shape[0] + 2, area.mask.shape[1] + 2), -1, dtype=np.int32)
        self._index[1:-1, 1:-1][area.mask] = np.arange(np.count_nonzero(area.mask))

    def observe(
        self,
        first_seen: NDArray[np.int16],
        rows: NDArray[np.integer],
        position: NDArray[np.floating],
        yaw: NDArray[np.floating],
    ) -> NDArray[np.float32]:
        """The maps of k agents.

        Args:
            first_seen: `(n, >= m)` 0 for cells not observed.
            rows: `(k,)` the agents' rows of it.
            position: `(k, 3)` their feet, metres.
            yaw: `(k,)` radians.

        Returns:
            `(k, SIZE)` within [0, 1]: channel after channel, row after row from ahead to behind, left to right. What
            lies beyond the map is drawn on its border, frontiers only.
        """
        maps = np.zeros((len(rows), len(CHANNELS), SIDE, SIDE), dtype=np.float32)
        place = (np.asarray(position)[:, [0, 2]] - self._origin) / self._cell_m
        _draw()(self._index, first_seen, rows, place, yaw, CELL_M / self._cell_m, maps)
        per_side = CELL_M / self._cell_m
        maps[:, 0] /= per_side**2
        maps[:, 1:] /= per_side
        return np.minimum(maps, 1.0).reshape(len(rows), SIZE)


@cache
def _draw() -> Any:
    """The compiled drawing: counts of cells by channel and map cell."""
    import numba

    @numba.njit(cache=True)
    def draw(index: Any, first_seen: Any, rows: Any, place: Any, yaw: Any, scale: Any, maps: Any) -> None:
        side = maps.shape[2]
        for k in range(len(rows)):
            seen = first_seen[rows[k]]
            ahead_x, ahead_z = -np.sin(yaw[k]), -np.cos(yaw[k])
            for i in range(1, index.shape[0] - 1):
                for j in range(1, index.shape[1] - 1):
                    cell = index[i, j]
                    if cell < 0 or seen[cell] == 0:
                        continue
                    x, z = j - 0.5 - place[k, 0], i - 0.5 - place[k, 1]
                    ahead = (x * ahead_x + z * ahead_z) / scale
                    right = (z * ahead_x - x * ahead_z) / scale
                    row, column = int(np.floor(side / 2 - ahead)), int(np.floor(side / 2 + right))
                    within = 0 <= row < side and 0 <= column < side
                    row, column = min(max(row, 0), side - 1), min(max(column, 0), side - 1)
                    frontier, rim = False, False
                    for di, dj in ((0, 1), (1, 0), (0, -1), (-1, 0)):
                        other = index[i + di, j + dj]
                        if other < 0:
                            rim = True
                        elif seen[other] == 0:
                            frontier = True
                    if frontier:
                        maps[k, 1, row, column] += 1
                    if within:
                        maps[k, 0, row, column] += 1
                        if rim:
                            maps[k, 2, row, column] += 1

    return draw
