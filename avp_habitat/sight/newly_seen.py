"""What views see for the first time, or better than before, looked up in a scene's tables, for many agents at a time.

What all four places around an agent see is seen, what none of them sees is not; the pairs (agent, member) on which they
differ are returned, for a ray to decide.
"""

import numpy as np
from numpy.typing import NDArray

from avp_habitat.compiled import njit
from avp_habitat.sight.bits import ONE, Bits
from avp_habitat.sight.rules import Camera, Float, in_view, quality

_ROOM = 4096
"""For pairs, at first."""


def new_cells(
    visible: Bits,
    slots: NDArray[np.int32],
    pose: Float,
    centres: Float,
    camera: Camera,
    max_range: float,
    rows: NDArray[np.integer],
    steps: NDArray[np.integer],
    first_seen: NDArray[np.int16],
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Mark the cells that agents' views observe for the first time.

    Args:
        visible: `(slots, words)` bit sets of the tables.
        slots: `(k, 4)` places around each agent.
        pose: `(k, 4, 4)` camera_to_world, habitat axes.
        centres: `(m, 3)` floor points, metres.
        camera: `rules.camera_numbers`.
        max_range: metres.
        rows: `(k,)` each agent's row of `first_seen`.
        steps: `(k,)` what to write there.
        first_seen: `(n, >= m)` 0 for cells not seen yet; written for cells that all four places see.

    Returns:
        `(k,)` how many were written, and `(p, 2)` pairs (index of the agent, cell) on which the places differ.
    """
    found, room = np.zeros(len(slots), np.int64), _ROOM
    while True:
        pairs = np.empty((room, 2), np.int64)
        count = _new_cells(visible, slots, pose, centres, camera, max_range, rows, steps, first_seen, found, pairs)
        if count <= room:
            return found, pairs[:count]
        # Once more with enough room: what is sure is entered by now and not found again.
        room = count


@njit(cache=True)
def _new_cells(visible, slots, pose, centres, camera, max_range, rows, steps, first_seen, found, pairs):
    """The number of doubtful pairs; those beyond the room for them are counted, but not written."""
    count = 0
    for k in range(len(slots)):
        a, b, c, d = visible[slots[k, 0]], visible[slots[k, 1]], visible[slots[k, 2]], visible[slots[k, 3]]
        seen = first_seen[rows[k]]
        for word in range(visible.shape[1]):
            some = a[word] | b[word] | c[word] | d[word]
            every = a[word] & b[word] & c[word] & d[word]
            cell = 64 * word
            while some != 0:
                if some & ONE and seen[cell] == 0 and in_view(pose[k], centres[cell], camera, max_range):
                    if every & ONE:
                        seen[cell] = steps[k]
                        found[k] += 1
                    else:
                        if count < len(pairs):
                            pairs[count, 0], pairs[count, 1] = k, cell
                        count += 1
                some, every, cell = some >> ONE, every >> ONE, cell + 1
    return count


def new_surface(
    visible: Bits,
    slots: NDArray[np.int32],
    pose: Float,
    points: Float,
    normals: Float,
    camera: Camera,
    max_range: float,
    rows: NDArray[np.integer],
    best: NDArray[np.float32],
) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.float32]]:
    """Raise the qualities of the surface points that agents' views show better than before.

    Args:
        visible: `(slots, words)` bit sets of the tables.
        slots: `(k, 4)` places around each agent.
        pose: `(k, 4, 4)` camera_to_world, habitat axes.
        points: `(m, 3)` metres.
        normals: `(m, 3)` unit vectors.
        camera: `rules.camera_numbers`.
        max_range: metres.
        rows: `(k,)` each agent's row of `best`.
        best: `(n, m)` greatest quality so far; written for points that all four places see.

    Returns:
        `(k,)` by how much it grew in sum, `(p, 2)` pairs (index of the agent, point) on which the places differ, and
        `(p,)` the quality of those pairs' views.
    """
    grown, room = np.zeros(len(slots)), _ROOM
    while True:
        pairs, values = np.empty((room, 2), np.int64), np.empty(room, np.float32)
        known = visible, slots, pose, points, normals, camera, max_range, rows
        count = _new_surface(*known, best, grown, pairs, values)
        if count <= room:
            return grown, pairs[:count], values[:count]
        room = count


@njit(cache=True)
def _new_surface(visible, slots, pose, points, normals, camera, max_range, rows, best, grown, pairs, values):
    count = 0
    for k in range(len(slots)):
        a, b, c, d = visible[slots[k, 0]], visible[slots[k, 1]], visible[slots[k, 2]], visible[slots[k, 3]]
        known, eye = best[rows[k]], pose[k, :3, 3]
        for word in range(visible.shape[1]):
            some = a[word] | b[word] | c[word] | d[word]
            every = a[word] & b[word] & c[word] & d[word]
            point = 64 * word
            while some != 0:
                if some & ONE and known[point] < 1 and in_view(pose[k], points[point], camera, max_range):
                    value = np.float32(quality(eye, points[point], normals[point]))
                    if value > known[point]:
                        if every & ONE:
                            grown[k] += value - known[point]
                            known[point] = value
                        else:
                            if count < len(pairs):
                                pairs[count, 0], pairs[count, 1], values[count] = k, point, value
                            count += 1
                some, every, point = some >> ONE, every >> ONE, point + 1
    return count
