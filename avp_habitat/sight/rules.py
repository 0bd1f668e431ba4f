"""What a camera sees of points: which lie inside its image, how well, and what its depth image says of them.

Each rule is one compiled function of numbers, called by compiled code, beside a function of arrays for all others.
A floor cell is observed once its floor point is visible in a frame: inside the image, at most 10 m away, and reached by
the camera ray through it. `candidates` answers the first two for all cells; `Simulator.visible` answers the first and
the third, by occlusion rays (the ray-casting simulator) or by depth images (`visible_in_depth`).
"""

import numpy as np
from numpy.typing import NDArray

from avp_habitat.compiled import njit
from avp_habitat.metrics import PARALLAX_DEG
from avp_habitat.poses import Intrinsics

Float = NDArray[np.floating]
Camera = tuple[float, float, float, float, float, float]
"""Width, height, fx, fy, cx, cy in pixels: how compiled code takes `Intrinsics`."""

FULL_DISTANCE_M = 2.0
"""d₀: a surface seen straight on from this near, or nearer, is seen with quality 1, metres."""
_FULL_PARALLAX = np.sin(np.radians(PARALLAX_DEG)) ** 2


def camera_numbers(intrinsics: Intrinsics) -> Camera:
    """The numbers of a camera for compiled code."""
    size = float(intrinsics.width), float(intrinsics.height)
    return *size, intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy


@njit(cache=True)
def in_camera(pose, point):
    """A world point in the axes of a `(4, 4)` habitat pose: right, up and ahead (the planar depth), metres."""
    x, y, z = point[0] - pose[0, 3], point[1] - pose[1, 3], point[2] - pose[2, 3]
    right = pose[0, 0] * x + pose[1, 0] * y + pose[2, 0] * z
    up = pose[0, 1] * x + pose[1, 1] * y + pose[2, 1] * z
    return right, up, -(pose[0, 2] * x + pose[1, 2] * y + pose[2, 2] * z)


@njit(cache=True)
def turned(x, z, sine, cosine):
    """How far ahead and how far to the right an offset on the floor lies, by the sine and cosine of a yaw.

    Seen from above: yaw 0 looks along -z, left is positive. With both divided by a length, that is the unit.
    """
    return -x * sine - z * cosine, x * cosine - z * sine


@njit(cache=True)
def in_image(right, up, ahead, camera):
    """Whether a point lies before the camera and inside its image; the right and the lower border are outside."""
    width, height, fx, fy, cx, cy = camera
    # Pixel times depth: without the division, which costs more than all the rest.
    u, v = fx * right + cx * ahead, cy * ahead - fy * up
    return ahead > 0 and 0 <= u < width * ahead and 0 <= v < height * ahead


@njit(cache=True)
def in_view(pose, point, camera, max_range):
    """Whether a point lies inside the image and within range: distance to the camera, not planar depth."""
    x, y, z = point[0] - pose[0, 3], point[1] - pose[1, 3], point[2] - pose[2, 3]
    return in_image(*in_camera(pose, point), camera) and np.sqrt(x * x + y * y + z * z) <= max_range


@njit(cache=True)
def quality(eye, point, normal):
    """How well a surface point is seen from a place: cos(ray, normal) · min(1, d₀ / distance), 0 from behind."""
    x, y, z = eye[0] - point[0], eye[1] - point[1], eye[2] - point[2]
    distance = max(np.sqrt(x * x + y * y + z * z), 1e-9)
    cosine = (x * normal[0] + y * normal[1] + z * normal[2]) / distance
    return min(max(cosine, 0.0), 1.0) * min(1.0, FULL_DISTANCE_M / distance)


@njit(cache=True)
def parallax_square(eye, other, point):
    """min(1, sin θ / sin 10°)², θ the angle at a point between the rays from two places.

    The error of a depth that is triangulated along two rays grows as 1 / sin θ; 10° counts as enough.
    """
    ax, ay, az = eye[0] - point[0], eye[1] - point[1], eye[2] - point[2]
    bx, by, bz = other[0] - point[0], other[1] - point[1], other[2] - point[2]
    cx, cy, cz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    lengths = (ax * ax + ay * ay + az * az) * (bx * bx + by * by + bz * bz)
    return min(1.0, (cx * cx + cy * cy + cz * cz) / (max(lengths, 1e-18) * _FULL_PARALLAX))


@njit(cache=True)
def inverse_depths(depth, right, up, ahead, camera):
    """Inverse depth that an image `(height, width)` holds for a point inside it, 0 where nothing was hit.

    First it is read between pixels: inverse depth is linear over the image of a plane, so that bilinear interpolation
    is exact on planes at any resolution and slope. Where the four neighbours belong to different surfaces that value
    belongs to none, so the nearest pixel's is given as well.
    """
    _, _, fx, fy, cx, cy = camera
    u, v = fx * right / ahead + cx, cy - fy * up / ahead
    height, width = depth.shape
    nearest = _inverse(depth, min(int(v), height - 1), min(int(u), width - 1))
    x, y = min(max(u - 0.5, 0.0), width - 1.0), min(max(v - 0.5, 0.0), height - 1.0)
    left, upper = min(int(x), max(width - 2, 0)), min(int(y), max(height - 2, 0))
    next_column, next_row = min(left + 1, width - 1), min(upper + 1, height - 1)
    a, b = x - left, y - upper
    top = _inverse(depth, upper, left) * (1 - a) + _inverse(depth, upper, next_column) * a
    bottom = _inverse(depth, next_row, left) * (1 - a) + _inverse(depth, next_row, next_column) * a
    return top * (1 - b) + bottom * b, nearest


@njit(cache=True)
def _inverse(depth, row, column):
    value = depth[row, column]
    # In single precision, as depth images are.
    return np.float64(np.float32(1.0 / value)) if value > 0 else 0.0


def candidates(
    camera_to_world: Float, intrinsics: Intrinsics, points: Float, unseen: NDArray[np.bool_], *, max_range_m: float
) -> NDArray[np.int64]:
    """Pairs (camera, point) whose point lies inside the image and within range, and was not seen before.

    Args:
        camera_to_world: `(n, 4, 4)` habitat poses.
        intrinsics: of all cameras.
        points: `(m, 3)` metres, world frame.
        unseen: `(n, m)` pairs worth testing.
        max_range_m: largest distance from camera to point, metres, not planar depth.

    Returns:
        `(k, 2)` indices, ordered by camera and point.
    """
    pose, wanted, camera = _whole(camera_to_world), np.ascontiguousarray(unseen), camera_numbers(intrinsics)
    return np.argwhere(_in_views(pose, _whole(points), wanted, camera, max_range_m))


def pairs_in_image(
    camera_to_world: Float, intrinsics: Intrinsics, points: Float, pairs: NDArray[np.integer]
) -> NDArray[np.bool_]:
    """`(k,)` whether points lie inside images, for `(k, 2)` rows (camera, point); other arguments as `candidates`."""
    return _pairs_in_image(_whole(camera_to_world), _whole(points), _whole(pairs, np.int64), camera_numbers(intrinsics))


def rays_to_points(
    eye: Float, points: Float, pairs: NDArray[np.integer], tolerance_m: float
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Rays to `(m, 3)` points from `(n, 3)` places, metres, for `(k, 2)` rows (place, point).

    Returns:
        `(k, 6)` origins and directions, which end `tolerance_m` before the point, so that one limit, t <= 1, fits all;
        and `(k,)` whether a point lies within that of the place: its direction is 0.
    """
    return _rays_to_points(_whole(eye), _whole(points), _whole(pairs, np.int64), tolerance_m)


def visible_in_depth(
    camera_to_world: Float,
    intrinsics: Intrinsics,
    depth: Float,
    points: Float,
    pairs: NDArray[np.integer],
    *,
    tolerance_m: float,
) -> NDArray[np.bool_]:
    """`(k,)` whether depth images show points: inside the image, and reached by the camera ray through it.

    Args:
        camera_to_world: `(n, 4, 4)` habitat poses.
        intrinsics: of the depth images.
        depth: `(n, height, width)` planar depth in metres, 0 where nothing was hit.
        points: `(m, 3)` metres, world frame.
        pairs: `(k, 2)` rows (camera, point).
        tolerance_m: a hit this close before the point still reaches it, metres along the ray.
    """
    pose, rows = _whole(camera_to_world), _whole(pairs, np.int64)
    images = np.ascontiguousarray(depth)
    return _visible_in_depth(pose, images, _whole(points), rows, camera_numbers(intrinsics), float(tolerance_m))


def view_quality(eye: Float, points: Float, normals: Float) -> NDArray[np.float64]:
    """`(k, m)` how well `(m, 3)` points with unit normals are seen from `(k, 3)` places, metres; see `quality`.

    It is so wherever a point lies in the image and whatever lies between.
    """
    return _view_quality(_whole(eye), _whole(points), _whole(normals))


def _whole(array: NDArray, kind: type = np.float64) -> NDArray:
    """One layout and type, for which the compiled functions are compiled once."""
    return np.ascontiguousarray(array, dtype=kind)


@njit(cache=True)
def _in_views(poses, points, wanted, camera, max_range):
    found = np.zeros(wanted.shape, np.bool_)
    for i in range(len(poses)):
        for j in range(len(points)):
            found[i, j] = wanted[i, j] and in_view(poses[i], points[j], camera, max_range)
    return found


@njit(cache=True)
def _pairs_in_image(poses, points, pairs, camera):
    found = np.zeros(len(pairs), np.bool_)
    for k in range(len(pairs)):
        found[k] = in_image(*in_camera(poses[pairs[k, 0]], points[pairs[k, 1]]), camera)
    return found


@njit(cache=True)
def _rays_to_points(eye, points, pairs, tolerance):
    rays, near = np.empty((len(pairs), 6), np.float32), np.zeros(len(pairs), np.bool_)
    for k in range(len(pairs)):
        start, end = eye[pairs[k, 0]], points[pairs[k, 1]]
        x, y, z = end[0] - start[0], end[1] - start[1], end[2] - start[2]
        distance = np.sqrt(x * x + y * y + z * z)
        near[k] = distance <= tolerance
        share = 0.0 if near[k] else 1.0 - tolerance / distance
        rays[k, 0], rays[k, 1], rays[k, 2] = start[0], start[1], start[2]
        rays[k, 3], rays[k, 4], rays[k, 5] = x * share, y * share, z * share
    return rays, near


@njit(cache=True)
def _visible_in_depth(poses, depth, points, pairs, camera, tolerance):
    found = np.zeros(len(pairs), np.bool_)
    for k in range(len(pairs)):
        right, up, ahead = in_camera(poses[pairs[k, 0]], points[pairs[k, 1]])
        if in_image(right, up, ahead, camera):
            distance = np.sqrt(right * right + up * up + ahead * ahead)
            reach = ahead * (1.0 - tolerance / max(distance, tolerance))
            limit = 1.0 / max(reach, 1e-6)
            between, nearest = inverse_depths(depth[pairs[k, 0]], right, up, ahead, camera)
            found[k] = between <= limit or nearest <= limit
    return found


@njit(cache=True)
def _view_quality(eye, points, normals):
    found = np.empty((len(eye), len(points)))
    for i in range(len(eye)):
        for j in range(len(points)):
            found[i, j] = quality(eye[i], points[j], normals[j])
    return found


@njit(cache=True)
def agreeing_depths(depth, pose, camera, points, tolerance_m, tolerance_share):
    """`(m,)` whether points lie inside the image, and the depth image `(height, width)` shows each at its own depth."""
    seen = np.zeros(len(points), np.bool_)
    for j in range(len(points)):
        right, up, ahead = in_camera(pose, points[j])
        if in_image(right, up, ahead, camera):
            # |d - z| <= t in inverse depth; 1/d is at most 1/(z - t), unbounded where the camera is that near.
            tolerance = max(tolerance_m, tolerance_share * ahead)
            least, most = 1.0 / (ahead + tolerance), 1.0 / max(ahead - tolerance, 1e-6)
            between, nearest = inverse_depths(depth, right, up, ahead, camera)
            seen[j] = least <= between <= most or least <= nearest <= most
    return seen
