"""What can be seen from where in a whole scene: a lattice of places on its floor, with tables of floor cells."""

import weakref
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from avp_habitat.poses import Intrinsics, pixel_directions
from avp_habitat.sight.tables import seen_bits
from avp_habitat.simulators.base import Simulator, SingleRays
from avp_habitat.surface.points import views_all_over
from avp_habitat.task.motion import sensor_poses
from avp_habitat.task.settings import TaskSettings

Float = NDArray[np.float64]


@dataclass(frozen=True)
class States:
    """n agents that have taken equally many views; every array's first axis is n."""

    position: Float
    """`(n, 3)` feet, metres."""
    yaw: Float
    """`(n,)` radians."""
    pitch: Float
    """`(n,)` radians."""
    seen: NDArray[np.uint64]
    """`(n, words)` bit sets of the observed cells."""
    value: Float
    """`(n,)` cells times views: what the new cells add to the area under the curve of observed cells over views."""


def start_state(position: Float, seen: NDArray[np.uint64], *, yaw: float, pitch: float) -> States:
    """One agent at `(3,)` metres that has seen the bit set `(words,)`; angles in radians."""
    return States(
        np.asarray(position, dtype=np.float64)[None], np.array([yaw]), np.array([pitch]), seen[None].copy(), np.zeros(1)
    )


SPACING_M = 0.4
"""One point for each cube of this edge that holds some surface, metres."""
SURFACE_RANGE_M = 4.0
"""A surface counts as seen from this near, metres: from farther off its texture is too coarse to reconstruct."""
_FLOOR_M = 0.05
"""Surfaces this close above or below the walkable floor are the floor, which has points of its own."""


def surface_points(simulator: Simulator, settings: TaskSettings) -> NDArray[np.float64]:
    """`(k, 3)` points on the surfaces seen from all over the floor, without the floor itself, metres.

    Args:
        simulator: of the scene.
        settings: of the task: sensor height and range.
    """
    seen = []
    for view in views_all_over(simulator, settings):
        points = view.points[view.hit]
        seen.append(_thinned(points[np.abs(points[:, 1] - view.place[1]) > _FLOOR_M]))
    return np.asarray(_thinned(np.concatenate(seen)), dtype=np.float64)


def _thinned(points: NDArray[np.floating]) -> NDArray[np.floating]:
    """The first of `(n, 3)` points in every cube."""
    _, first = np.unique(np.floor(points / SPACING_M).astype(np.int64), axis=0, return_index=True)
    return points[np.sort(first)]


Bits = NDArray[np.uint64]

TABLE_ENTRIES = 30_000_000
"""Most pairs of a place and a cell: one ray each to prepare, and two bytes each to keep."""
_PANORAMAS = 1500
"""Most places of a simulator that renders six images for each of them instead of casting single rays."""
_RAYS_PER_CALL = 1 << 20
_NEAR_M = 1.0
"""A cell nearer than this on the floor is below the image of a camera that looks ahead."""
_AHEAD_M = 0.8
"""The heading of a walk is that of the place so far along it."""


@dataclass(frozen=True)
class Lattice:
    """Places, and which points are not hidden from a camera above each of them; p places, m points.

    The points are the floor's navigable cells, "cells" below, and after them those on other surfaces that were asked
    for.
    """

    places: Float
    """`(p, 3)` floor points, metres."""
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

    def place_of(self, positions: Float) -> NDArray[np.int64]:
        """`(n,)` numbers of the places nearest to `(n, 3)` points."""
        return self.tree.query(positions[:, [0, 2]])[1].astype(np.int64)


def pack(members: NDArray[np.bool_]) -> Bits:
    """Bit sets `(n, ceil(m / 64))` of `(n, m)` truth values."""
    n, m = members.shape
    padded = np.zeros((n, -(-m // 64) * 64), dtype=np.bool_)
    padded[:, :m] = members
    return np.packbits(padded, axis=1, bitorder="little").view("<u8").astype(np.uint64)


def unpack(sets: Bits, count: int) -> NDArray[np.bool_]:
    """`(n, count)` truth values of `(n, words)` bit sets."""
    return np.unpackbits(sets.astype("<u8").view(np.uint8), axis=1, bitorder="little")[:, :count].astype(np.bool_)


def image_borders(pose: Float, intrinsics: Intrinsics) -> Float:
    """`(n, 4, 3)` inward normals of the planes through `(n, 4, 4)` cameras and their images' borders.

    In the order left, top, right, bottom; lengths are arbitrary.
    """
    width, height = intrinsics.width, intrinsics.height
    # An image of 2 x 2 pixels whose pixel centres are the corners of the true image.
    stretched = Intrinsics(
        2,
        2,
        intrinsics.fx / width,
        intrinsics.fy / height,
        intrinsics.cx / width + 0.5,
        intrinsics.cy / height + 0.5,
    )
    corner = pixel_directions(stretched)
    bottom_left, top_left, top_right, bottom_right = corner[1, 0], corner[0, 0], corner[0, 1], corner[1, 1]
    around = np.array([bottom_left, top_left, top_right, bottom_right])
    local = np.cross(around, np.roll(around, -1, axis=0))
    local *= np.sign(local @ around.sum(axis=0))[:, None]
    return np.einsum("nij,kj->nki", pose[:, :3, :3], local)


def views_from(lattice: Lattice, settings: TaskSettings, position: Float, yaw: Float, pitch: Float) -> Bits:
    """`(n, words)` cells observed by the views of n agents; what is hidden is taken from the nearest places.

    Args:
        lattice: of the scene.
        settings: of the task.
        position: `(n, 3)` feet, metres.
        yaw: `(n,)` radians.
        pitch: `(n,)` radians.
    """
    from avp_habitat.policies.oracle.kernels import look

    n, words = len(position), len(lattice.wanted)
    pose = sensor_poses(settings, position, yaw, pitch)
    sets, gain, nobody = np.zeros((n, words), np.uint64), np.zeros(n, np.int64), np.zeros((1, words), np.uint64)
    camera, normals = np.ascontiguousarray(pose[:, :3, 3]), image_borders(pose, settings.intrinsics)
    place = lattice.place_of(position)
    look(np.zeros(n, np.int64), place, camera, normals, lattice.sees, lattice.points, nobody, sets, gain)
    return sets


def lattice_of(simulator: Simulator, settings: TaskSettings, *, surfaces: bool = False) -> Lattice:
    """The scene's lattice for these settings, with or without all surfaces, prepared once per simulator object."""
    key = (settings.sensor_height_m, settings.max_range_m, settings.tolerance_m, settings.forward_m, surfaces)
    known = _lattices.setdefault(simulator, {})
    if key not in known:
        beyond = surface_points(simulator, settings) if surfaces else None
        known[key] = make_lattice(simulator, settings, beyond_floor=beyond)
    return known[key]


_lattices: weakref.WeakKeyDictionary[Simulator, dict[tuple, Lattice]] = weakref.WeakKeyDictionary()


def make_lattice(
    simulator: Simulator, settings: TaskSettings, *, beyond_floor: Float | None = None, entries: int = TABLE_ENTRIES
) -> Lattice:
    """Look from every place at every cell within range, and find the ways between the places.

    Args:
        simulator: of the scene.
        settings: of the task: sensor height, range, tolerance, length of a move.
        beyond_floor: `(k, 3)` points on other surfaces that count like floor cells once they are seen from near; none
            when omitted.
        entries: most pairs of a place and a cell; the lattice's spacing is the smallest multiple of a cell that
            keeps below.
    """
    from avp_habitat.policies.oracle import kernels

    area = simulator.area
    points = np.concatenate([area.centres, np.empty((0, 3)) if beyond_floor is None else beyond_floor])
    most = entries // len(points)
    stride, cells = _stride(area.mask, most if isinstance(simulator, SingleRays) else min(most, _PANORAMAS))
    places = area.centres[cells]
    range_m = np.full(len(points), settings.max_range_m)
    range_m[len(area.centres) :] = np.minimum(SURFACE_RANGE_M, settings.max_range_m)
    sees = _unhidden(simulator, places, points, range_m, settings)
    grid = np.full(area.mask.shape, -1, dtype=np.int64)
    grid[tuple(np.argwhere(area.mask)[cells].T)] = np.arange(len(cells))
    other, length = kernels.neighbour_table(np.ascontiguousarray(grid[::stride, ::stride]), len(cells))
    spacing = stride * area.cell_m
    reach, heading = kernels.reach_tables(
        sees,
        points,
        places,
        other,
        length,
        spacing / kernels.LENGTHS_PER_SPACING / settings.forward_m,
        max(1, round(_AHEAD_M / spacing)),
        _NEAR_M,
    )
    wanted = np.bitwise_or.reduce(sees, axis=0)
    return Lattice(
        places=places,
        points=points,
        sees=sees,
        wanted=wanted,
        reach=reach,
        heading=heading,
        neighbours=other,
        lengths_m=np.asarray(length * spacing / kernels.LENGTHS_PER_SPACING, dtype=np.float64),
        tree=KDTree(places[:, [0, 2]]),
    )


def _stride(mask: NDArray[np.bool_], most: int) -> tuple[int, NDArray[np.int64]]:
    """Spacing in cells, and the numbers of the navigable cells that are places, at most so many if it can be."""
    rows, columns = np.nonzero(mask)
    stride = 0
    while True:
        stride += 1
        cells = np.flatnonzero((rows % stride == 0) & (columns % stride == 0))
        if 0 < len(cells) <= max(most, 1):
            return stride, cells


def _unhidden(simulator: Simulator, places: Float, points: Float, range_m: Float, settings: TaskSettings) -> Bits:
    eye = places + [0.0, settings.sensor_height_m, 0.0]
    chunk = max(1, _RAYS_PER_CALL // len(points))
    sets = [
        seen_bits(simulator, eye[start : start + chunk], points, reach_m=range_m, tolerance_m=settings.tolerance_m)
        for start in range(0, len(eye), chunk)
    ]
    return np.concatenate(sets)
