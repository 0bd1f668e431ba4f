"""The points of a scene at which tables are made: a square lattice over the floor, in tiles."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from avp_habitat.navigation.area import NavigableArea

TILE = 16
"""Lattice points along a tile's side; a tile is the piece that is computed and kept at a time."""

MARGIN_M = 0.08
"""Less than an agent's radius: a camera this far outside of the area is still before the wall."""


@dataclass(frozen=True)
class Lattice:
    """Points `origin + spacing_m · (i, j)`, i along x and j along z."""

    area: NavigableArea
    """Where agents stand."""
    spacing_m: float
    """Distance between neighbouring points, metres."""

    @property
    def shape(self) -> tuple[int, int]:
        """Number of points along x and z; every place in the area has four points around it."""
        rows, columns = self.area.mask.shape
        share = self.area.cell_m / self.spacing_m
        return int(np.ceil(columns * share)) + 2, int(np.ceil(rows * share)) + 2

    def around(self, position: NDArray[np.floating]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """The lattice points around places.

        Args:
            position: `(k, 3)` metres, over the area.

        Returns:
            `(k, 4, 2)` their i and j, and `(k, 4)` their weights of bilinear interpolation, which sum to 1.
        """
        at = (np.asarray(position)[:, [0, 2]] - self.area.origin) / self.spacing_m
        low = np.clip(np.floor(at), 0, np.array(self.shape) - 2)
        share = np.clip(at - low, 0.0, 1.0)
        corner = np.array([[0, 0], [0, 1], [1, 0], [1, 1]])
        weight = np.where(corner, share[:, None], 1 - share[:, None]).prod(axis=-1)
        return low.astype(np.int64)[:, None] + corner, weight

    def feet(self, points: NDArray[np.integer]) -> NDArray[np.float64]:
        """`(k, 3)` where a camera's agent stands for `(k, 2)` lattice points, metres.

        A point outside of the area keeps its place as far as `MARGIN_M` from it, so that an agent at a wall lies
        between the places of its lattice points; farther ones are drawn back to that distance, before the wall.
        """
        plane = self.area.origin + self.spacing_m * np.asarray(points)
        wanted = np.stack([plane[:, 0], np.zeros(len(plane)), plane[:, 1]], axis=1)
        inside = self.area.nearest(wanted)
        out = np.linalg.norm(wanted - inside, axis=1, keepdims=True)
        place = inside + (wanted - inside) * np.minimum(1.0, MARGIN_M / np.maximum(out, 1e-9))
        place[:, 1] = self.area.floor_height(place)
        return place

    def points_of_tile(self, tile: tuple[int, int]) -> NDArray[np.int64]:
        """`(k, 2)` the points of a tile that an agent may need: those next to a navigable cell."""
        low = np.array(tile) * TILE
        high = np.minimum(low + TILE, self.shape)
        grid = np.stack(np.meshgrid(*map(np.arange, low, high), indexing="ij"), axis=-1).reshape(-1, 2)
        return grid[self._near_floor()[grid[:, 0], grid[:, 1]]]

    def _near_floor(self) -> NDArray[np.bool_]:
        """Which lattice points have the centre of a navigable cell less than a spacing and a cell away, each way."""
        near = np.zeros(self.shape, dtype=np.bool_)
        row, column = np.nonzero(self.area.mask)
        at = (np.stack([column, row], axis=1) + 0.5) * self.area.cell_m
        reach = self.area.cell_m + self.spacing_m
        low = np.maximum(np.ceil((at - reach) / self.spacing_m), 0).astype(np.int64)
        high = np.minimum(np.floor((at + reach) / self.spacing_m), np.array(self.shape) - 1).astype(np.int64)
        for i in range(int((high - low).max()) + 1):
            for j in range(int((high - low).max()) + 1):
                point = np.minimum(low + [i, j], high)
                near[point[:, 0], point[:, 1]] = True
        return near
