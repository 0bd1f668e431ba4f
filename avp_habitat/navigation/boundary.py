"""The outline of a picture of voxel columns, simplified by Recast's rule, as closed rings.

Rings run with the inside on their left in the plane with x to the right and z up, the outer ring first. Source of the
simplification: M. Mononen, Recast Navigation (contours).
"""

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import shapely

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
