"""What a reconstruction of a scene should hold: the part of its surface that the task's camera can see."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from avp_habitat.errors import SimulatorError, UsageError
from avp_habitat.geometry.shape import Shape
from avp_habitat.poses import Intrinsics, wrap_angle
from avp_habitat.scenes.mesh import without_holes
from avp_habitat.sight.heldout import PLACES, heldout_poses, in_reach, lookouts, lookouts_needed
from avp_habitat.sight.tables import once_per_simulator
from avp_habitat.simulators.base import Meshed, Simulator
from avp_habitat.task.motion import sensor_poses
from avp_habitat.task.settings import TaskSettings

Float = NDArray[np.floating]

SAMPLES = 100_000
"""Points, uniform over the area of all the scene's surface, of which the observable ones are kept."""
CAMERA = Intrinsics.from_hfov(160, 120, hfov_deg=90.0)
"""Of the depth images of the held-out views."""
SCAN_VIEWS = 60
"""Depth images of a model that are fused."""
_GOLDEN_RAD = np.pi * (3 - 5**0.5)
_TOLERANCE_M, _PIECE_M = 0.005, 0.02


@dataclass(frozen=True)
class SceneTruth:
    """What is known of a scene, and compared with a reconstruction."""

    name: str
    """Of the scene."""
    max_range_m: float
    """As far as the camera sees."""
    whole: Shape
    """All its surface, also what nobody can see."""
    observable: Float
    """`(n, 3)` points, uniform over the area that can be seen, metres."""
    heldout: NDArray[np.float64]
    """`(views, 4, 4)` habitat poses of the held-out views."""
    depth: NDArray[np.float32]
    """`(views, height, width)` planar depth in metres that `CAMERA` has there, 0 where nothing is hit or far away."""


@once_per_simulator("sensor_height_m", "max_range_m", "pitch_limit_deg", "hfov_deg", "width", "height")
def scene_truth(
    simulator: Simulator, settings: TaskSettings, *, samples: int = SAMPLES, places: int = PLACES
) -> SceneTruth:
    """The truth about an open scene; found once, in two seconds for a room.

    Raises:
        SimulatorError: the simulator gives no mesh.
        SceneError: its mesh cannot be read, or no held-out view can be found.
        UsageError: the camera sees no surface at all.
    """
    if not isinstance(simulator, Meshed):
        raise SimulatorError(f"{simulator.scene}: the simulator {simulator.name} gives no mesh to compare with")
    mesh = without_holes(simulator.surface_mesh(), _PIECE_M)
    whole = Shape(mesh.vertices, mesh.triangles)
    points = whole.samples(samples)
    seen = observable(points, whole, lookouts(simulator, settings, places), settings)
    if not seen.any():
        raise UsageError(f"{simulator.scene}: no surface can be seen from its navigable area")
    poses = heldout_poses(simulator, sensor_height_m=settings.sensor_height_m)
    depth = whole.depth(poses, CAMERA)
    depth[depth > settings.max_range_m] = 0.0
    return SceneTruth(simulator.scene, settings.max_range_m, whole, points[seen], poses, depth)


def scan_poses(simulator: Simulator, settings: TaskSettings, views: int = SCAN_VIEWS) -> NDArray[np.float64]:
    """`(views, 4, 4)` habitat poses all over the navigable area, the same ones always, to render a model's depth from.

    Yaws turn by the golden angle from place to place; pitches are -30, 0 and 30 degrees in turn.
    """
    centres = simulator.area.centres
    feet = centres[np.linspace(0, len(centres) - 1, views).astype(int)]
    number = np.arange(views)
    yaw = np.asarray(wrap_angle(number * _GOLDEN_RAD), np.float64)
    return sensor_poses(settings, feet, yaw, np.radians(30.0) * (number % 3 - 1))


def observable(points: Float, whole: Shape, eyes: Float, settings: TaskSettings) -> NDArray[np.bool_]:
    """`(n,)` which of `(n, 3)` points of a shape a camera at `lookouts_needed` of `(k, 3)` eyes can see."""
    count, needed = np.zeros(len(points), np.int64), lookouts_needed(len(eyes))
    for eye in eyes:
        asked = np.flatnonzero(in_reach(points - eye, settings) & (count < needed))
        count[asked] += whole.reached(eye, points[asked], _TOLERANCE_M)
    return count >= needed
