"""Shortest walks on the floor plane: straight lines that bend only around corners of the outline.

A shortest path among polygons turns only at corners that poke into the free space (de Berg et al., Computational
Geometry, chapter 15). The roadmap joins all such corners that see each other; they are moved at most
`_OFF_M * _MOST_MITRE` = 0.9 mm into the free space so that no leg touches a wall. What is found is therefore a walk
that an agent can take, longer than the shortest by at most 2 mm for every corner that it turns at.
"""

import heapq
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from avp_habitat.compiled import njit
from avp_habitat.navigation.walls import SKIN_M, Walls, near_line

_OFF_M = 3 * SKIN_M
_MOST_MITRE = 3.0


class Roadmap(NamedTuple):
    """Corners of the free space and the straight walks between them."""

    points: NDArray[np.float64]
    """`(k, 2)` x and z in metres."""
    first: NDArray[np.int64]
    """`(k + 1,)` index of each corner's first neighbour."""
    neighbour: NDArray[np.int64]
    """Indices of the corners that are seen, corner after corner."""


def make_roadmap(walls: Walls, rings: list[NDArray[np.float64]]) -> Roadmap:
    """Join the corners of closed rings `(k, 2)` (inside on the left) that see each other."""
    points, arms = [], []
    for ring in rings:
        before, after = np.roll(ring, 1, axis=0) - ring, np.roll(ring, -1, axis=0) - ring
        before /= np.linalg.norm(before, axis=1, keepdims=True)
        after /= np.linalg.norm(after, axis=1, keepdims=True)
        turn = before[:, 1] * after[:, 0] - before[:, 0] * after[:, 1]
        pokes = turn < -1e-9
        out = -(before + after)[pokes]
        out /= np.linalg.norm(out, axis=1, keepdims=True)
        sine = np.abs(after[pokes, 0] * out[:, 1] - after[pokes, 1] * out[:, 0])
        points.append(ring[pokes] + out * (_OFF_M * np.minimum(1 / np.maximum(sine, 1e-9), _MOST_MITRE))[:, None])
        arms.append(np.hstack([before, after])[pokes])
    corners, arms = np.concatenate(points), np.concatenate(arms)
    first, neighbour = _join(walls, corners, arms)
    return Roadmap(corners, first, neighbour)


def distances(walls: Walls, roadmap: Roadmap, start: NDArray, goals: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """Shortest walks from one point to many.

    Args:
        walls: outline of the navigable area.
        roadmap: of the same outline.
        start: `(2,)` x and z inside the outline, metres.
        goals: `(n, 2)` x and z, metres.

    Returns:
        `(n,)` lengths in metres, inf where there is no walk; `(n,)` index of the last corner before each goal, -1 for
        none; `(k,)` index of the corner before each corner, -1 for the start.
    """
    at_corner, before = _search(walls, roadmap, start[0], start[1])
    order = np.argsort(at_corner, kind="stable")
    length, last = _reach(walls, roadmap.points, at_corner, order, start, np.ascontiguousarray(goals))
    return length, last, before


@njit(cache=True)
def _crosses(ends, k, ax, az, bx, bz):
    """Whether wall k and a line have a point in common."""
    cx, cz, dx, dz = ends[k]
    one = (bx - ax) * (cz - az) - (bz - az) * (cx - ax)
    two = (bx - ax) * (dz - az) - (bz - az) * (dx - ax)
    if (one > 0 and two > 0) or (one < 0 and two < 0):
        return False
    three = (dx - cx) * (az - cz) - (dz - cz) * (ax - cx)
    four = (dx - cx) * (bz - cz) - (dz - cz) * (bx - cx)
    return not ((three > 0 and four > 0) or (three < 0 and four < 0))


@njit(cache=True)
def _sees(walls, ax, az, bx, bz, seen, ticket, found):
    """Whether a line touches no wall."""
    count = near_line(walls, ax, az, bx, bz, seen, ticket, found)
    for k in found[:count]:  # noqa: SIM110 (numba has no early exit from all())
        if _crosses(walls.ends, k, ax, az, bx, bz):
            return False
    return True


@njit(cache=True)
def _bends(arms, i, dx, dz):
    """Whether a taut rope along a direction can bend at a corner: both walls lie on one side of it."""
    one = dx * arms[i, 1] - dz * arms[i, 0]
    two = dx * arms[i, 3] - dz * arms[i, 2]
    slack = 0.01 * np.hypot(dx, dz)
    return not ((one > slack and two < -slack) or (one < -slack and two > slack))


@njit(cache=True)
def _join(walls, corners, arms):
    count = len(corners)
    seen, found = np.zeros(len(walls.ends), np.int64), np.empty(len(walls.ends), np.int64)
    ticket = 0
    pairs = [(np.int64(0), np.int64(0)) for _ in range(0)]
    for i in range(count):
        for j in range(i):
            dx, dz = corners[j, 0] - corners[i, 0], corners[j, 1] - corners[i, 1]
            near = dx * dx + dz * dz < 0.01
            if near or (_bends(arms, i, dx, dz) and _bends(arms, j, dx, dz)):
                ticket += 1
                if _sees(walls, corners[i, 0], corners[i, 1], corners[j, 0], corners[j, 1], seen, ticket, found):
                    pairs.append((np.int64(i), np.int64(j)))
    first = np.zeros(count + 1, np.int64)
    for i, j in pairs:
        first[i + 1] += 1
        first[j + 1] += 1
    first = np.cumsum(first)
    at = first.copy()
    neighbour = np.empty(2 * len(pairs), np.int64)
    for i, j in pairs:
        neighbour[at[i]], neighbour[at[j]] = j, i
        at[i] += 1
        at[j] += 1
    return first, neighbour


@njit(cache=True)
def _search(walls, roadmap, x, z):
    """Dijkstra from a point: length to every corner, and the corner before it."""
    points = roadmap.points
    length, before = np.full(len(points), np.inf), np.full(len(points), -1, np.int64)
    seen, found = np.zeros(len(walls.ends), np.int64), np.empty(len(walls.ends), np.int64)
    heap = [(0.0, np.int64(0)) for _ in range(0)]
    for i in range(len(points)):
        if _sees(walls, x, z, points[i, 0], points[i, 1], seen, i + 1, found):
            length[i] = np.hypot(points[i, 0] - x, points[i, 1] - z)
            heapq.heappush(heap, (length[i], np.int64(i)))
    while len(heap):
        so_far, i = heapq.heappop(heap)
        if so_far > length[i]:
            continue
        for j in roadmap.neighbour[roadmap.first[i] : roadmap.first[i + 1]]:
            total = so_far + np.hypot(points[j, 0] - points[i, 0], points[j, 1] - points[i, 1])
            if total < length[j]:
                length[j], before[j] = total, i
                heapq.heappush(heap, (total, j))
    return length, before


@njit(cache=True)
def _reach(walls, points, at_corner, order, start, goals):
    """Length to every goal and the last corner before it, looking only at corners that could shorten the walk."""
    seen, found = np.zeros(len(walls.ends), np.int64), np.empty(len(walls.ends), np.int64)
    length, last = np.full(len(goals), np.inf), np.full(len(goals), -1, np.int64)
    ticket = 0
    for g in range(len(goals)):
        x, z = goals[g]
        ticket += 1
        if _sees(walls, start[0], start[1], x, z, seen, ticket, found):
            length[g] = np.hypot(x - start[0], z - start[1])
            continue
        for i in order:
            if at_corner[i] >= length[g]:
                break
            total = at_corner[i] + np.hypot(points[i, 0] - x, points[i, 1] - z)
            ticket += 1
            if total < length[g] and _sees(walls, points[i, 0], points[i, 1], x, z, seen, ticket, found):
                length[g], last[g] = total, i
    return length, last
