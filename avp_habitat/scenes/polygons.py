"""Polygons as triangles: fans where they are convex, ears cut off where they are not, as around a door in a wall."""

from collections.abc import Callable

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
        _cut(
            some, lengths[some], start[some], begin[some], lambda at: positions[corners[at]].astype(np.float64), places
        )
    return places, polygons


def _portions(indices: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    return np.array_split(indices, len(indices) // _AT_ONCE + 1)


def _is_bent(a: NDArray, b: NDArray, c: NDArray, d: NDArray) -> NDArray[np.bool_]:
    """`(n,)` whether the diagonal from a to c lies outside of a quad: its halves face different ways."""
    with np.errstate(over="ignore", invalid="ignore"):
        across = c - a
        one, two = _crossed(b - a, across), _crossed(across, d - a)
        whole = one + two
        least = np.minimum((one * whole).sum(axis=1), (two * whole).sum(axis=1))
        return least < -_STRAIGHT * (whole * whole).sum(axis=1)


def _crossed(one: NDArray, two: NDArray) -> NDArray:
    (x, y, z), (u, v, w) = one.T, two.T
    return np.stack([y * w - z * v, z * u - x * w, x * v - y * u], axis=1)


def _cut(
    some: NDArray,
    lengths: NDArray,
    start: NDArray,
    begin: NDArray,
    points: Callable[[NDArray], NDArray[np.float64]],
    places: NDArray[np.int64],
) -> None:
    """Replace the fans of those polygons that are not convex, in place."""
    of = np.repeat(np.arange(len(some)), lengths)
    end = np.cumsum(lengths)
    own = np.arange(len(of)) - (end - lengths)[of]
    here, before, after = (points(start[of] + (own + step) % lengths[of]) - points(start[of]) for step in (0, -1, 1))
    with np.errstate(over="ignore", invalid="ignore"):
        crossed = _crossed(here, after)
        normals = np.zeros((len(some), 3))
        for axis in range(3):
            normals[:, axis] = np.bincount(of, crossed[:, axis], len(some))
        turns = (_crossed(here - before, after - here) * normals[of]).sum(axis=1)
        wrong = turns < -_STRAIGHT * (normals**2).sum(axis=1)[of]
    count = np.bincount(of[wrong], minlength=len(some))
    for index in np.flatnonzero(count):
        if lengths[index] > _MOST_CORNERS:
            raise ValueError(
                f"polygon {some[index] + 1} is not convex and has {lengths[index]} corners; expected {_MOST_CORNERS} "
                "at most: export the scene with triangles"
            )
        ears = _ears(here[end[index] - lengths[index] : end[index]], normals[index])
        places[begin[index] : begin[index] + len(ears)] = start[index] + ears


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
