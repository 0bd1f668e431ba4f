"""Which floor cells a captured frame observes.

A cell is observed once its floor point is visible in a frame: inside the image, at most 10 m away, and reached by the
camera ray through it. `candidates` answers the first two for all cells. `Simulator.visible` answers the first and the
third, by occlusion rays (the ray-casting simulator) or by depth images (`visible_in_depth`).
"""

import numpy as np
from numpy.typing import NDArray

from avp_habitat.poses import Intrinsics, in_image, project, project_pairs

Float = NDArray[np.floating]


def candidates(
    camera_to_world: Float,
    intrinsics: Intrinsics,
    points: Float,
    unseen: NDArray[np.bool_],
    *,
    max_range_m: float,
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
    pixel, depth = project(points, camera_to_world, intrinsics)
    distance = np.linalg.norm(points[None] - camera_to_world[:, None, :3, 3], axis=-1)
    return np.argwhere(unseen & in_image(pixel, depth, intrinsics) & (distance <= max_range_m))


def pairs_in_image(
    camera_to_world: Float, intrinsics: Intrinsics, points: Float, pairs: NDArray[np.integer]
) -> NDArray[np.bool_]:
    """`(k,)` whether points lie inside images, for `(k, 2)` rows (camera, point); other arguments as `candidates`."""
    pixel, depth = project_pairs(points[pairs[:, 1]], camera_to_world[pairs[:, 0]], intrinsics)
    return in_image(pixel, depth, intrinsics)


def visible_in_depth(
    camera_to_world: Float,
    intrinsics: Intrinsics,
    depth: Float,
    points: Float,
    pairs: NDArray[np.integer],
    *,
    tolerance_m: float,
) -> NDArray[np.bool_]:
    """Whether depth images show points: inside the image, and reached by the camera ray through it.

    The depth along the ray through a point is read between pixels: inverse depth is linear over the image of a plane,
    so bilinear interpolation of it is exact on the floor at any resolution. Where the four neighbours belong to
    different surfaces the interpolated value belongs to none, so the nearest pixel's answer counts as well.

    Args:
        camera_to_world: `(n, 4, 4)` habitat poses.
        intrinsics: of the depth images.
        depth: `(n, height, width)` planar depth in metres, 0 where nothing was hit.
        points: `(m, 3)` metres, world frame.
        pairs: `(k, 2)` rows (camera, point).
        tolerance_m: a hit this close before the point still reaches it, metres along the ray.

    Returns:
        `(k,)`.
    """
    pixel, planar = project_pairs(points[pairs[:, 1]], camera_to_world[pairs[:, 0]], intrinsics)
    seen = in_image(pixel, planar, intrinsics)
    (camera, point), (u, v), planar = pairs[seen].T, pixel[seen].T, planar[seen]
    distance = np.linalg.norm(points[point] - camera_to_world[camera, :3, 3], axis=1)
    inverse = np.where(depth > 0, 1.0 / np.maximum(depth, 1e-6), 0.0)
    reach = planar * (1.0 - tolerance_m / np.maximum(distance, tolerance_m))
    limit = 1.0 / np.maximum(reach, 1e-6)
    between = bilinear(inverse, camera, u - 0.5, v - 0.5)
    row = np.clip(v.astype(np.int64), 0, intrinsics.height - 1)
    column = np.clip(u.astype(np.int64), 0, intrinsics.width - 1)
    seen[seen] = (between <= limit) | (inverse[camera, row, column] <= limit)
    return seen


def bilinear(images: Float, index: NDArray[np.integer], x: Float, y: Float) -> Float:
    """Values of `(n, h, w)` images at `(k,)` positions in pixels (centres at whole numbers), clamped at the border."""
    height, width = images.shape[1:]
    x, y = np.clip(x, 0, width - 1), np.clip(y, 0, height - 1)
    left = np.minimum(x.astype(np.int64), max(width - 2, 0))
    upper = np.minimum(y.astype(np.int64), max(height - 2, 0))
    right, lower = np.minimum(left + 1, width - 1), np.minimum(upper + 1, height - 1)
    a, b = x - left, y - upper
    top = images[index, upper, left] * (1 - a) + images[index, upper, right] * a
    bottom = images[index, lower, left] * (1 - a) + images[index, lower, right] * a
    return top * (1 - b) + bottom * b
