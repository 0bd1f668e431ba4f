"""Conservative voxelisation of a triangle mesh into columns of solid spans, by Recast's rules.

Every triangle is cut along the borders of the columns that it touches, and fills in each of them the voxels between the
lowest and the highest point of its piece. Touching spans of a column become one; its top faces as the piece that made
the top does, or one whose top lies within the climb of it. Single precision and the triangles' order are kept as Recast
has them, because both decide on which side of a voxel border a level floor falls. Recast knows floors that face upwards
only; the surfaces that face downwards are kept too, for rooms whose triangles are wound the wrong way round.
Source: M. Mononen, Recast Navigation (rasterisation).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from avp_habitat.compiled import njit
from avp_habitat.errors import SceneError
from avp_habitat.navigation.settings import NavigationSettings

UPWARDS, DOWNWARDS = 1, 2
"""Bits of level triangles that face upwards, and of those that face downwards."""
_BOTH = UPWARDS | DOWNWARDS
_MOST_COLUMNS = 40_000_000
_HIGHEST_VOXEL = 8191


@dataclass(frozen=True)
class Heightfield:
    """Solid spans of all columns, column after column (row-major), each column from the bottom to the top."""

    origin: NDArray[np.float32]
    """`(3,)` least corner of voxel (0, 0, 0) in metres."""
    shape: tuple[int, int]
    """Rows (along +Z) and columns (along +X) of the floor plane."""
    first: NDArray[np.int64]
    """`(rows * columns + 1,)` index of each column's first span."""
    bottom: NDArray[np.int32]
    """`(n,)` lowest voxel of each span."""
    top: NDArray[np.int32]
    """`(n,)` first voxel above each span."""
    facing: NDArray[np.uint8]
    """`(n,)` bits of what lies within the climb of each span's top, as Recast counts it."""
    highest: NDArray[np.uint8]
    """`(n,)` bits of what makes the top itself; 0 where that is not level."""


def level_triangles(
    vertices: NDArray[np.float32], triangles: NDArray[np.int32], max_slope_deg: float
) -> NDArray[np.int64]:
    """`(t,)` `UPWARDS` or `DOWNWARDS`, as their winding tells, of triangles level within the slope; 0 of others."""
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    length = np.sqrt((normal * normal).sum(axis=1, dtype=np.float32))
    least = np.float32(np.cos(np.radians(max_slope_deg))) * length
    return np.where(normal[:, 1] > least, UPWARDS, np.where(-normal[:, 1] > least, DOWNWARDS, 0))


def check_size(vertices: NDArray[np.float32], settings: NavigationSettings) -> None:
    """Refuse a mesh of which no voxels can be made, before any arithmetic on it overflows.

    Raises:
        SceneError: the mesh is so wide that its columns would not fit into memory; it is not in metres.
    """
    width, height, depth = vertices.max(axis=0).astype(np.float64) - vertices.min(axis=0)
    most = _MOST_COLUMNS * settings.voxel_m**2
    if width * depth > most or max(width, height, depth) > most:
        raise SceneError(
            f"the scene measures {width:.6g} x {height:.6g} x {depth:.6g} m (x, y, z): expected at most {most:.0f} m² "
            "of floor; is it in millimetres or centimetres instead of metres?"
        )


def voxelise(vertices: NDArray[np.float32], triangles: NDArray[np.int32], settings: NavigationSettings) -> Heightfield:
    """Voxelise a mesh.

    Args:
        vertices: `(v, 3)` metres, Y up, finite, of a size that `check_size` passes.
        triangles: `(t, 3)` vertex indices.
        settings: voxel sizes, slope and climb.
    """
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    cell, level = np.float32(settings.voxel_m), np.float32(settings.voxel_height_m)
    columns, rows = (max(1, int((high[axis] - low[axis]) / cell + np.float32(0.5))) for axis in (0, 2))
    level_enough = level_triangles(vertices, triangles, settings.max_slope_deg)
    first, bottom, top, bits = _rasterise(
        vertices, triangles, level_enough, low, high, cell, level, rows, columns, settings.climb_voxels
    )
    return Heightfield(low, (rows, columns), first, bottom, top, bits & np.uint8(_BOTH), bits >> np.uint8(2))


@njit(cache=True)
def _cut(polygon, count, axis, limit, below, above):
    """Cut a convex polygon at a coordinate; returns the numbers of vertices below and above."""
    low = high = 0
    for i in range(count):
        j = i - 1 if i > 0 else count - 1
        side, side_before = limit - polygon[i, axis], limit - polygon[j, axis]
        if (side > 0 and side_before < 0) or (side < 0 and side_before > 0):
            share = side_before / (side_before - side)
            for k in range(3):
                below[low, k] = above[high, k] = polygon[j, k] + (polygon[i, k] - polygon[j, k]) * share
            low, high = low + 1, high + 1
        if side >= 0:
            for k in range(3):
                below[low, k] = polygon[i, k]
            low += 1
        if side <= 0:
            for k in range(3):
                above[high, k] = polygon[i, k]
            high += 1
    return low, high


@njit(cache=True)
def _grown(array):
    bigger = np.empty((2 * array.shape[0], array.shape[1]), array.dtype)
    for i in range(array.shape[0]):
        for k in range(array.shape[1]):
            bigger[i, k] = array[i, k]
    return bigger


@njit(cache=True)
def _insert(head, pool, state, column, low, high, facing, climb):
    """Add a span to a column's linked list, melting it with those that it touches.

    `pool` rows are (bottom, top, bits of facing and above them of highest, next); `state` is (first free row of the
    pool or -1, rows ever used).
    """
    before, at, highest = -1, head[column], facing
    while at >= 0 and pool[at, 0] <= high:
        after = pool[at, 3]
        if pool[at, 1] < low:
            before = at
        else:
            if pool[at, 1] >= high:
                highest = pool[at, 2] >> 2 | (highest if pool[at, 1] == high else 0)
            low, high = min(low, pool[at, 0]), max(high, pool[at, 1])
            if high - pool[at, 1] <= climb:
                facing |= pool[at, 2] & _BOTH
            pool[at, 3], state[0] = state[0], at
            if before >= 0:
                pool[before, 3] = after
            else:
                head[column] = after
        at = after
    slot = state[0]
    if slot >= 0:
        state[0] = pool[slot, 3]
    else:
        slot = state[1]
        state[1] += 1
    pool[slot, 0], pool[slot, 1], pool[slot, 2], pool[slot, 3] = low, high, facing | highest << 2, at
    if before >= 0:
        pool[before, 3] = slot
    else:
        head[column] = slot


@njit(cache=True)
def _voxel_range(piece, count, floor, ceiling, level):
    """Lowest voxel and first voxel above of a polygon's piece; (0, 0) when it is outside."""
    low, high = piece[0, 1], piece[0, 1]
    for i in range(1, count):
        low, high = min(low, piece[i, 1]), max(high, piece[i, 1])
    low, high = low - floor, high - floor
    if high < 0 or low > ceiling - floor:
        return 0, 0
    per_metre = np.float32(1) / level
    bottom = min(max(int(np.floor(max(low, np.float32(0)) * per_metre)), 0), _HIGHEST_VOXEL - 1)
    top = int(np.ceil(min(high, ceiling - floor) * per_metre))
    return bottom, min(max(top, bottom + 1), _HIGHEST_VOXEL)


@njit(cache=True)
def _extent(polygon, count, axis, origin, per_metre, cells):
    """First and last cell that a polygon touches along an axis; one before the first where it starts outside."""
    low, high = polygon[0, axis], polygon[0, axis]
    for i in range(1, count):
        low, high = min(low, polygon[i, axis]), max(high, polygon[i, axis])
    start, end = int((low - origin) * per_metre), int((high - origin) * per_metre)
    if end < 0 or (start >= cells and axis == 0):
        return 0, -1
    return min(max(start, -1), cells - 1), min(max(end, 0), cells - 1)


@njit(cache=True)
def _rasterise(vertices, triangles, level_enough, low, high, cell, level, rows, columns, climb):
    head = np.full(rows * columns, -1, np.int64)
    pool = np.empty((max(1024, rows * columns), 4), np.int64)
    state = np.array([-1, 0])
    rest, row, spare = np.empty((12, 3), np.float32), np.empty((12, 3), np.float32), np.empty((12, 3), np.float32)
    piece = np.empty((12, 3), np.float32)
    per_metre = np.float32(1) / cell
    # Typed numbers: a literal would make the compiler compile every callee once more.
    three, along_z = np.int64(3), np.int64(2)
    for t in range(len(triangles)):
        for k in range(9):
            rest[k // 3, k % 3] = vertices[triangles[t, k // 3], k % 3]
        left = three
        start, end = _extent(rest, left, along_z, low[2], per_metre, rows)
        for z in range(start, end + 1):
            limit = low[2] + np.float32(z) * cell + cell
            in_row, left = _cut(rest, left, along_z, limit, row, spare)
            rest, spare = spare, rest
            if in_row >= 3 and z >= 0:
                column_heads = head[z * columns : (z + 1) * columns]
                facing = level_enough[t]
                pool = _fill_row(
                    column_heads, pool, state, row, in_row, piece, spare, low, high, cell, level, facing, climb
                )
    return _flattened(head, pool)


@njit(cache=True)
def _fill_row(head, pool, state, row, in_row, piece, spare, low, high, cell, level, facing, climb):
    """Cut a triangle's piece in one row of columns into columns; returns the pool, which may have moved."""
    along_x = np.int64(0)
    start, end = _extent(row, in_row, along_x, low[0], np.float32(1) / cell, len(head))
    for x in range(start, end + 1):
        limit = low[0] + np.float32(x) * cell + cell
        count, in_row = _cut(row, in_row, along_x, limit, piece, spare)
        row, spare = spare, row
        if count < 3 or x < 0:
            continue
        bottom, top = _voxel_range(piece, count, low[1], high[1], level)
        if top > bottom:
            if state[0] < 0 and state[1] == len(pool):
                pool = _grown(pool)
            _insert(head, pool, state, x, bottom, top, facing, climb)
    return pool


@njit(cache=True)
def _flattened(head, pool):
    first = np.zeros(len(head) + 1, np.int64)
    for column in range(len(head)):
        count, at = 0, head[column]
        while at >= 0:
            count, at = count + 1, pool[at, 3]
        first[column + 1] = first[column] + count
    bottom, top = np.empty(first[-1], np.int32), np.empty(first[-1], np.int32)
    bits = np.empty(first[-1], np.uint8)
    for column in range(len(head)):
        at = head[column]
        for i in range(first[column], first[column + 1]):
            bottom[i], top[i], bits[i] = pool[at, 0], pool[at, 1], pool[at, 2]
            at = pool[at, 3]
    return first, bottom, top, bits
