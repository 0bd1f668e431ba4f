"""Polygons as triangles: fans where they are convex, ears cut off where they are not, as around a door in a wall."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

_AT_ONCE = 500_000
_MOST_CORNERS = 2000
_STRAIGHT = 1e-9
"""Share of a polygon's area by which a corner may turn the wrong way."""


def triangulate(
    lengths: NDArray[np.integer], corners: NDArray[np.integer], positions: NDArray[np.floating]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Cut polygons into triangles that cover them and nothing else.

    Args:
        lengths: `(n,)` corners of each polygon, whose corners follow one another.
        corners: `(sum of lengths,)` their vertices.
        positions: `(v, 3)` of the vertices.

    Returns:
        `(t, 3)` places of the triangles' corners in the list of all corners, and `(t,)` the polygons they are of.

    Raises:
        ValueError: a polygon that is not convex has so many corners that to cut it would take minutes.
    """
    lengths = np.asarray(lengths, np.int64)
    each = np.maximum(lengths - 2, 0)
    polygons = np.repeat(np.arange(len(lengths)), each)
    start, begin = np.cumsum(lengths) - lengths, np.cumsum(each) - each
    first = start[polygons]
    step = np.arange(len(polygons)) - begin[polygons]
    places = np.stack([first, first + step + 1, first + step + 2], axis=1)
    for some in _portions(np.flatnonzero(lengths == 4)):
        at = start[some]
        turned = some[_is_bent(*(positions[corners[at + step]].astype(np.float64) for step in range(4)))]
        # The other diagonal.
        places[begin[turned]] = start[turned, None] + [1, 2, 3]
        places[begin[turned] + 1] = start[turned, None] + [1, 3, 0]
    for some in _portions(np.flatnonzero(lengths > 4)):
        for polygon, points, normal in _not_convex(some, lengths[some], start[some], corners, positions):
            if len(points) > _MOST_CORNERS:
                raise ValueError(
                    f"polygon {polygon + 1} is not convex and has {len(points)} corners; expected {_MOST_CORNERS} at "
                    "most: export the scene with triangles"
                )
            places[begin[polygon] :][: len(points) - 2] = start[polygon] + _ears(points, normal)
    return places, polygons


def _portions(indices: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    return np.array_split(indices, len(indices) // _AT_ONCE + 1)


def _is_bent(a: NDArray, b: NDArray, c: NDArray, d: NDArray) -> NDArray[np.bool_]:
    """`(n,)` whether the diagonal from a to c lies outside of a quad: its halves face different ways."""
    with np.errstate(over="ignore", invalid="ignore"):
        one, two = np.cross(b - a, c - a), np.cross(c - a, d - a)
        whole = one + two
        least = np.minimum((one * whole).sum(axis=1), (two * whole).sum(axis=1))
        return least < -_STRAIGHT * (whole * whole).sum(axis=1)


def _not_convex(
    some: NDArray, lengths: NDArray, start: NDArray, corners: NDArray, positions: NDArray
) -> Iterator[tuple[int, NDArray[np.float64], NDArray[np.float64]]]:
    """Index, `(n, 3)` corners and normal of each polygon with a corner that turns the wrong way."""
    of = np.repeat(np.arange(len(some)), lengths)
    end = np.cumsum(lengths)
    own = np.arange(len(of)) - (end - lengths)[of]
    first = positions[corners[start]].astype(np.float64)[of]
    here, before, after = (
        positions[corners[start[of] + (own + step) % lengths[of]]].astype(np.float64) - first for step in (0, -1, 1)
    )
    with np.errstate(over="ignore", invalid="ignore"):
        crossed = np.cross(here, after)
        normals = np.stack([np.bincount(of, crossed[:, axis], len(some)) for axis in range(3)], axis=1)
        turns = (np.cross(here - before, after - here) * normals[of]).sum(axis=1)
        wrong = turns < -_STRAIGHT * (normals**2).sum(axis=1)[of]
    for index in np.unique(of[wrong]):
        yield int(some[index]), here[end[index] - lengths[index] : end[index]], normals[index]


def _ears(corners: NDArray[np.float64], normal: NDArray[np.float64]) -> NDArray[np.int64]:
    """`(n - 2, 3)` triangles of a polygon of `(n, 3)` corners, seen from where its normal points to."""
    axis = int(np.abs(normal).argmax())
    flat = corners[:, [(axis + 1) % 3, (axis + 2) % 3]]
    if normal[axis] < 0:
        flat = flat[:, ::-1]
    left, triangles, at, missed = list(range(len(flat))), [], 0, 0
    while len(left) > 3:
        at %= len(left)
        corner = left[at - 1], left[at], left[(at + 1) % len(left)]
        # Where a polygon crosses itself there may be no ear.
        if missed == len(left) or _is_ear(flat[list(corner)], flat[left]):
            triangles.append(corner)
            del left[at]
            missed = 0
        else:
            missed += 1
        at += 1
    return np.array([*triangles, left], np.int64)


def _is_ear(corner: NDArray[np.float64], left: NDArray[np.float64]) -> bool:
    """Whether a corner with its neighbours turns to the left, and no other point lies in their triangle."""
    sides = np.roll(corner, -1, axis=0) - corner
    if not sides[0, 0] * sides[1, 1] - sides[0, 1] * sides[1, 0] > 0:
        return False
    to = left[:, None] - corner
    inside = (sides[:, 0] * to[..., 1] - sides[:, 1] * to[..., 0] >= 0).all(axis=1)
    return not (inside & (to != 0).any(axis=2).all(axis=1)).any()
