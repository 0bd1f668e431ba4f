"""What can be seen from where in a whole scene: places on its floor, with tables of floor cells."""

from dataclasses import dataclass
from itertools import count

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from avp_habitat.navigation.area import NavigableArea
from avp_habitat.policies.oracle import kernels
from avp_habitat.sight.bits import Bits
from avp_habitat.sight.rules import camera_numbers
from avp_habitat.sight.tables import once_per_simulator, seen_bits
from avp_habitat.simulators.base import Simulator, SingleRays
from avp_habitat.surface.points import views_all_over
from avp_habitat.task.motion import sensor_poses
from avp_habitat.task.settings import TaskSettings

Float = NDArray[np.float64]

SURFACE_SPACING_M = 0.4
"""One point for each cube of this edge that holds some surface, metres."""
SURFACE_RANGE_M = 4.0
"""A surface counts as seen from this near, metres: from farther off its texture is too coarse to reconstruct."""
TABLE_ENTRIES = 30_000_000
"""Most pairs of a place and a cell: one ray each to prepare, and two bytes each to keep."""

_FLOOR_M = 0.05
"""Surfaces this close above or below the walkable floor are the floor, which has points of its own."""
_PANORAMAS = 1500
"""Most places of a simulator that renders six images for each of them instead of casting single rays."""
_RAYS_PER_CALL = 1 << 20
_NEAR_M = 1.0
"""A cell nearer than this on the floor is below the image of a camera that looks ahead."""
_AHEAD_M = 0.8
"""The heading of a walk is that of the place so far along it."""


@dataclass(frozen=True)
class ScenePlaces:
    """Places, and which points are not hidden from a camera above each of them; p places, m points.

    The points are the floor's navigable cells, "cells" below, and after them those on other surfaces that were asked
    for.
    """

    area: NavigableArea
    """Where agents stand."""
    position: Float
    """`(p, 3)` metres, on the floor."""
    points: Float
    """`(m, 3)` floor points of the navigable cells, then points on other surfaces, metres."""
    sees: Bits
    """`(p, ceil(m / 64))` cells within range that a camera ray from above the place reaches, in any direction."""
    wanted: Bits
    """`(ceil(m / 64),)` cells seen from any place."""
    reach: NDArray[np.uint8]
    """`(p, m)` half steps of walking to the nearest place that sees the cell; `kernels.NEVER` for none."""
    heading: NDArray[np.uint8]
    """`(p, m)` 256ths of a turn: where to walk for it, or where the cell lies when it is in reach."""
    neighbours: NDArray[np.int64]
    """`(p, 8)` places beside each place to which the way is free, then -1."""
    lengths_m: Float
    """`(p, 8)` lengths of the ways to them, metres."""
    tree: KDTree
    """Of the places on the floor plane."""

    def nearest(self, positions: Float) -> NDArray[np.int64]:
        """`(n,)` numbers of the places nearest to `(n, 3)` points."""
        return self.tree.query(positions[:, [0, 2]])[1].astype(np.int64)


def views_from(places: ScenePlaces, settings: TaskSettings, position: Float, yaw: Float, pitch: Float) -> Bits:
    """`(n, words)` cells observed by the views of n agents: `(n, 3)` feet in metres, `(n,)` angles in radians.

    What is hidden is taken from the nearest places.
    """
    nothing, parent = np.zeros((1, len(places.wanted)), np.uint64), np.zeros(len(position), np.int64)
    return new_views(places, settings, parent, position, yaw, pitch, nothing)[0]


def new_views(
    places: ScenePlaces,
    settings: TaskSettings,
    parent: NDArray[np.int64],
    position: Float,
    yaw: Float,
    pitch: Float,
    seen: Bits,
) -> tuple[Bits, NDArray[np.int64]]:
    """`(n, words)` cells that the views of n agents add to row `parent` of `seen`, and `(n,)` how many they are."""
    pose, camera = sensor_poses(settings, position, yaw, pitch), camera_numbers(settings.intrinsics)
    return kernels.look(parent, places.nearest(position), pose, camera, places.sees, places.points, seen)


@once_per_simulator("sensor_height_m", "max_range_m", "tolerance_m", "forward_m")
def scene_places(
    simulator: Simulator,
    settings: TaskSettings,
    *,
    surfaces: bool = False,
    sparse: bool = False,
    entries: int = TABLE_ENTRIES,
) -> ScenePlaces:
    """Look from every place at every cell within range, and find the ways between the places.

    With `surfaces`, points on other surfaces count like floor cells once they are seen from near; if `sparse`, the
    floor has no more points than those, and all count from afar. The places' spacing is the smallest multiple of
    a cell that gives no more than `entries` pairs of a place and a cell.
    """
    area = simulator.area
    points: Float = np.asarray(_thinned(area.centres) if sparse else area.centres, dtype=np.float64)
    if surfaces:
        points = np.concatenate([points, surface_points(simulator, settings)])
    most = entries // len(points)
    stride, cells = _stride(area.mask, most if isinstance(simulator, SingleRays) else min(most, _PANORAMAS))
    places = area.centres[cells]
    range_m = np.full(len(points), settings.max_range_m)
    if not sparse:
        range_m[len(area.centres) :] = min(SURFACE_RANGE_M, settings.max_range_m)
    sees = _unhidden(simulator, places, points, range_m, settings)
    grid = np.full(area.mask.shape, -1, dtype=np.int64)
    grid[tuple(np.argwhere(area.mask)[cells].T)] = np.arange(len(cells))
    other, length = kernels.neighbour_table(np.ascontiguousarray(grid[::stride, ::stride]), len(cells))
    spacing = stride * area.cell_m
    steps = spacing / kernels.LENGTHS_PER_SPACING / settings.forward_m
    ahead = max(1, round(_AHEAD_M / spacing))
    reach, heading = kernels.reach_tables(sees, points, places, other, length, steps, ahead, _NEAR_M)
    lengths_m = np.asarray(length * spacing / kernels.LENGTHS_PER_SPACING, dtype=np.float64)
    wanted, tree = np.bitwise_or.reduce(sees, axis=0), KDTree(places[:, [0, 2]])
    return ScenePlaces(area, places, points, sees, wanted, reach, heading, other, lengths_m, tree)


def _stride(mask: NDArray[np.bool_], most: int) -> tuple[int, NDArray[np.int64]]:
    """Spacing in cells, and the numbers of the navigable cells that are places, at most so many if it can be."""
    rows, columns = np.nonzero(mask)
    for stride in count(1):
        cells = np.flatnonzero((rows % stride == 0) & (columns % stride == 0))
        if 0 < len(cells) <= max(most, 1):
            break
    return stride, cells


def _unhidden(simulator: Simulator, places: Float, points: Float, range_m: Float, settings: TaskSettings) -> Bits:
    eye = places + [0.0, settings.sensor_height_m, 0.0]
    chunk = max(1, _RAYS_PER_CALL // len(points))
    sets = [
        seen_bits(simulator, eye[start : start + chunk], points, reach_m=range_m, tolerance_m=settings.tolerance_m)
        for start in range(0, len(eye), chunk)
    ]
    return np.concatenate(sets)


def surface_points(simulator: Simulator, settings: TaskSettings) -> NDArray[np.float64]:
    """`(k, 3)` points on the surfaces seen from all over the floor, without the floor itself, metres."""
    seen = []
    for view in views_all_over(simulator, settings):
        points = view.points[view.hit]
        seen.append(_thinned(points[np.abs(points[:, 1] - view.place[1]) > _FLOOR_M]))
    return np.asarray(_thinned(np.concatenate(seen)), dtype=np.float64)


def _thinned(points: NDArray[np.floating]) -> NDArray[np.floating]:
    """The first of `(n, 3)` points in every cube."""
    _, first = np.unique(np.floor(points / SURFACE_SPACING_M).astype(np.int64), axis=0, return_index=True)
    return points[np.sort(first)]
