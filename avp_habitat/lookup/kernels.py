"""Looking views up in a scene's tables, compiled, for many agents at a time."""

import numpy as np
from numba import njit


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
        p0 = min(max(int(np.floor(pitch[k])), 0), pitches - 2) if pitches > 1 else 0
        wy, wp = yaw[k] - y0, pitch[k] - p0
        low, average = 0.0, 0.0
        for corner in range(4):
            for turn in range(2):
                for tilt in range(2):
                    share = weights[k, corner] * (wy if turn else 1 - wy) * (wp if tilt else 1 - wp)
                    if share != 0:
                        entry = statistics[slots[k, corner], (y0 + turn) % yaws, p0 + tilt]
                        low += share * entry[0]
                        average += share * entry[1]
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
    width, height, fx, fy, cx, cy = camera
    for k in range(len(slots)):
        a, b, c, d = visible[slots[k, 0]], visible[slots[k, 1]], visible[slots[k, 2]], visible[slots[k, 3]]
        seen = first_seen[rows[k]]
        turned = pose[k]
        x0, y0, z0 = turned[0, 3], turned[1, 3], turned[2, 3]
        count = 0
        for word in range(visible.shape[1]):
            some = a[word] | b[word] | c[word] | d[word]
            if some == 0:
                continue
            every = a[word] & b[word] & c[word] & d[word]
            for bit in range(64):
                mark = np.uint64(1) << np.uint64(bit)
                if some & mark == 0:
                    continue
                cell = word * 64 + bit
                if seen[cell] != 0:
                    continue
                x, y, z = centres[cell, 0] - x0, centres[cell, 1] - y0, centres[cell, 2] - z0
                depth = -(turned[0, 2] * x + turned[1, 2] * y + turned[2, 2] * z)
                if depth <= 0 or x * x + y * y + z * z > max_range * max_range:
                    continue
                depth = max(depth, 1e-9)
                u = fx * (turned[0, 0] * x + turned[1, 0] * y + turned[2, 0] * z) / depth + cx
                v = -fy * (turned[0, 1] * x + turned[1, 1] * y + turned[2, 1] * z) / depth + cy
                if u < 0 or v < 0 or u >= width or v >= height:
                    continue
                if every & mark != 0:
                    seen[cell] = steps[k]
                    count += 1
                else:
                    if doubts < len(doubtful):
                        doubtful[doubts, 0], doubtful[doubts, 1] = k, cell
                    doubts += 1
        found[k] = count
    return doubts
