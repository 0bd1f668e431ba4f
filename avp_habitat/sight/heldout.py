"""The held-out views of a scene: poses, the same ones always, from whose pictures nothing is ever reconstructed."""

import numpy as np
from numpy.typing import NDArray

from avp_habitat import poses
from avp_habitat.errors import SceneError
from avp_habitat.poses import Intrinsics
from avp_habitat.simulators.base import Simulator

VIEWS = 20
"""Held-out views of a rollout."""
PITCH_DEG = 20.0
"""Their greatest pitch, either way."""
MIN_MEAN_DEPTH_M = 1.0
"""A view that sees no farther on average has its nose on a wall."""

_TRIES = 2000


def heldout_seed(scene_digest: str) -> int:
    """The fixed seed of a scene's held-out views, from the digest of its content."""
    return int(scene_digest[:16], 16)


def heldout_poses(simulator: Simulator, *, sensor_height_m: float, views: int = VIEWS) -> NDArray[np.float64]:
    """Poses uniform over the navigable area, any yaw, pitch within ±20°, that see at least 1 m far on average.

    Returns:
        `(views, 4, 4)` habitat camera_to_world; the same for the same scene, always.

    Raises:
        SceneError: the scene is too narrow for such views.
    """
    rng = np.random.default_rng(heldout_seed(simulator.scene_digest))
    camera = Intrinsics.from_hfov(32, 24, hfov_deg=90.0)
    found: list[NDArray[np.float64]] = []
    for _ in range(_TRIES):
        position = simulator.area.random_points(rng, 1) + np.array([0.0, sensor_height_m, 0.0])
        yaw, pitch = rng.uniform(-np.pi, np.pi, 1), np.radians(rng.uniform(-PITCH_DEG, PITCH_DEG, 1))
        pose = poses.camera_to_world(position, yaw=yaw, pitch=pitch)
        if simulator.render(pose, camera, rgb=False).depth.mean() >= MIN_MEAN_DEPTH_M:
            found.append(pose[0])
        if len(found) == views:
            return np.stack(found)
    raise SceneError(
        f"{simulator.scene}: found only {len(found)} of {views} held-out views that see at least "
        f"{MIN_MEAN_DEPTH_M} m far on average; is the scene in metres?"
    )
