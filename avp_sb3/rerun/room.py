"""The room of a recording: a coloured point cloud out of pictures with depth."""

from collections.abc import Iterable

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from avp_habitat.poses import Intrinsics, pixel_directions

Cloud = tuple[NDArray[np.float32], NDArray[np.uint8]]
"""`(p, 3)` points in metres, world frame, and `(p, 3)` colours."""
_PIXELS_PER_FRAME = 40_000
_CELL_KEY = np.array([1 << 42, 1 << 21, 1])
_GROWTH = 1.05
_POINT_RADIUS_M = 0.02


def room_points(
    frames: Iterable[tuple[NDArray[np.uint8], NDArray[np.floating]]],
    intrinsics: Intrinsics,
    camera_to_world: NDArray[np.floating],
    *,
    voxel_m: float = 0.05,
    at_most: int = 60_000,
    max_depth_m: float = 10.0,
    ceiling_m: float = 0.3,
) -> Cloud:
    """A cloud with one point in each occupied voxel, at the mean place and colour of the pixels that fell into it.

    The same frames give the same cloud. Of large pictures a regular grid of about 40,000 pixels is used.

    Args:
        frames: k times a `(h, w, 3)` uint8 picture and its `(h, w)` planar depth in metres, 0 (or NaN) = none; read
            one after the other, so that a generator keeps one of them in memory.
        intrinsics: of all frames.
        camera_to_world: `(k, 4, 4)` habitat poses in the order of the frames.
        voxel_m: side of a voxel in metres; it grows until at most `at_most` are occupied.
        at_most: greatest number of points, above 0.
        max_depth_m: pixels farther than this are left out, metres.
        ceiling_m: points more than this above the highest camera are left out, metres: seen from above, a ceiling hides
            the room. `math.inf` keeps all.

    Returns:
        Points and colours.
    """
    stride = max(1, int(np.ceil(np.sqrt(intrinsics.width * intrinsics.height / _PIXELS_PER_FRAME))))
    directions = pixel_directions(intrinsics)[::stride, ::stride]
    ceiling = np.max(camera_to_world[:, 1, 3], initial=-np.inf) + ceiling_m
    clouds = [np.empty((0, 7))]
    for (rgb, depth), pose in zip(frames, camera_to_world, strict=True):
        seen, colours = np.asarray(depth)[::stride, ::stride].astype(np.float64), np.asarray(rgb)[::stride, ::stride]
        hit = (seen > 0) & (seen <= max_depth_m)
        points = (directions[hit] * seen[hit][:, None]) @ pose[:3, :3].T + pose[:3, 3]
        rows = np.column_stack([points, colours[hit].astype(np.float64), np.ones(len(points))])
        clouds.append(_summed(rows[points[:, 1] <= ceiling], voxel_m))
    rows = _summed(np.concatenate(clouds), voxel_m)
    while len(rows) > at_most:
        voxel_m *= max(_GROWTH, np.sqrt(len(rows) / at_most))
        rows = _summed(rows, voxel_m, from_least=True)
    means = rows[:, :6] / np.maximum(rows[:, 6:], 1)
    return means[:, :3].astype(np.float32), means[:, 3:].round().astype(np.uint8)


def _summed(rows: NDArray[np.float64], voxel_m: float, *, from_least: bool = False) -> NDArray[np.float64]:
    """Add up the `(n, 7)` sums over pixels (place, colour, how many) whose mean places lie in the same voxel."""
    places = rows[:, :3] / rows[:, 6:]
    cells = np.floor((places - (places.min(axis=0) if from_least else 0)) / voxel_m).astype(np.int64)
    _, group = np.unique(cells @ _CELL_KEY, return_inverse=True)
    return np.stack([np.bincount(group, weights=column).astype(np.float64) for column in rows.T], axis=1)


def log_room(recording: rr.RecordingStream, path: str, cloud: Cloud) -> None:
    """Add a room to a recording, at all times."""
    points, colours = cloud
    recording.log(path, rr.Points3D(points, colors=colours, radii=[_POINT_RADIUS_M]), static=True)
