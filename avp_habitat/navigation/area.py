"""Where agents can stand and how they move there, as numbers on the floor plane."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from avp_habitat.navigation.walls import Walls

Float = NDArray[np.float64]
SurfaceBelow = Callable[[Float], NDArray[np.floating]]
"""Heights y `(n,)` of the first surface straight below `(n, 3)` points; not finite where there is none."""


@dataclass(frozen=True)
class NavigableArea:
    """One connected part of the floor on which an agent can stand, seen from above (x to the right, z upwards).

    Its outline decides what is inside: agents are points on the floor plane that stay within it. The mask is a picture
    of it: a cell is navigable when its centre lies inside. Heights of points are ignored by all methods.
    """

    cell_m: float
    """Side of a cell in metres."""
    origin: Float
    """`(2,)` x and z of the least corner of cell (0, 0), metres."""
    mask: NDArray[np.bool_]
    """`(rows, columns)` navigable cells; rows along +Z, columns along +X."""
    heights: Float
    """`(rows, columns)` floor height y in metres; continued a few cells beyond the navigable ones."""
    rings: tuple[Float, ...]
    """Outline: `(k, 2)` corners x, z in metres, the outer ring first, then holes; the inside lies on the left."""

    @cached_property
    def centres(self) -> Float:
        """`(m, 3)` floor points of the navigable cells in the mask's row-major order, metres."""
        rows, columns = np.nonzero(self.mask)
        x = self.origin[0] + (columns + 0.5) * self.cell_m
        z = self.origin[1] + (rows + 0.5) * self.cell_m
        return np.stack([x, self.heights[rows, columns], z], axis=1)

    @cached_property
    def area_m2(self) -> float:
        """Area within the outline, measured on the floor plane (a slope counts with its projection)."""
        from avp_habitat.navigation.walls import doubled_area

        return sum(doubled_area(ring) for ring in self.rings) / 2

    @cached_property
    def diameter_m(self) -> float:
        """Greatest distance between the centres of two navigable cells, in a straight line on the floor plane."""
        rows = np.flatnonzero(self.mask.any(axis=1))
        left = self.mask[rows].argmax(axis=1)
        right = self.mask.shape[1] - 1 - self.mask[rows, ::-1].argmax(axis=1)
        ends = np.stack([np.tile(rows, 2), np.concatenate([left, right])], axis=1).astype(np.float64)
        longest = max(float(((ends - end) ** 2).sum(axis=1).max()) for end in ends)
        return float(np.sqrt(longest)) * self.cell_m

    def cell_of(self, points: Float) -> NDArray[np.int64]:
        """`(n, 2)` row and column of the cells that `(n, 3)` points lie over; outside of the mask too."""
        points = np.asarray(points, dtype=np.float64)
        return np.floor((points[:, [2, 0]] - self.origin[::-1]) / self.cell_m).astype(np.int64)

    def contains(self, points: Float) -> NDArray[np.bool_]:
        """`(n,)` whether `(n, 3)` points lie over the navigable area."""
        from avp_habitat.navigation.walls import are_inside

        return are_inside(self._walls, _on_plane(points))

    def nearest(self, points: Float) -> Float:
        """`(n, 3)` the points themselves where they lie over the area, else the nearest place of its outline.

        Heights stay as they are.
        """
        points = np.array(points, dtype=np.float64)
        outside = np.flatnonzero(~self.contains(points))
        if len(outside):
            points[outside, 0], points[outside, 2] = self._nearest_on_outline(_on_plane(points[outside])).T
        return points

    def _nearest_on_outline(self, on_plane: Float) -> Float:
        begin = np.concatenate(self.rings)
        along = np.concatenate([np.roll(ring, -1, axis=0) for ring in self.rings]) - begin
        squared = np.maximum((along**2).sum(axis=1), 1e-12)
        nearest = np.empty_like(on_plane)
        for index, point in enumerate(on_plane):
            share = np.clip(((point - begin) * along).sum(axis=1) / squared, 0, 1)
            foot = begin + share[:, None] * along
            nearest[index] = foot[((foot - point) ** 2).sum(axis=1).argmin()]
        return nearest

    def floor_height(self, points: Float) -> Float:
        """`(n,)` floor heights y in metres under `(n, 3)` points, linear between the centres of cells."""
        from avp_habitat.navigation.heights import interpolated

        return interpolated(np.asarray(points, dtype=np.float64), self.origin, self.cell_m, self.heights)

    def slide(self, positions: Float, displacements: Float) -> Float:
        """Move agents; an obstacle lets them slide along it, and nothing lets them through.

        Args:
            positions: `(n, 3)` points over the navigable area, metres.
            displacements: `(n, 3)` metres; only x and z count.

        Returns:
            `(n, 3)` end points on the floor. An agent that is not moved keeps x and z to the bit.

        Raises:
            ValueError: an agent starts outside of the area, or a number is not finite.
        """
        from avp_habitat.navigation.sliding import slide
        from avp_habitat.navigation.walls import are_inside, off_walls

        begin, move = _on_plane(positions), _on_plane(displacements)
        if not (np.isfinite(begin).all() and np.isfinite(move).all()):
            raise ValueError("expected finite positions and displacements, got NaN or infinity")
        inside = are_inside(self._walls, begin)
        if not inside.all():
            # On the outline, or within the skin outside of it.
            begin = np.where(inside[:, None], begin, off_walls(self._walls, begin))
            outside = np.flatnonzero(~are_inside(self._walls, begin))
            if len(outside):
                raise ValueError(
                    f"expected agents over the navigable area; {len(outside)} of {len(begin)} are outside, "
                    f"the first at x, z = {begin[outside[0]]}"
                )
        return self._on_floor(slide(self._walls, begin, move))

    def random_points(self, rng: np.random.Generator, count: int) -> Float:
        """`(count, 3)` points on the floor, distributed uniformly over the area."""
        low, high = self.rings[0].min(axis=0), self.rings[0].max(axis=0)
        accepted = [np.empty((0, 3))]
        while sum(map(len, accepted)) < count:
            points = self._on_floor(low + rng.random((2 * count, 2)) * (high - low))
            accepted.append(points[self.contains(points)])
        return np.concatenate(accepted)[:count]

    def _on_floor(self, on_plane: Float) -> Float:
        points = np.stack([on_plane[:, 0], np.zeros(len(on_plane)), on_plane[:, 1]], axis=1)
        points[:, 1] = self.floor_height(points)
        return points

    @cached_property
    def _walls(self) -> "Walls":
        from avp_habitat.navigation.walls import make_walls

        return make_walls(list(self.rings))


def _on_plane(points: Float) -> Float:
    """Floor-plane coordinates x, z of `(n, 3)` points."""
    return np.ascontiguousarray(np.asarray(points, dtype=np.float64)[:, [0, 2]])
