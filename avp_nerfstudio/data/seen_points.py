"""Points that the cameras saw, from some pixels of some depth images."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from avp_habitat.poses import Intrinsics, pixel_directions, y_up_to_z_up
from avp_habitat.rollout.format import View
from avp_habitat.rollout.images import read_depth, read_rgb

MOST_VIEWS = 24
"""So many pictures are decoded at most, however long the rollout is."""
PIXELS_PER_VIEW = 4800
"""About so many pixels of each are used."""

_SEED = 0
_BOX_PERCENTILES = (0.2, 99.8)


@dataclass(frozen=True)
class SeenPoints:
    """Points on the surfaces of a scene."""

    xyz: NDArray[np.float32]
    """`(n, 3)` metres, Z up."""
    rgb: NDArray[np.uint8]
    """`(n, 3)` their colours; `(0, 3)` when not asked for."""


def seen_points(views: Sequence[View], intrinsics: Intrinsics, *, colours: bool) -> SeenPoints:
    """Back-project a grid of pixels of views that are evenly spread over the given ones.

    Args:
        views: at least one.
        intrinsics: of their pictures.
        colours: whether to decode the pictures beside the depth.

    Raises:
        RolloutError: a picture cannot be decoded.
    """
    chosen = np.unique(np.linspace(0, len(views) - 1, min(len(views), MOST_VIEWS)).round().astype(int))
    stride = max(1, round((intrinsics.width * intrinsics.height / PIXELS_PER_VIEW) ** 0.5))
    grid = (slice(stride // 2, None, stride),) * 2
    directions = pixel_directions(intrinsics)[grid]
    points, rgb = [np.zeros((0, 3))], [np.zeros((0, 3), np.uint8)]
    for view in (views[index] for index in chosen):
        depth = read_depth(view.depth)[grid]
        seen = depth > 0
        pose = view.camera_to_world
        points.append((directions[seen] * depth[seen, None]) @ pose[:3, :3].T + pose[:3, 3])
        if colours:
            rgb.append(read_rgb(view.image)[grid][seen])
    return SeenPoints(_z_up(np.concatenate(points)).astype(np.float32), np.concatenate(rgb))


def subset(points: SeenPoints, count: int) -> SeenPoints:
    """At most `count` coloured points, drawn at random; the same ones every time."""
    indices = np.random.default_rng(_SEED).permutation(len(points.xyz))[:count]
    return SeenPoints(points.xyz[indices], points.rgb[indices])


def scene_box(views: Sequence[View], points: SeenPoints, *, margin_m: float) -> NDArray[np.float64]:
    """The box that holds the cameras and what they saw.

    Far outliers (a glimpse through a window) do not stretch it.

    Args:
        views: whose cameras are to be inside; at least one.
        points: what they saw.
        margin_m: added on every side.

    Returns:
        `(2, 3)` least and greatest corner, metres, Z up.
    """
    corners = _z_up(np.stack([view.camera_to_world[:3, 3] for view in views]))
    if len(points.xyz):
        corners = np.concatenate([corners, np.percentile(points.xyz, _BOX_PERCENTILES, axis=0)])
    return np.stack([corners.min(axis=0) - margin_m, corners.max(axis=0) + margin_m])


def _z_up(points: NDArray[np.floating]) -> NDArray[np.floating]:
    return points @ y_up_to_z_up(np.eye(4))[:3, :3].T
