"""The outline of a navigable area: traced from voxel columns, simplified by Recast's rule, and as walls.

Rings run with the inside on their left in the plane with x to the right and z up, the outer ring first. Source of the
simplification: M. Mononen, Recast Navigation (contours).
"""

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from avp_habitat.compiled import njit

if TYPE_CHECKING:
    import shapely


SKIN_M = 1e-4
"""Distance in metres at which agents stop before a wall, so that every later test against it is safe from rounding."""
_BIN_M = 0.25


class Walls(NamedTuple):
    """Directed segments with the inside on their left, and the bins that they pass through."""

    ends: NDArray[np.float64]
    """`(k, 4)` x and z of the begin, x and z of the end, metres."""
    origin: NDArray[np.float64]
    """`(2,)` least x and z of the bins."""
    bin_m: float
    """Side of a bin in metres."""
    shape: tuple[int, int]
    """Bins along z and x."""
    first: NDArray[np.int64]
    """`(bins + 1,)` index of each bin's first entry in `member`."""
    member: NDArray[np.int64]
    """Indices of walls, bin after bin."""


def make_walls(rings: list[NDArray[np.float64]]) -> Walls:
    """Walls along closed rings: `(k, 2)` corners (x, z) in metres each, the inside on the left."""
    ends = np.concatenate([np.hstack([ring, np.roll(ring, -1, axis=0)]) for ring in rings])
    ends = np.ascontiguousarray(ends[np.hypot(ends[:, 2] - ends[:, 0], ends[:, 3] - ends[:, 1]) > 0])
    corners = ends[:, :2]
    origin = corners.min(axis=0) - _BIN_M / 2
    columns, rows = (int(n) for n in np.ceil((corners.max(axis=0) + _BIN_M / 2 - origin) / _BIN_M))
    first, member = _fill_bins(ends, origin, _BIN_M, (rows, columns))
    return Walls(ends, origin, _BIN_M, (rows, columns), first, member)


@njit(cache=True)
def _rows(az, bz, origin, bin_m, rows):
    """First and last row of bins that a segment passes through, the skin included."""
    low, high = min(az, bz) - SKIN_M - origin[1], max(az, bz) + SKIN_M - origin[1]
    return max(int(np.floor(low / bin_m)), 0), min(int(np.floor(high / bin_m)), rows - 1)


@njit(cache=True)
def _columns(ax, az, bx, bz, row, origin, bin_m, columns):
    """First and last column of bins that the part of a segment in a row passes through, the skin included."""
    low, high = origin[1] + row * bin_m - 2 * SKIN_M, origin[1] + (row + 1) * bin_m + 2 * SKIN_M
    begin, end = 0.0, 1.0
    if az != bz:
        one, two = (low - az) / (bz - az), (high - az) / (bz - az)
        begin, end = max(min(one, two), 0.0), min(max(one, two), 1.0)
    x0, x1 = ax + begin * (bx - ax), ax + end * (bx - ax)
    left, right = min(x0, x1) - 2 * SKIN_M - origin[0], max(x0, x1) + 2 * SKIN_M - origin[0]
    return max(int(np.floor(left / bin_m)), 0), min(int(np.floor(right / bin_m)), columns - 1)


@njit(cache=True)
def _fill_bins(ends, origin, bin_m, shape):
    rows, columns = shape
    count = np.zeros(rows * columns + 1, np.int64)
    member = np.empty(0, np.int64)
    for writing in (False, True):
        for k in range(len(ends)):
            ax, az, bx, bz = ends[k]
            first_row, last_row = _rows(az, bz, origin, bin_m, rows)
            for row in range(first_row, last_row + 1):
                left, right = _columns(ax, az, bx, bz, row, origin, bin_m, columns)
                for at in range(row * columns + left, row * columns + right + 1):
                    if writing:
                        member[count[at]] = k
                        count[at] += 1
                    else:
                        count[at + 1] += 1
        if not writing:
            count = np.cumsum(count)
            member = np.empty(count[-1], np.int64)
    first = np.zeros_like(count)
    first[1:] = count[:-1]
    return first, member


@njit(cache=True)
def near_line(walls, ax, az, bx, bz, seen, ticket, found):
    """Collect the walls within the skin of a line (and some farther ones), each once.

    `seen` `(k,)` holds the last ticket of each wall, `found` `(k,)` takes their indices; returns how many.
    """
    count = 0
    rows, columns = walls.shape
    first_row, last_row = _rows(az, bz, walls.origin, walls.bin_m, rows)
    for row in range(first_row, last_row + 1):
        left, right = _columns(ax, az, bx, bz, row, walls.origin, walls.bin_m, columns)
        for at in range(row * columns + left, row * columns + right + 1):
            for entry in range(walls.first[at], walls.first[at + 1]):
                k = walls.member[entry]
                if seen[k] != ticket:
                    seen[k] = ticket
                    found[count] = k
                    count += 1
    return count


@njit(cache=True)
def is_inside(walls, x, z):
    """Whether a point lies within the outline: a ray along +X crosses the walls an odd number of times."""
    rows, columns = walls.shape
    row = int(np.floor((z - walls.origin[1]) / walls.bin_m))
    if row < 0 or row >= rows:
        return False
    ends = walls.ends
    inside = False
    start = max(int(np.floor((x - walls.origin[0]) / walls.bin_m)), 0)
    for at in range(row * columns + start, (row + 1) * columns):
        for entry in range(walls.first[at], walls.first[at + 1]):
            k = walls.member[entry]
            if (ends[k, 1] > z) != (ends[k, 3] > z):
                share = (z - ends[k, 1]) / (ends[k, 3] - ends[k, 1])
                crossing = ends[k, 0] + share * (ends[k, 2] - ends[k, 0])
                column = int(np.floor((crossing - walls.origin[0]) / walls.bin_m))
                if crossing > x and column == at - row * columns:
                    inside = not inside
    return inside


@njit(cache=True)
def are_inside(walls, points):
    """`(n,)` bool for `(n, 2)` points (x, z)."""
    result = np.empty(len(points), np.bool_)
    for i in range(len(points)):
        result[i] = is_inside(walls, points[i, 0], points[i, 1])
    return result


@njit(cache=True)
def off_walls(walls, points):
    """The same `(n, 2)` points, those closer to a wall than the skin moved to its inner side."""
    result = points.copy()
    seen, found = np.zeros(len(walls.ends), np.int64), np.empty(len(walls.ends), np.int64)
    ticket = 0
    for i in range(len(points)):
        for _ in range(4):
            ticket += 1
            x, z = result[i]
            count = near_line(walls, x, z, x, z, seen, ticket, found)
            moved = False
            for k in found[:count]:
                moved |= _push(walls.ends[k], result[i])
            if not moved:
                break
    return result


@njit(cache=True)
def _push(wall, point):
    """Move a point away from a wall that is closer than the skin; returns whether it was."""
    ax, az, bx, bz = wall
    length = np.hypot(bx - ax, bz - az)
    ux, uz = (bx - ax) / length, (bz - az) / length
    along = min(max((point[0] - ax) * ux + (point[1] - az) * uz, 0.0), length)
    off_x, off_z = point[0] - ax - along * ux, point[1] - az - along * uz
    distance = np.hypot(off_x, off_z)
    if distance >= SKIN_M * (1 - 1e-9):
        return False
    if distance == 0 or 0 < along < length:
        off_x, off_z, distance = -uz, ux, 1.0
    point[0], point[1] = ax + along * ux + SKIN_M * off_x / distance, az + along * uz + SKIN_M * off_z / distance
    return True


Ring = NDArray[np.float64]
_DIRECTIONS = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])


def trace(inside: NDArray[np.bool_]) -> list[NDArray[np.int64]]:
    """Rings of unit steps around all pixels that are inside; pixels that touch at a corner only stay apart.

    Args:
        inside: `(rows, columns)`, rows along z.

    Returns:
        `(k, 2)` corners (x, z) each.
    """
    padded = np.pad(inside, 1)
    beside = [padded[:-2, 1:-1], padded[1:-1, 2:], padded[2:, 1:-1], padded[1:-1, :-2]]
    begins = [(0, 0), (1, 0), (1, 1), (0, 1)]
    leaving: dict[tuple[int, int], list[int]] = {}
    for direction in range(4):
        rows, columns = np.nonzero(inside & ~beside[direction])
        x, z = columns + begins[direction][0], rows + begins[direction][1]
        for corner in zip(x.tolist(), z.tolist(), strict=True):
            leaving.setdefault(corner, []).append(direction)
    rings = []
    while leaving:
        rings.append(_walk(leaving, next(iter(leaving))))
    return rings


def _walk(leaving: dict[tuple[int, int], list[int]], start: tuple[int, int]) -> NDArray[np.int64]:
    """One ring from a corner, taken out of the steps that leave each corner; where two do, the left turn is ours."""
    ring, corner, direction = [], start, leaving[start][0]
    first = direction
    while True:
        leaving[corner].remove(direction)
        if not leaving[corner]:
            del leaving[corner]
        ring.append(corner)
        corner = (corner[0] + int(_DIRECTIONS[direction][0]), corner[1] + int(_DIRECTIONS[direction][1]))
        left = (direction + 1) % 4
        if corner == start and (left == first or corner not in leaving):
            return np.array(ring)
        direction = left if left in leaving[corner] else leaving[corner][0]


def simplify(ring: NDArray[np.int64], max_error: float) -> NDArray[np.int64]:
    """Fewer corners, none of the ring's own farther than `max_error` from the result.

    Starts from the two corners that are least and greatest in (x, z) and adds the farthest corner until all are near.
    """
    order = np.lexsort((ring[:, 1], ring[:, 0]))
    first, second = sorted((int(order[0]), int(order[-1])))
    kept = _between(ring, first, second, max_error) + _between(ring, second, first + len(ring), max_error)
    return ring[np.array(kept) % len(ring)]


def _between(ring: NDArray[np.int64], start: int, end: int, max_error: float) -> list[int]:
    """Indices of the corners to keep from `start` up to but without `end`."""
    kept, waiting = [], [(start, end)]
    while waiting:
        start, end = waiting.pop()
        split = _farthest(ring, start, end, max_error)
        if split is None:
            kept.append(start)
        else:
            waiting += [(split, end), (start, split)]
    return kept


def _farthest(ring: NDArray[np.int64], start: int, end: int, max_error: float) -> int | None:
    """The corner farthest from the chord when it is too far; equal ones are told apart from the chord's lesser end."""
    between = np.arange(start + 1, end)
    a, b = ring[start % len(ring)], ring[end % len(ring)]
    if tuple(b) < tuple(a):
        between, a, b = between[::-1], b, a
    if not len(between):
        return None
    points = ring[between % len(ring)]
    chord = (b - a).astype(np.float64)
    along = np.clip((points - a) @ chord / max(chord @ chord, 1.0), 0.0, 1.0)
    off = ((a + along[:, None] * chord - points) ** 2).sum(axis=1)
    farthest = int(np.argmax(off))
    return int(between[farthest]) if off[farthest] > max_error**2 else None


def outline(inside: NDArray[np.bool_], max_error: float) -> list[Ring]:
    """The simplified outline of a connected picture: its outer ring, then its holes.

    Where simplified rings cross, what lies outside of one of them is outside; of what falls apart the largest piece is
    kept.

    Args:
        inside: `(rows, columns)`, at least one pixel set, connected along rows and columns.
        max_error: in pixels.

    Returns:
        `(k, 2)` corners (x, z) in pixels each; an empty list when nothing is left.
    """
    import shapely

    rings = [simplify(ring, max_error) for ring in trace(inside)]
    outer, holes = [], []
    for ring in rings:
        if len(ring) >= 3:
            (outer if doubled_area(ring) > 0 else holes).append(shapely.make_valid(shapely.Polygon(ring)))
    return largest_piece(shapely.difference(shapely.union_all(outer), shapely.union_all(holes)))


def largest_piece(shape: "shapely.Geometry") -> list[Ring]:
    """Rings of the largest polygon of a shapely geometry, as `outline` returns them."""
    import shapely

    pieces = [piece for piece in shapely.get_parts(shape) if piece.geom_type == "Polygon" and piece.area > 0]
    if not pieces:
        return []
    piece = shapely.geometry.polygon.orient(max(pieces, key=lambda polygon: polygon.area))
    return [np.asarray(ring.coords)[:-1] for ring in (piece.exterior, *piece.interiors)]


def doubled_area(ring: NDArray) -> float:
    """Twice the area within a `(k, 2)` ring, positive when the inside is on its left."""
    x, z = ring[:, 0], ring[:, 1]
    return float((x * np.roll(z, -1) - np.roll(x, -1) * z).sum())
