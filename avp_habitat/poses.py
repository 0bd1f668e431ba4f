"""Axes, camera poses and pinhole projection: the only module that flips a sign, but for `sight.rules.in_camera`.

World: right-handed, metres, Y up, the floor is the X-Z plane (Habitat's). Yaw is about +Y, 0 looks along -Z, left is
positive; pitch is positive upwards; both in radians. A pose is `camera_to_world`, 4x4. Camera axes are *habitat*
(= OpenGL = nerfstudio: x right, y up, looks along -z) unless a name says *opencv* (= COLMAP, Open3D: x right, y down,
looks along +z).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from avp_habitat.ranges import Range, number

Float = NDArray[np.floating]

_SIDE, _HFOV_DEG = Range(1, 16_384), Range(0.001, 179)
# Largest accepted deviation of R Rᵀ from the identity, and of a pose's last row.
_RIGID = 1e-4
_FLIP_YZ = np.diag([1.0, -1.0, -1.0, 1.0])
_Y_UP_TO_Z_UP = np.array([[1.0, 0, 0, 0], [0, 0, -1.0, 0], [0, 1.0, 0, 0], [0, 0, 0, 1.0]])


@dataclass(frozen=True)
class Intrinsics:
    """A pinhole camera without distortion; pixel centres lie at +0.5."""

    width: int
    """Image width in pixels."""
    height: int
    """Image height in pixels."""
    fx: float
    """Focal length along x in pixels."""
    fy: float
    """Focal length along y in pixels."""
    cx: float
    """Principal point, x, in pixels from the left border."""
    cy: float
    """Principal point, y, in pixels from the upper border."""

    @classmethod
    def from_hfov(cls, width: int, height: int, *, hfov_deg: float) -> "Intrinsics":
        """Square pixels with the given horizontal field of view, principal point in the middle.

        Raises:
            UsageError: a number is outside its range.
        """
        width, height = (number(*side, int, _SIDE) for side in (("width", width), ("height", height)))
        hfov_deg = number("hfov_deg", hfov_deg, float, _HFOV_DEG)
        focal = (width / 2) / np.tan(np.radians(hfov_deg) / 2)
        return cls(width, height, float(focal), float(focal), width / 2, height / 2)

    @property
    def matrix(self) -> Float:
        """The `(3, 3)` camera matrix K of the opencv axes, in pixels."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1.0]])


def camera_to_world(position: Float, *, yaw: Float, pitch: Float) -> NDArray[np.float64]:
    """`(n, 4, 4)` poses of upright cameras (no roll), habitat axes.

    Args:
        position: `(n, 3)` camera centres, metres, world frame.
        yaw: `(n,)` radians, left positive.
        pitch: `(n,)` radians, up positive.
    """
    position = np.asarray(position, dtype=np.float64)
    cos_y, sin_y = np.cos(yaw), np.sin(yaw)
    cos_p, sin_p = np.cos(pitch), np.sin(pitch)
    pose = np.zeros((len(position), 4, 4))
    pose[:, 0, 0], pose[:, 0, 1], pose[:, 0, 2] = cos_y, sin_y * sin_p, sin_y * cos_p
    pose[:, 1, 1], pose[:, 1, 2] = cos_p, -sin_p
    pose[:, 2, 0], pose[:, 2, 1], pose[:, 2, 2] = -sin_y, cos_y * sin_p, cos_y * cos_p
    pose[:, :3, 3] = position
    pose[:, 3, 3] = 1.0
    return pose


def yaw_and_pitch(pose: Float) -> tuple[Float, Float]:
    """Yaw and pitch in radians, `(n,)` each, of `(n, 4, 4)` habitat poses; the inverse of `camera_to_world`."""
    forward = -pose[..., :3, 2]
    return np.arctan2(-forward[..., 0], -forward[..., 2]), np.arcsin(np.clip(forward[..., 1], -1.0, 1.0))


def heading(yaw: Float, pitch: Float | float = 0.0) -> NDArray[np.float64]:
    """`(n, 3)` unit vectors along which agents with `(n,)` yaws and pitches in radians look; level, they walk there."""
    yaw, pitch = np.broadcast_arrays(np.asarray(yaw, np.float64), np.asarray(pitch, np.float64))
    return np.stack([-np.sin(yaw) * np.cos(pitch), np.sin(pitch), -np.cos(yaw) * np.cos(pitch)], axis=-1)


def wrap_angle(angle: Float) -> Float:
    """The same angle within [-pi, pi), radians, any shape."""
    return (np.asarray(angle) + np.pi) % (2 * np.pi) - np.pi


def habitat_to_opencv(pose: Float) -> Float:
    """`(..., 4, 4)` camera_to_world with habitat camera axes, to the same poses with opencv camera axes."""
    return np.asarray(pose) @ _FLIP_YZ


def opencv_to_habitat(pose: Float) -> Float:
    """`(..., 4, 4)` camera_to_world with opencv camera axes, to the same poses with habitat camera axes."""
    return np.asarray(pose) @ _FLIP_YZ


def y_up_to_z_up(pose: Float) -> Float:
    """`(..., 4, 4)` poses in the world with Y up, to the same poses in nerfstudio's world with Z up (x stays x)."""
    return _Y_UP_TO_Z_UP @ np.asarray(pose)


def z_up_to_y_up(pose: Float) -> Float:
    """`(..., 4, 4)` poses in a world with Z up, to the same poses in the world with Y up (x stays x)."""
    return _Y_UP_TO_Z_UP.T @ np.asarray(pose)


def axes_to_world(up: tuple[float, float, float], front: tuple[float, float, float]) -> NDArray[np.float64]:
    """The `(3, 3)` rotation from a file with these axes, unit vectors at right angles, to the world.

    Up becomes +Y, front -Z: the frame that Habitat-Sim builds of a stage config's `up` and `front`.
    """
    return np.array([np.cross(front, up), up, np.negative(front)], dtype=np.float64)


def pixel_directions(intrinsics: Intrinsics) -> Float:
    """`(height, width, 3)` habitat camera-frame directions through the pixel centres, with z = -1.

    Scaled so that a ray parameter t along them is planar depth in metres.
    """
    u = (np.arange(intrinsics.width) + 0.5 - intrinsics.cx) / intrinsics.fx
    v = (np.arange(intrinsics.height) + 0.5 - intrinsics.cy) / intrinsics.fy
    return np.stack(np.broadcast_arrays(u[None, :], -v[:, None], -1.0), axis=-1)


def project(points: Float, pose: Float, intrinsics: Intrinsics) -> tuple[Float, Float]:
    """Project `(m, 3)` world points in metres into the cameras of `(n, 4, 4)` habitat poses.

    Returns:
        `(n, m, 2)` pixel coordinates (x right, y down, pixel centres at +0.5; meaningless behind the camera) and
        `(n, m)` planar depth in metres, negative behind the camera.
    """
    local = np.einsum("nij,nmi->nmj", pose[:, :3, :3], points[None] - pose[:, None, :3, 3])
    depth = -local[..., 2]
    safe = np.where(np.abs(depth) < 1e-9, 1e-9, depth)
    u = intrinsics.fx * local[..., 0] / safe + intrinsics.cx
    v = -intrinsics.fy * local[..., 1] / safe + intrinsics.cy
    return np.stack([u, v], axis=-1), depth


def unproject(depth: Float, pose: Float, intrinsics: Intrinsics) -> Float:
    """World points, `(height, width, 3)` metres, of a `(height, width)` planar depth image in metres.

    The pose is a `(4, 4)` camera_to_world, habitat axes.
    """
    local = pixel_directions(intrinsics) * np.asarray(depth, dtype=np.float64)[..., None]
    return local @ pose[:3, :3].T + pose[:3, 3]


def rigidity_fault(pose: Float) -> str | None:
    """Why a matrix is not a rigid camera_to_world, in words, or None when it is one."""
    pose = np.asarray(pose)
    if pose.shape != (4, 4):
        return f"expected a 4x4 matrix, got shape {pose.shape}"
    if not np.isfinite(pose).all():
        return "expected finite numbers, got NaN or infinity"
    if np.abs(pose[3] - [0, 0, 0, 1]).max() > _RIGID:
        return f"expected the last row 0 0 0 1, got {' '.join(f'{x:g}' for x in pose[3])}"
    rotation = pose[:3, :3]
    determinant = float(np.linalg.det(rotation))
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > _RIGID:
        return f"expected a rotation, got a matrix with determinant {determinant:.3f} that is not orthonormal"
    if determinant < 0:
        return f"expected a rotation, got a reflection (determinant {determinant:.3f}); was one axis flipped?"
    return None
