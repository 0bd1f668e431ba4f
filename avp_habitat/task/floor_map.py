"""Small maps of the floor that an agent has observed, around it and turned to its heading."""

import numpy as np
from numpy.typing import NDArray

from avp_habitat.compiled import njit
from avp_habitat.navigation.area import NavigableArea
from avp_habitat.sight.rules import turned

SIDE = 20
"""Map cells along a side; the agent stands in the middle, its heading points to row 0."""
CELL_M = 0.4
"""Side of a map cell in metres."""
CHANNELS = ("observed", "frontier", "rim")
"""observed: share of the map cell's ground that is observed floor. frontier: observed floor beside floor that is not
yet observed. rim: observed floor beside what is not navigable. The last two are lengths in sides of a map cell, up to
1."""
SIZE = len(CHANNELS) * SIDE * SIDE
OBSERVED, FRONTIER, RIM = range(len(CHANNELS))


@njit(cache=True)
def draw(index, first_seen, rows, place, yaw, scale, maps):
    """Count floor cells by channel and map cell.

    Args:
        index: `(rows + 2, columns + 2)` number of each navigable cell, -1 elsewhere, with a border of -1.
        first_seen: `(n, >= m)` 0 for cells not observed.
        rows: `(k,)` the agents' rows of it.
        place: `(k, 2)` x and z of the agents in floor cells from the grid's corner.
        yaw: `(k,)` radians.
        scale: floor cells along a map cell's side.
        maps: `(k, 3, side, side)` output, zeros before.
    """
    for k in range(len(rows)):
        seen = first_seen[rows[k]]
        sine, cosine = np.sin(yaw[k]) / scale, np.cos(yaw[k]) / scale
        for i in range(1, index.shape[0] - 1):
            for j in range(1, index.shape[1] - 1):
                if index[i, j] >= 0 and seen[index[i, j]] != 0:
                    x, z = j - 0.5 - place[k, 0], i - 0.5 - place[k, 1]
                    ahead, right = turned(x, z, sine, cosine)
                    _enter(maps[k], ahead, right, *_edges(index, seen, i, j))


@njit(cache=True)
def _edges(index, seen, i, j):
    """Whether an observed cell lies beside floor not yet observed, and beside what is not navigable."""
    frontier, rim = False, False
    for di, dj in ((0, 1), (1, 0), (0, -1), (-1, 0)):
        other = index[i + di, j + dj]
        if other < 0:
            rim = True
        elif seen[other] == 0:
            frontier = True
    return frontier, rim


@njit(cache=True)
def _enter(channels, ahead, right, frontier, rim):
    """Count an observed cell at a place in map cells from the agent; frontiers beyond the map on its border."""
    side = channels.shape[1]
    row, column = int(np.floor(side / 2 - ahead)), int(np.floor(side / 2 + right))
    if 0 <= row < side and 0 <= column < side:
        channels[OBSERVED, row, column] += 1
        channels[RIM, row, column] += rim
    if frontier:
        channels[FRONTIER, min(max(row, 0), side - 1), min(max(column, 0), side - 1)] += 1


class MapObserver:
    """Draws the maps of agents in one scene."""

    def __init__(self, area: NavigableArea) -> None:
        """Number the scene's cells."""
        self._origin = area.origin
        self._cell_m = area.cell_m
        index = np.full(area.mask.shape, -1, dtype=np.int32)
        index[area.mask] = np.arange(np.count_nonzero(area.mask))
        # A border of cells outside, so that every cell has four neighbours.
        self._index = np.pad(index, 1, constant_values=-1)

    def observe(
        self,
        first_seen: NDArray[np.int16],
        rows: NDArray[np.integer],
        position: NDArray[np.floating],
        yaw: NDArray[np.floating],
    ) -> NDArray[np.float32]:
        """`(k, SIZE)` within [0, 1], channel after channel, row after row from ahead to behind, left to right.

        What lies beyond the map is drawn on its border, frontiers only. The agents' feet are `(k, 3)` metres; the rest
        is as for `draw`.
        """
        maps = np.zeros((len(rows), len(CHANNELS), SIDE, SIDE), dtype=np.float32)
        place = (np.asarray(position)[:, [0, 2]] - self._origin) / self._cell_m
        per_side = CELL_M / self._cell_m
        draw(self._index, first_seen, rows, place, np.asarray(yaw), per_side, maps)
        maps[:, 0] /= per_side**2
        maps[:, 1:] /= per_side
        return np.minimum(maps, 1.0).reshape(len(rows), SIZE)

    def free(
        self,
        first_seen: NDArray[np.int16],
        rows: NDArray[np.integer],
        position: NDArray[np.floating],
        yaw: NDArray[np.floating],
        rays: int,
        most_m: float,
    ) -> NDArray[np.float32]:
        """What k agents know of the way in so many directions to the right, from ahead.

        Returns:
            `(k, 2, rays)` how far nothing is known to block the way, by `most_m`, up to 1: it is blocked where observed
            floor ends beside what is not navigable; and the share of that way that is observed floor. The rest is as
            for `observe`.
        """
        found = np.zeros((len(rows), 2, rays), dtype=np.float32)
        place = (np.asarray(position)[:, [0, 2]] - self._origin) / self._cell_m
        _free(self._index, first_seen, rows, place, np.asarray(yaw), most_m / self._cell_m, found)
        return found


@njit(cache=True)
def _free(index, first_seen, rows, place, yaw, most, found):
    """Follow rays over the floor cell by cell; arguments as of `draw`, lengths in floor cells."""
    rays = found.shape[2]
    for k in range(len(rows)):
        seen = first_seen[rows[k]]
        for ray in range(rays):
            heading = yaw[k] - 2 * np.pi * ray / rays
            x, z, length = -np.sin(heading), -np.cos(heading), 1.0
            observed, before = 0.0, False
            while length < most:
                i, j = int(np.floor(place[k, 1] + length * z)) + 1, int(np.floor(place[k, 0] + length * x)) + 1
                inside = 0 <= i < index.shape[0] and 0 <= j < index.shape[1] and index[i, j] >= 0
                if before and not inside:
                    break
                before = inside and seen[index[i, j]] != 0
                observed += before
                length += 1.0
            found[k, 0, ray] = min(length, most) / most
            found[k, 1, ray] = observed / length
