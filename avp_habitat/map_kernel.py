"""The compiled drawing of map observations."""

import numpy as np

from avp_habitat.compiled import njit

OBSERVED, FRONTIER, RIM = range(3)


@njit(cache=True)
def draw(index, first_seen, rows, place, yaw, scale, maps):
    """Count floor cells by channel and map cell.

    Args:
        index: `(rows + 2, columns + 2)` number of each navigable cell, -1 elsewhere, with a border of -1.
        first_seen: `(n, >= m)` 0 for cells not observed.
        rows: `(k,)` the agents' rows of it.
        place: `(k, 2)` x and z of the agents in floor cells from the grid's corner.
        yaw: `(k,)` radians.
        scale: floor cells along a map cell's side.
        maps: `(k, 3, side, side)` output, zeros before.
    """
    for k in range(len(rows)):
        seen = first_seen[rows[k]]
        ahead_x, ahead_z = -np.sin(yaw[k]) / scale, -np.cos(yaw[k]) / scale
        for i in range(1, index.shape[0] - 1):
            for j in range(1, index.shape[1] - 1):
                if index[i, j] >= 0 and seen[index[i, j]] != 0:
                    x, z = j - 0.5 - place[k, 0], i - 0.5 - place[k, 1]
                    ahead, right = x * ahead_x + z * ahead_z, z * ahead_x - x * ahead_z
                    _enter(maps[k], ahead, right, *_edges(index, seen, i, j))


@njit(cache=True)
def _edges(index, seen, i, j):
    """Whether an observed cell lies beside floor not yet observed, and beside what is not navigable."""
    frontier, rim = False, False
    for di, dj in ((0, 1), (1, 0), (0, -1), (-1, 0)):
        other = index[i + di, j + dj]
        if other < 0:
            rim = True
        elif seen[other] == 0:
            frontier = True
    return frontier, rim


@njit(cache=True)
def _enter(channels, ahead, right, frontier, rim):
    """Count an observed cell at a place in map cells from the agent; frontiers beyond the map on its border."""
    side = channels.shape[1]
    row, column = int(np.floor(side / 2 - ahead)), int(np.floor(side / 2 + right))
    if 0 <= row < side and 0 <= column < side:
        channels[OBSERVED, row, column] += 1
        channels[RIM, row, column] += rim
    if frontier:
        channels[FRONTIER, min(max(row, 0), side - 1), min(max(column, 0), side - 1)] += 1


@njit(cache=True)
def draw_surface(points, facing, quality, rows, eye, yaw, cell_m, maps):
    """Count the surface points seen, and sum their qualities, by group and map cell.

    Args:
        points: `(m, 3)` metres.
        facing: `(m,)` 1 up, 0 sideways, -1 down.
        quality: `(n, m)` how well each was seen, 0 for never.
        rows: `(k,)` the agents' rows of it.
        eye: `(k, 3)` the agents' cameras, metres.
        yaw: `(k,)` radians.
        cell_m: side of a map cell, metres.
        maps: `(k, 4, 2, side, side)` output, zeros before.
    """
    side = maps.shape[3]
    for k in range(len(rows)):
        seen = quality[rows[k]]
        ahead_x, ahead_z = -np.sin(yaw[k]) / cell_m, -np.cos(yaw[k]) / cell_m
        for j in range(len(points)):
            if seen[j] > 0:
                x, z = points[j, 0] - eye[k, 0], points[j, 2] - eye[k, 2]
                ahead, right = x * ahead_x + z * ahead_z, z * ahead_x - x * ahead_z
                row, column = int(np.floor(side / 2 - ahead)), int(np.floor(side / 2 + right))
                if 0 <= row < side and 0 <= column < side:
                    group = _group(facing[j], points[j, 1] - eye[k, 1])
                    maps[k, group, 0, row, column] += 1
                    maps[k, group, 1, row, column] += seen[j]


@njit(cache=True)
def _group(facing, height):
    """Number of `surface_map.GROUPS` for a point at a height from the camera."""
    if facing > 0:
        return 0
    if facing < 0:
        return 3
    return 1 if height < 0 else 2
