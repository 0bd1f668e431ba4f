"""What views see for the first time, or better than before, looked up in a scene's tables, for many agents at a time.

What all four places around an agent see is seen, what none of them sees is not; the pairs (agent, member) on which they
differ are returned, for a ray to decide. There is always room for an agent's pairs before it is its turn: growing the
arrays in the innermost loop would cost half as much again.
"""

import numpy as np

from avp_habitat.compiled import njit
from avp_habitat.sight.bits import ONE, lowest
from avp_habitat.sight.rules import in_view, parallax_square, quality


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
def new_surface(visible, slots, pose, points, normals, shown, camera, max_range, rows, best, pairing, number, asked):
    """Raise the qualities of the surface points that agents' views show better than before, or from elsewhere.

    Args as of `new_cells`, but for the points' `(m, 3)` unit `normals`, and those of `raise_point`: `shown`, the arrays
    `best` and `pairing`, written for points that all four places see, and `(k,)` the `number` of each agent's eye.
    `asked` is `(n, m)` the number of the eye for which each point was returned last; it is not for the same eye again.

    Returns:
        `(k, 4)` by how much Q, S, a·Q and a·S grew in sum, `(p, 2)` pairs (index of the agent, point) on which the
        places differ, and `(p,)` the quality of those pairs' views.
    """
    grown, count = np.zeros((len(slots), 4)), 0
    pairs, values = np.empty((len(points), 2), np.int64), np.empty(len(points), np.float32)
    for k in range(len(slots)):
        if count + len(points) > len(pairs):
            pairs = np.concatenate((pairs, np.empty_like(pairs)))
            values = np.concatenate((values, np.empty_like(values)))
        a, b, c, d = visible[slots[k, 0]], visible[slots[k, 1]], visible[slots[k, 2]], visible[slots[k, 3]]
        eye, row = pose[k, :3, 3], rows[k]
        for word in range(visible.shape[1]):
            some = a[word] | b[word] | c[word] | d[word]
            every = a[word] & b[word] & c[word] & d[word]
            point = 64 * word
            while some != 0:
                if some & ONE and in_view(pose[k], points[point], camera, max_range):
                    value = np.float32(quality(eye, points[point], normals[point]))
                    if may_grow(row, point, value, number[k], best, pairing, asked):
                        if every & ONE:
                            raise_point(row, point, value, number[k], points, normals, shown, best, pairing, grown[k])
                        else:
                            pairs[count, 0], pairs[count, 1], values[count] = k, point, value
                            count += 1
                            asked[row, point] = number[k]
                some, every, point = some >> ONE, every >> ONE, point + 1
    return grown, pairs[:count], values[:count]


@njit(cache=True)
def raise_points(rows, pairs, values, number, points, normals, shown, best, pairing, grown):
    """`raise_point` for `(p, 2)` pairs (index of the agent, point) with qualities `values` `(p,)`."""
    for i in range(len(pairs)):
        k = pairs[i, 0]
        raise_point(rows[k], pairs[i, 1], values[i], number[k], points, normals, shown, best, pairing, grown[k])


@njit(cache=True)
def may_grow(row, point, value, number, best, pairing, asked):
    """Whether a view of this quality could raise Q or S of a point, or help a later one to; see `raise_point`.

    The same eye sees a point equally well each time; no pair with a view is better than the root of its quality, for no
    quality is above 1. Nor has it where this eye was `asked` for the point before.
    """
    pair, seen_from, _ = pairing
    if asked[row, point] == number:
        return False
    if seen_from.shape[2] == 0:
        return value > best[row, point]
    if (seen_from[row, point, number // 64] >> np.uint64(number % 64)) & ONE:
        return False
    return value > best[row, point] or value > pair[row, point] * pair[row, point]


@njit(cache=True)
def raise_point(row, point, value, number, points, normals, shown, best, pairing, grown):
    """Enter that an agent's eye sees a point.

    Args:
        row: of the agent in `best` and `pairing`.
        point: which one.
        value: quality of the view, as single precision.
        number: of the eye, which stands in `eyes`.
        points: `(m, 3)` metres.
        normals: `(m, 3)` unit vectors.
        shown: `(m,)` a, how much of the pictures each point fills.
        best: `(n, m)` Q, greatest quality so far.
        pairing: `(n, m)` S, the greatest parallax quality so far; `(n, m, words)` bit sets of the eyes that saw the
            point and could matter; `(n, most, 3)` eyes, metres. Without words, S is not computed.
        grown: `(4,)` to which the growths of Q, S, a·Q and a·S are added.
    """
    if value > best[row, point]:
        more = value - best[row, point]
        grown[0] += more
        grown[2] += shown[point] * more
        best[row, point] = value
    pair, seen_from, eyes = pairing
    if seen_from.shape[2] == 0:
        return
    before = pair[row, point]
    square = np.float64(before * before)
    for word in range(seen_from.shape[2]):
        bits = seen_from[row, point, word]
        while bits != 0:
            other = eyes[row, 64 * word + lowest(bits)]
            bits &= bits - ONE
            product = value * quality(other, points[point], normals[point])
            if product > square:
                square = max(square, product * parallax_square(eyes[row, number], other, points[point]))
    seen_from[row, point, number // 64] |= ONE << np.uint64(number % 64)
    after = np.float32(np.sqrt(square))
    if after > before:
        grown[1] += after - before
        grown[3] += shown[point] * (after - before)
        pair[row, point] = after
