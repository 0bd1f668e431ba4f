"""Small maps of what an agent has seen of the surface of a scene, and how well, around it and turned to its heading.

They are made of the surface points that its views have shown, and of nothing else: a scene's points that were not seen
do not change them.
"""

import numpy as np
from numpy.typing import NDArray

from avp_habitat.compiled import njit
from avp_habitat.sight.rules import turned
from avp_habitat.surface.points import SceneSurface

SIDE = 10
"""Map cells along a side; the agent stands in the middle, its heading points to row 0."""
CELL_M = 0.8
"""Side of a map cell in metres."""
GROUPS = ("up", "low", "high", "down")
"""Surfaces by what they face. up: floor, seats and tables. low, high: upright surfaces below and above the camera's
height. down: ceiling."""
CHANNELS = tuple(f"{group} {what}" for group in GROUPS for what in ("seen", "quality"))
"""seen: number of points seen, in units of `FULL`, up to 1. quality: the mean of how well they were seen."""
FULL = 16.0
"""So many seen points of a group in a map cell are shown as 1: about a wall along the cell, up to the camera."""
SIZE = len(CHANNELS) * SIDE * SIDE
_UPRIGHT = np.sqrt(0.5)


class SurfaceMapper:
    """Draws the maps of agents in one scene."""

    def __init__(self, surface: SceneSurface, sensor_height_m: float) -> None:
        """Sort the scene's points by what they face; the height is that of the camera above the feet, metres."""
        self._points = surface.points
        self._height_m = sensor_height_m
        upwards = surface.normals[:, 1]
        self._facing = np.where(upwards > _UPRIGHT, 1, np.where(upwards < -_UPRIGHT, -1, 0)).astype(np.int8)

    def observe(
        self,
        quality: NDArray[np.float32],
        rows: NDArray[np.integer],
        position: NDArray[np.floating],
        yaw: NDArray[np.floating],
    ) -> NDArray[np.float32]:
        """The maps of k agents.

        Args:
            quality: `(n, m)` how well each surface point was seen so far, 0 for never.
            rows: `(k,)` the agents' rows of it.
            position: `(k, 3)` their feet, metres.
            yaw: `(k,)` radians.

        Returns:
            `(k, SIZE)` within [0, 1], channel after channel, row after row from ahead to behind, left to right.
        """
        maps = np.zeros((len(rows), len(GROUPS), 2, SIDE, SIDE), dtype=np.float32)
        eye = np.asarray(position) + [0.0, self._height_m, 0.0]
        _draw(self._points, self._facing, quality, rows, eye, np.asarray(yaw), maps)
        maps[:, :, 1] /= np.maximum(maps[:, :, 0], 1.0)
        maps[:, :, 0] /= FULL
        return np.minimum(maps, 1.0).reshape(len(rows), SIZE)


@njit(cache=True)
def _draw(points, facing, quality, rows, eye, yaw, maps):
    """Count the surface points seen, and sum their qualities, by group and cell of `(k, 4, 2, side, side)` maps.

    The maps are zeros before. `facing` `(m,)` is 1 up, 0 sideways, -1 down; `eye` `(k, 3)` are the cameras, metres.
    """
    side = maps.shape[3]
    for k in range(len(rows)):
        seen = quality[rows[k]]
        sine, cosine = np.sin(yaw[k]) / CELL_M, np.cos(yaw[k]) / CELL_M
        for j in range(len(points)):
            if seen[j] > 0:
                x, z = points[j, 0] - eye[k, 0], points[j, 2] - eye[k, 2]
                ahead, right = turned(x, z, sine, cosine)
                row, column = int(np.floor(side / 2 - ahead)), int(np.floor(side / 2 + right))
                if 0 <= row < side and 0 <= column < side:
                    group = _group(facing[j], points[j, 1] - eye[k, 1])
                    maps[k, group, 0, row, column] += 1
                    maps[k, group, 1, row, column] += seen[j]


@njit(cache=True)
def _group(facing, height):
    """Number of `GROUPS` for a point at a height from the camera."""
    if facing > 0:
        return 0
    if facing < 0:
        return 3
    return 1 if height < 0 else 2
