"""Points all over what can be seen in a scene: walls, furniture, ceiling."""

import numpy as np
from numpy.typing import NDArray

from avp_habitat.motion import sensor_poses
from avp_habitat.poses import Intrinsics, unproject
from avp_habitat.settings import TaskSettings
from avp_habitat.simulators.base import Simulator

SPACING_M = 0.4
"""One point for each cube of this edge that holds some surface, metres."""
SURFACE_RANGE_M = 4.0
"""A surface counts as seen from this near, metres: from farther off its texture is too coarse to reconstruct."""
_PLACES = 60
_YAWS_DEG = (0.0, 90.0, 180.0, 270.0)
_PITCHES_DEG = (-45.0, 0.0, 45.0)
_CAMERA = Intrinsics.from_hfov(96, 72, hfov_deg=100.0)
_FLOOR_M = 0.05
"""Surfaces this close above or below the walkable floor are the floor, which has points of its own."""


def surface_points(simulator: Simulator, settings: TaskSettings) -> NDArray[np.float64]:
    """`(k, 3)` points on the surfaces seen from all over the floor, without the floor itself, metres.

    Args:
        simulator: of the scene.
        settings: of the task: sensor height and range.
    """
    centres = simulator.area.centres
    places = centres[np.unique(np.linspace(0, len(centres) - 1, min(len(centres), _PLACES)).astype(int))]
    yaw, pitch = (np.radians(grid.ravel()) for grid in np.meshgrid(_YAWS_DEG, _PITCHES_DEG))
    seen = []
    for place in places:
        pose = sensor_poses(settings, np.repeat(place[None], len(yaw), axis=0), yaw, pitch)
        depth = simulator.render(pose, _CAMERA, rgb=False).depth
        for k in range(len(pose)):
            points = unproject(depth[k], pose[k], _CAMERA)[(depth[k] > 0) & (depth[k] <= settings.max_range_m)]
            seen.append(_thinned(points[np.abs(points[:, 1] - place[1]) > _FLOOR_M]))
    return np.asarray(_thinned(np.concatenate(seen)), dtype=np.float64)


def _thinned(points: NDArray[np.floating]) -> NDArray[np.floating]:
    """The first of `(n, 3)` points in every cube."""
    _, first = np.unique(np.floor(points / SPACING_M).astype(np.int64), axis=0, return_index=True)
    return points[np.sort(first)]
