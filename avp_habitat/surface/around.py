"""What an agent knows of the surface around it: small maps from above, and how much of each direction is known.

Both are made of the points that its views have shown, turned to its heading; a scene's points that were not seen do not
change them.
"""

import numpy as np
from numpy.typing import NDArray

from avp_habitat.compiled import njit
from avp_habitat.sight.rules import quality, turned
from avp_habitat.surface.points import EDGE_M, SceneSurface

SIDE = 10
"""Map cells along a side; the agent stands in the middle, its heading points to row 0."""
CELL_M = 0.8
"""Side of a map cell in metres."""
CHANNELS = ("upright seen", "upright parallax", "level seen", "level parallax")
"""Walls and sides of furniture; floor, tops and ceiling. seen: number of points seen, in units of `FULL`, up to 1.
parallax: the mean of how well these were seen along two rays."""
FULL = 16.0
"""So many seen points in a map cell are shown as 1: about a wall along the cell, up to the camera."""
SECTORS = 36
"""Directions around the agent, to the right, the first one straight ahead; one is a turn."""
BANDS = ("below", "level", "above")
"""Elevations: below -15°, above 15°, and between."""
FULL_SOLID_ANGLE = 0.09
"""Steradians of a sector of a band, about: known surface that fills it is shown as 1."""
FULL_DEFICIT = 10.0
"""Points seen straight on but along one ray only: so many in a sector of a band are shown as 1."""
_SLOPE = np.tan(np.radians(15.0))
_UPRIGHT = np.sqrt(0.5)


def look_around(
    surface: SceneSurface,
    best: NDArray[np.float32],
    pair: NDArray[np.float32],
    rows: NDArray[np.integer],
    eye: NDArray[np.floating],
    yaw: NDArray[np.floating],
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """What k agents know.

    Args:
        surface: m points of their scene.
        best: `(n, m)` how well each was seen so far, 0 for never.
        pair: `(n, m)` how well along two rays.
        rows: `(k,)` the agents' rows of both.
        eye: `(k, 3)` their cameras, metres.
        yaw: `(k,)` radians.

    Returns:
        `(k, 4, SIDE, SIDE)` maps, `CHANNELS`, and `(k, 2, 3, SECTORS)` by `BANDS` and sector how much of the solid
        angle is known surface that faces the agent, and how much of that lacks a second ray; all within [0, 1].
    """
    maps = np.zeros((len(rows), len(CHANNELS), SIDE, SIDE), dtype=np.float32)
    polar = np.zeros((len(rows), 2, len(BANDS), SECTORS), dtype=np.float32)
    _look(surface.points, surface.normals, best, pair, rows, np.asarray(eye), np.asarray(yaw), maps, polar)
    maps[:, 1::2] /= np.maximum(maps[:, ::2], 1.0)
    maps[:, ::2] /= FULL
    polar[:, 0] *= EDGE_M**2 / FULL_SOLID_ANGLE
    polar[:, 1] /= FULL_DEFICIT
    return np.minimum(maps, 1.0), np.minimum(polar, 1.0)


@njit(cache=True)
def _look(points, normals, best, pair, rows, eye, yaw, maps, polar):
    side, sectors = maps.shape[3], polar.shape[3]
    for k in range(len(rows)):
        seen = best[rows[k]]
        sine, cosine = np.sin(yaw[k]), np.cos(yaw[k])
        for j in range(len(points)):
            if seen[j] > 0:
                x, y, z = points[j, 0] - eye[k, 0], points[j, 1] - eye[k, 1], points[j, 2] - eye[k, 2]
                ahead, right = turned(x, z, sine, cosine)
                row, column = int(np.floor(side / 2 - ahead / CELL_M)), int(np.floor(side / 2 + right / CELL_M))
                if 0 <= row < side and 0 <= column < side:
                    channel = 0 if abs(normals[j, 1]) < _UPRIGHT else 2
                    maps[k, channel, row, column] += 1
                    maps[k, channel + 1, row, column] += pair[rows[k], j]
                facing = -(x * normals[j, 0] + y * normals[j, 1] + z * normals[j, 2])
                if facing > 0:
                    flat = max(x * x + z * z, 1e-6)
                    square = flat + y * y
                    level = _SLOPE * np.sqrt(flat)
                    band = 0 if y < -level else (2 if y > level else 1)
                    sector = int(turn(ahead, right) * sectors + 0.5)
                    distance = np.sqrt(square)
                    value = quality(eye[k], points[j], normals[j])
                    # A point stands for its cube, which from near is wider than a sector.
                    wide = int(min(0.5 * EDGE_M / distance, 0.5) / (2 * np.pi / sectors) + 0.5)
                    known = facing / (distance * square) / (2 * wide + 1)
                    lacking = max(value - pair[rows[k], j], 0.0) / (2 * wide + 1)
                    for other in range(sector - wide, sector + wide + 1):
                        polar[k, 0, band, other % sectors] += known
                        polar[k, 1, band, other % sectors] += lacking


@njit(cache=True)
def turn(ahead, right):
    """Share of a turn to the right, within [0, 1), from ahead to a direction; within 0.02 degrees."""
    a, b = abs(ahead), abs(right)
    t = min(a, b) / max(a, b, 1e-12)
    # A polynomial for the arc tangent of [0, 1], of degree 7, in turns.
    angle = t * (0.159046 - t * t * (0.051294 - t * t * (0.023720 - t * t * 0.006504)))
    if b > a:
        angle = 0.25 - angle
    if ahead < 0:
        angle = 0.5 - angle
    return (1.0 - angle) % 1.0 if right < 0 else angle
