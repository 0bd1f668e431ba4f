"""What views see for the first time, or better than before, looked up in a scene's tables, for many agents at a time.

What all four places around an agent see is seen, what none of them sees is not; the pairs (agent, member) on which they
differ are returned, for a ray to decide. There is always room for an agent's pairs before it is its turn: growing the
arrays in the innermost loop would cost half as much again.
"""

import numpy as np

from avp_habitat.compiled import njit
from avp_habitat.sight.bits import ONE
from avp_habitat.sight.rules import in_view, quality


@njit(cache=True)
def new_cells(visible, slots, pose, centres, camera, max_range, rows, steps, first_seen):
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
    found, pairs, count = np.zeros(len(slots), np.int64), np.empty((len(centres), 2), np.int64), 0
    for k in range(len(slots)):
        if count + len(centres) > len(pairs):
            pairs = np.concatenate((pairs, np.empty_like(pairs)))
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
                        pairs[count, 0], pairs[count, 1] = k, cell
                        count += 1
                some, every, cell = some >> ONE, every >> ONE, cell + 1
    return found, pairs[:count]


@njit(cache=True)
def new_surface(visible, slots, pose, points, normals, camera, max_range, rows, best):
    """Raise the qualities of the surface points that agents' views show better than before.

    Args as of `new_cells`, but for the points' `(m, 3)` unit `normals` and `best`, `(n, m)` greatest quality so far; it
    is written for points that all four places see.

    Returns:
        `(k,)` by how much it grew in sum, `(p, 2)` pairs (index of the agent, point) on which the places differ, and
        `(p,)` the quality of those pairs' views.
    """
    grown, count = np.zeros(len(slots)), 0
    pairs, values = np.empty((len(points), 2), np.int64), np.empty(len(points), np.float32)
    for k in range(len(slots)):
        if count + len(points) > len(pairs):
            pairs = np.concatenate((pairs, np.empty_like(pairs)))
            values = np.concatenate((values, np.empty_like(values)))
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
                            pairs[count, 0], pairs[count, 1], values[count] = k, point, value
                            count += 1
                some, every, point = some >> ONE, every >> ONE, point + 1
    return grown, pairs[:count], values[:count]
