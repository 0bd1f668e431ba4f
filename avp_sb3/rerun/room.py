"""The room of a recording: a coloured point cloud out of pictures with depth."""

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from avp_habitat import poses
from avp_habitat.poses import Intrinsics, pixel_directions

if TYPE_CHECKING:
    from avp_habitat.navigation.area import NavigableArea

_PIXELS_PER_FRAME = 40_000
_CELL_BITS = 21
_GROWTH = 1.05
_CANDIDATES, _YAWS, _PITCH_DEG = 512, 3, -20.0

_Cloud = tuple[NDArray[np.float64], NDArray[np.float64]]
"""`(p, 3)` points in metres, and `(p, 4)` sums of red, green and blue over the pixels of each, and their number."""


def room_poses(area: "NavigableArea", *, sensor_height_m: float, places: int = 12) -> NDArray[np.float64]:
    """Views from all over a scene, always the same ones: three directions at each of some places far from each other.

    Args:
        area: where one can stand.
        sensor_height_m: above the floor, metres.
        places: how many.

    Returns:
        `(3 * places, 4, 4)` habitat camera_to_world.
    """
    candidates = area.random_points(np.random.default_rng(0), _CANDIDATES)
    chosen, distance = [0], np.full(len(candidates), np.inf)
    while len(chosen) < places:
        distance = np.minimum(distance, np.linalg.norm(candidates - candidates[chosen[-1]], axis=1))
        chosen.append(int(distance.argmax()))
    standing = np.repeat(candidates[chosen], _YAWS, axis=0) + np.array([0.0, sensor_height_m, 0.0])
    yaw = 2 * np.pi * (np.arange(len(standing)) / _YAWS + np.arange(len(standing)) // _YAWS * 0.382)
    return poses.camera_to_world(standing, yaw=yaw, pitch=np.full(len(standing), np.radians(_PITCH_DEG)))


def room_points(
    frames: Iterable[tuple[NDArray[np.uint8], NDArray[np.floating]]],
    intrinsics: Intrinsics,
    camera_to_world: NDArray[np.floating],
    *,
    voxel_m: float = 0.05,
    at_most: int = 60_000,
    max_depth_m: float = 10.0,
    ceiling_m: float = 0.3,
) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """A cloud with one point in each occupied voxel, at the mean place and colour of the pixels that fell into it.

    The same frames give the same cloud. Of large pictures a regular grid of about 40,000 pixels is used.

    Args:
        frames: k times a `(h, w, 3)` uint8 picture and its `(h, w)` planar depth in metres, 0 (or NaN) = none; read
            one after the other, so that a generator keeps one of them in memory.
        intrinsics: of all frames.
        camera_to_world: `(k, 4, 4)` habitat poses in the order of the frames.
        voxel_m: side of a voxel in metres; it grows until at most `at_most` are occupied.
        at_most: greatest number of points.
        max_depth_m: pixels farther than this are left out, metres.
        ceiling_m: points more than this above the highest camera are left out, metres: seen from above, a ceiling hides
            the room. `math.inf` keeps all.

    Returns:
        `(p, 3)` float32 points in metres, world frame, and `(p, 3)` uint8 colours.

    Raises:
        ValueError: sizes do not fit, or an option is not above 0.
    """
    if not (voxel_m > 0 and at_most > 0 and max_depth_m > 0):
        raise ValueError(f"expected options above 0, got {voxel_m=}, {at_most=}, {max_depth_m=}")
    stride = max(1, int(np.ceil(np.sqrt(intrinsics.width * intrinsics.height / _PIXELS_PER_FRAME))))
    directions = pixel_directions(intrinsics)[::stride, ::stride]
    ceiling = np.max(camera_to_world[:, 1, 3], initial=-np.inf) + ceiling_m
    clouds = [(np.empty((0, 3)), np.empty((0, 4)))]
    for (rgb, depth), pose in zip(frames, camera_to_world, strict=True):
        _check_sizes(rgb, depth, intrinsics)
        seen, colours = np.asarray(depth)[::stride, ::stride].astype(np.float64), np.asarray(rgb)[::stride, ::stride]
        hit = (seen > 0) & (seen <= max_depth_m)
        points = (directions[hit] * seen[hit][:, None]) @ pose[:3, :3].T + pose[:3, 3]
        sums = np.concatenate([colours[hit].astype(np.float64), np.ones((len(points), 1))], axis=1)
        low = points[:, 1] <= ceiling
        clouds.append(_thin(points[low], sums[low], voxel_m, origin=np.zeros(3)))
    points, sums = (np.concatenate(parts) for parts in zip(*clouds, strict=True))
    points, sums = _thin(points, sums, voxel_m, origin=np.zeros(3))
    while len(points) > at_most:
        voxel_m *= max(_GROWTH, np.sqrt(len(points) / at_most))
        points, sums = _thin(points, sums, voxel_m, origin=points.min(axis=0))
    return points.astype(np.float32), (sums[:, :3] / np.maximum(sums[:, 3:], 1)).round().astype(np.uint8)


def log_room(
    recording: rr.RecordingStream,
    path: str,
    points: NDArray[np.float32],
    colours: NDArray[np.uint8],
    *,
    radius_m: float = 0.02,
) -> None:
    """Add a room to a recording, at all times.

    Args:
        recording: where to.
        path: entity path.
        points: `(p, 3)` metres, world frame.
        colours: `(p, 3)` uint8.
        radius_m: of a point, metres.
    """
    recording.log(path, rr.Points3D(points, colors=colours, radii=[radius_m]), static=True)


def _check_sizes(rgb: NDArray, depth: NDArray, intrinsics: Intrinsics) -> None:
    size = (intrinsics.height, intrinsics.width)
    if np.shape(depth) != size or np.shape(rgb) != (*size, 3):
        raise ValueError(
            f"expected frames of {size[1]}x{size[0]} pixels, got a picture of shape {np.shape(rgb)} and depth of shape "
            f"{np.shape(depth)}"
        )


def _thin(points: NDArray[np.float64], sums: NDArray[np.float64], voxel_m: float, *, origin: NDArray) -> _Cloud:
    """One point per voxel: the mean, by the number of pixels, of the `(n, 3)` points in it; the `(n, 4)` sums added."""
    cell = np.floor((points - origin) / voxel_m).astype(np.int64) + (1 << (_CELL_BITS - 1))
    key = (cell[:, 0] << 2 * _CELL_BITS) | (cell[:, 1] << _CELL_BITS) | cell[:, 2]
    unique, group = np.unique(key, return_inverse=True)
    rows = np.concatenate([points * sums[:, 3:], sums], axis=1)
    total = np.empty((len(unique), rows.shape[1]))
    for index, column in enumerate(rows.T):
        total[:, index] = np.bincount(group, weights=column, minlength=len(unique))
    return total[:, :3] / total[:, 6:], total[:, 3:]
