"""Looking views up in a scene's tables, compiled, for many agents at a time."""

import numpy as np

from avp_habitat.compiled import njit

ONE = np.uint64(1)


@njit(cache=True)
def depth_statistics(statistics, slots, weights, yaw, pitch, least, mean):
    """Interpolate the depth statistics between places, yaws and pitches.

    Args:
        statistics: `(slots, yaws, pitches, 2)` of the tables.
        slots: `(k, 4)` places around each agent.
        weights: `(k, 4)` of those places.
        yaw: `(k,)` in steps of the table, from 0.
        pitch: `(k,)` in steps of the table from its lowest pitch.
        least: `(k,)` output, share of the range.
        mean: `(k,)` output, share of the range.
    """
    yaws, pitches = statistics.shape[1:3]
    for k in range(len(slots)):
        y0 = int(np.floor(yaw[k]))
        # The last pitch lies on the table's border: the entry beyond it has no weight and is not read.
        p0 = min(max(int(np.floor(pitch[k])), 0), max(pitches - 2, 0))
        wy, wp = yaw[k] - y0, pitch[k] - p0
        low, average = 0.0, 0.0
        for entry in range(16):
            corner, turn, tilt = entry // 4, entry // 2 % 2, entry % 2
            share = weights[k, corner] * (wy if turn else 1 - wy) * (wp if tilt else 1 - wp)
            if share != 0:
                at = statistics[slots[k, corner], (y0 + turn) % yaws, p0 + tilt]
                low += share * at[0]
                average += share * at[1]
        least[k], mean[k] = low / 65535, average / 65535


@njit(cache=True)
def new_cells(visible, slots, pose, centres, camera, max_range, rows, steps, first_seen, found, doubtful):
    """Mark the cells that agents' views observe for the first time.

    Args:
        visible: `(slots, words)` of the tables.
        slots: `(k, 4)` places around each agent.
        pose: `(k, 4, 4)` camera_to_world, habitat axes.
        centres: `(m, 3)` floor points, metres.
        camera: `(6,)` width, height, fx, fy, cx, cy in pixels.
        max_range: metres.
        rows: `(k,)` each agent's row of `first_seen`.
        steps: `(k,)` what to write there.
        first_seen: `(n, >= m)` 0 for cells not seen yet; written for cells that all four places see.
        found: `(k,)` output, how many were written.
        doubtful: `(c, 2)` output, pairs (index of the agent, cell) on which the places differ.

    Returns:
        How many pairs are doubtful; beyond c they are counted but not written.
    """
    doubts = 0
    for k in range(len(slots)):
        a, b, c, d = visible[slots[k, 0]], visible[slots[k, 1]], visible[slots[k, 2]], visible[slots[k, 3]]
        seen = first_seen[rows[k]]
        count = 0
        for word in range(visible.shape[1]):
            some = a[word] | b[word] | c[word] | d[word]
            every = a[word] & b[word] & c[word] & d[word]
            cell = 64 * word
            while some != 0:
                if some & ONE and seen[cell] == 0 and _in_view(pose[k], centres[cell], camera, max_range):
                    if every & ONE:
                        seen[cell] = steps[k]
                        count += 1
                    else:
                        if doubts < len(doubtful):
                            doubtful[doubts, 0], doubtful[doubts, 1] = k, cell
                        doubts += 1
                some, every, cell = some >> ONE, every >> ONE, cell + 1
        found[k] = count
    return doubts


@njit(cache=True)
def new_surface(
    visible, slots, pose, points, normals, camera, max_range, full_distance, rows, quality, gain, doubtful, doubtful_q
):
    """Raise the qualities of the surface points that agents' views show better than before.

    Args:
        visible: `(slots, words)` of the tables.
        slots: `(k, 4)` places around each agent.
        pose: `(k, 4, 4)` camera_to_world, habitat axes.
        points: `(m, 3)` metres.
        normals: `(m, 3)` unit vectors.
        camera: `(6,)` width, height, fx, fy, cx, cy in pixels.
        max_range: metres.
        full_distance: d₀ of `surfaces.view_quality`, metres.
        rows: `(k,)` each agent's row of `quality`.
        quality: `(n, m)` best so far; written for points that all four places see.
        gain: `(k,)` output, by how much it grew.
        doubtful: `(c, 2)` output, pairs (index of the agent, point) on which the places differ.
        doubtful_q: `(c,)` output, the quality of those pairs' views.

    Returns:
        How many pairs are doubtful; beyond c they are counted but not written.
    """
    doubts = 0
    for k in range(len(slots)):
        a, b, c, d = visible[slots[k, 0]], visible[slots[k, 1]], visible[slots[k, 2]], visible[slots[k, 3]]
        best = quality[rows[k]]
        total = 0.0
        for word in range(visible.shape[1]):
            some = a[word] | b[word] | c[word] | d[word]
            every = a[word] & b[word] & c[word] & d[word]
            point = 64 * word
            while some != 0:
                if some & ONE and best[point] < 1 and _in_view(pose[k], points[point], camera, max_range):
                    value = np.float32(_view_quality(pose[k], points[point], normals[point], full_distance))
                    if value > best[point]:
                        if every & ONE:
                            total += value - best[point]
                            best[point] = value
                        else:
                            if doubts < len(doubtful):
                                doubtful[doubts, 0], doubtful[doubts, 1] = k, point
                                doubtful_q[doubts] = value
                            doubts += 1
                some, every, point = some >> ONE, every >> ONE, point + 1
        gain[k] = total
    return doubts


@njit(cache=True)
def _view_quality(pose, point, normal, full_distance):
    """The rule of `surfaces.view_quality`."""
    x, y, z = pose[0, 3] - point[0], pose[1, 3] - point[1], pose[2, 3] - point[2]
    distance = max(np.sqrt(x * x + y * y + z * z), 1e-9)
    cosine = (x * normal[0] + y * normal[1] + z * normal[2]) / distance
    return min(max(cosine, 0.0), 1.0) * min(1.0, full_distance / distance)


@njit(cache=True)
def _in_view(pose, point, camera, max_range):
    """Whether a point lies inside the image and within range; the rule of `coverage.candidates`."""
    width, height, fx, fy, cx, cy = camera
    x, y, z = point[0] - pose[0, 3], point[1] - pose[1, 3], point[2] - pose[2, 3]
    depth = -(pose[0, 2] * x + pose[1, 2] * y + pose[2, 2] * z)
    if depth <= 0 or x * x + y * y + z * z > max_range * max_range:
        return False
    depth = max(depth, 1e-9)
    u = fx * (pose[0, 0] * x + pose[1, 0] * y + pose[2, 0] * z) / depth + cx
    v = -fy * (pose[0, 1] * x + pose[1, 1] * y + pose[2, 1] * z) / depth + cy
    return 0 <= u < width and 0 <= v < height
