"""A small map of what an agent has seen of the floor, around it and turned to its heading.

It is made of the observed cells alone, and of what stands beside them: the picture that shows a floor point also shows
whether the floor goes on 10 cm further. Nothing of a scene that the agent has not seen enters it.
"""

import numpy as np
from numpy.typing import NDArray

from avp_habitat.navigation.area import NavigableArea

SIDE = 20
"""Map cells along a side; the agent stands in the middle, its heading points to row 0."""
CELL_M = 0.4
"""Side of a map cell in metres."""
CHANNELS = ("observed", "frontier", "rim")
"""observed: share of the map cell's ground that is observed floor. frontier: observed floor beside floor that is not
yet observed. rim: observed floor beside what is not navigable. The last two are lengths in sides of a map cell, up to
1."""
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
            `(k, SIZE)` within [0, 1], channel after channel, row after row from ahead to behind, left to right. What
            lies beyond the map is drawn on its border, frontiers only.
        """
        from avp_habitat.map_kernel import draw

        maps = np.zeros((len(rows), len(CHANNELS), SIDE, SIDE), dtype=np.float32)
        place = (np.asarray(position)[:, [0, 2]] - self._origin) / self._cell_m
        per_side = CELL_M / self._cell_m
        draw(self._index, first_seen, rows, place, np.asarray(yaw), per_side, maps)
        maps[:, 0] /= per_side**2
        maps[:, 1:] /= per_side
        return np.minimum(maps, 1.0).reshape(len(rows), SIZE)
