"""Frames' points held against surfaces, with Open3D: their distance to the mesh, and point-to-plane ICP."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from avp_habitat.scenes.loader import Scene
from avp_nerfstudio.check import Verdict
from avp_nerfstudio.check.agreement import TOLERANCE_M, Cameras
from avp_nerfstudio.check.depth_maps import DepthMaps

Float = NDArray[np.floating]

POINTS = 300
"""Points of each frame, at most."""
NEAR_SHARE = 0.995
"""Least share of all points within 2 cm of the mesh; of ten correct rollouts in two rooms every point was."""
NEAR_SHARE_OF_FRAME = 0.98
"""The same for each single frame."""


def mesh_distance(
    maps: DepthMaps, cameras: Cameras, scene: Scene, *, named: str | None
) -> tuple[Verdict, NDArray[np.bool_]]:
    """Measure the distance of every frame's points to a mesh.

    Args:
        maps: the depth.
        cameras: poses and intrinsics.
        scene: the mesh.
        named: digest of the scene that `rollout.json` names, None where it names none.

    Returns:
        Whether they are on it, and `(n,)` frames whose points are not.
    """
    distances = _distances(maps, cameras, scene)
    near = (distances <= TOLERANCE_M).sum(axis=1)
    counts = np.minimum(maps.counts, POINTS)
    # The points of a frame are repeated where it has few; a frame without any is not judged.
    share = np.where(counts > 0, near / distances.shape[1], np.nan)
    bad = share < NEAR_SHARE_OF_FRAME
    judged = distances[counts > 0]
    overall = mean = p95 = float("nan")
    if judged.size:
        overall, mean, p95 = (judged <= TOLERANCE_M).mean(), judged.mean(), np.percentile(judged, 95)
    passed = not (overall < NEAR_SHARE or bad.any())
    text = (
        f"{100 * overall:.2f} % of {judged.size} points lie within 2 cm of {scene.name} (limit {100 * NEAR_SHARE} %); "
        f"{bad.sum()} of {len(bad)} frames have less than {100 * NEAR_SHARE_OF_FRAME:.0f} %"
    )
    cause = None
    if named not in (None, scene.digest):
        text += "; the file is not the one that rollout.json names (another sha256)"
        cause = f"{scene.name} is not the scene in which the rollout was captured"
    figures = {
        "near_2cm_percent": 100 * float(overall),
        "mean_mm": 1000 * float(mean),
        "p95_mm": 1000 * float(p95),
        "far_frames": float(bad.sum()),
    }
    return Verdict("mesh distance", passed, text, figures, None if passed else cause), bad


def _distances(maps: DepthMaps, cameras: Cameras, scene: Scene) -> NDArray[np.float32]:
    """`(n, POINTS)` metres."""
    import open3d as o3d

    casting = o3d.t.geometry.RaycastingScene()
    casting.add_triangles(
        o3d.core.Tensor.from_numpy(np.ascontiguousarray(scene.mesh.vertices, np.float32)),
        o3d.core.Tensor.from_numpy(np.ascontiguousarray(scene.mesh.triangles, np.uint32)),
    )
    local = maps.local_points(cameras.intrinsics, np.arange(len(maps)), POINTS)
    world = local @ np.swapaxes(cameras.poses[:, :3, :3], 1, 2) + cameras.poses[:, None, :3, 3]
    return casting.compute_distance(o3d.core.Tensor.from_numpy(world.astype(np.float32))).numpy()


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
    """Register one frame to partners that are believed; None when these see too little of it.

    `far` says that the frame may be off by centimetres; else only a few are looked for, which no corner can mislead.
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
    turn = Rotation.from_matrix(motion[:3, :3]).as_rotvec()
    twist = np.concatenate([turn * radius, motion[:3, 3]])
    twist = fixed @ (fixed.T @ twist)
    rotation = Rotation.from_rotvec(twist[:3] / radius).as_matrix()
    corrected = pose.copy()
    corrected[:3, :3] = rotation @ pose[:3, :3]
    corrected[:3, 3] = pose[:3, 3] + twist[3:]
    angle = float(np.degrees(np.linalg.norm(twist[:3] / radius)))
    return Correction(twist[3:], angle, corrected, fixed.shape[1])
