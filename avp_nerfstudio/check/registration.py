"""Where a frame would rather be, judged by the depth of other frames: point-to-plane ICP with Open3D."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from avp_nerfstudio.check.depth_maps import DepthMaps
from avp_nerfstudio.check.hypotheses import Cameras

Float = NDArray[np.floating]

PARTNERS = 8
"""Frames that a frame is registered to."""
_SOURCE_POINTS = 1000
_REACH_M, _CLOSE_M = 0.12, 0.03
_LEAST_MATCHES = 100
_LEAST_STIFFNESS = 0.005


@dataclass(frozen=True)
class Correction:
    """What ICP would still move a camera by; only along directions that the surfaces seen fix."""

    shift_m: Float
    """`(3,)` of the camera's centre, world frame."""
    rotation_deg: float
    """Angle of the rotation."""
    camera_to_world: Float
    """`(4, 4)` the corrected pose."""
    fixed_directions: int
    """How many of the six degrees of freedom the surfaces fix."""

    @property
    def distance_m(self) -> float:
        """Length of the shift."""
        return float(np.linalg.norm(self.shift_m))


def register(
    maps: DepthMaps, cameras: Cameras, frame: int, partners: NDArray[np.int64], *, far: bool
) -> Correction | None:
    """Register one frame to others that are believed.

    Args:
        maps: the depth.
        cameras: poses and intrinsics.
        frame: which to register.
        partners: the others.
        far: whether the frame may be off by centimetres; else only a few are looked for, which no corner can mislead.

    Returns:
        The correction, or None when too little of the frame is seen by the others.
    """
    import open3d as o3d

    icp = o3d.pipelines.registration
    pose = cameras.poses[frame]
    points, normals = maps.surface(frame, pose, cameras.intrinsics, _SOURCE_POINTS)
    parts = [maps.surface(int(p), cameras.poses[p], cameras.intrinsics) for p in partners]
    if not len(points) or not sum(len(part[0]) for part in parts):
        return None
    # About the camera: rotations and shifts of it then hardly mix.
    source, target = o3d.geometry.PointCloud(), o3d.geometry.PointCloud()
    source.points = o3d.utility.Vector3dVector(points - pose[:3, 3])
    target.points = o3d.utility.Vector3dVector(np.concatenate([part[0] for part in parts]) - pose[:3, 3])
    target.normals = o3d.utility.Vector3dVector(np.concatenate([part[1] for part in parts]))
    motion = np.eye(4)
    # First whatever is near, then only what is close: wrong matches and wrong partners lose their weight.
    rounds = [(_REACH_M, icp.L2Loss())] * far + [(_CLOSE_M, icp.TukeyLoss(_CLOSE_M / 2))]
    matches = np.empty((0, 2), int)
    for reach, loss in rounds:
        found = icp.registration_icp(
            source,
            target,
            reach,
            motion,
            icp.TransformationEstimationPointToPlane(loss),
            icp.ICPConvergenceCriteria(1e-7, 1e-7, 40),
        )
        matches = np.asarray(found.correspondence_set)
        if len(matches) < _LEAST_MATCHES:
            return None
        motion = np.asarray(found.transformation)
    matched = matches[:, 0]
    return _fixed_part(pose, motion, points[matched] - pose[:3, 3], normals[matched])


def _fixed_part(pose: Float, motion: Float, points: Float, normals: Float) -> Correction:
    """The part of a small motion that surfaces fix: a wall alone does not say how far along it a camera stands."""
    radius = float(np.sqrt((points**2).sum(axis=1).mean()))
    rows = np.concatenate([np.cross(points, normals) / radius, normals], axis=1)
    stiffness, directions = np.linalg.eigh(rows.T @ rows / len(rows))
    fixed = directions[:, stiffness > _LEAST_STIFFNESS]
    turn = rotation_vector(motion[:3, :3])
    twist = np.concatenate([turn * radius, motion[:3, 3]])
    twist = fixed @ (fixed.T @ twist)
    rotation = rotation_matrix(twist[:3] / radius)
    corrected = pose.copy()
    corrected[:3, :3] = rotation @ pose[:3, :3]
    corrected[:3, 3] = pose[:3, 3] + twist[3:]
    angle = float(np.degrees(np.linalg.norm(twist[:3] / radius)))
    return Correction(twist[3:], angle, corrected, fixed.shape[1])


def rotation_vector(rotation: Float) -> Float:
    """Axis times angle in radians, `(3,)`, of a `(3, 3)` rotation by less than half a turn."""
    axis = np.array([rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]])
    sine = float(np.linalg.norm(axis)) / 2
    angle = float(np.arctan2(sine, (np.trace(rotation) - 1) / 2))
    return axis / 2 if sine < 1e-12 else axis / (2 * sine) * angle


def rotation_matrix(vector: Float) -> Float:
    """The `(3, 3)` rotation of axis times angle in radians (Rodrigues' formula)."""
    angle = float(np.linalg.norm(vector))
    if angle < 1e-12:
        return np.eye(3)
    x, y, z = vector / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
