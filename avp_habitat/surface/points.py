"""The surface of a scene as points with normals."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from avp_habitat.compiled import njit
from avp_habitat.errors import UsageError
from avp_habitat.poses import Intrinsics, unproject
from avp_habitat.sight.rules import quality
from avp_habitat.sight.tables import once_per_simulator
from avp_habitat.simulators.base import Simulator
from avp_habitat.task.motion import sensor_poses
from avp_habitat.task.settings import TaskSettings

EDGE_M = 0.25
"""One point for each cube of this edge and each of six directions that surface in it faces, metres."""
_PLACES = 60
_YAWS_DEG = (0.0, 90.0, 180.0, 270.0)
_PITCHES_DEG = (-45.0, 0.0, 45.0)
_CAMERA = Intrinsics.from_hfov(96, 72, hfov_deg=100.0)
_FLAT_SHARE = 0.002
"""A pixel has a normal where its four neighbours lie this close to its plane, as a share of its distance: the rounded
normals of edges and corners would else count as surfaces that face a direction of their own."""
_BEFORE_M = 0.01
_LEVEL = 0.999
"""Cosine of the pitch from which on a picture counts as level."""


@dataclass(frozen=True)
class SampledView:
    """A depth image that looks from some place in some direction."""

    place: NDArray[np.float64]
    """`(3,)` metres, on the floor below the camera."""
    camera_to_world: NDArray[np.float64]
    """`(4, 4)` habitat axes."""
    points: NDArray[np.float64]
    """`(height, width, 3)` what the pixels show, metres, world frame."""
    hit: NDArray[np.bool_]
    """`(height, width)` whether a pixel shows a surface within range."""


@dataclass(frozen=True)
class SceneSurface:
    """m points all over what can be seen in a scene: walls, furniture, ceiling and floor."""

    points: NDArray[np.float64]
    """`(m, 3)` metres, world frame."""
    normals: NDArray[np.float64]
    """`(m, 3)` unit vectors out of the surface, to the side from which it was seen."""
    best: NDArray[np.float64]
    """`(m,)` quality with which each was seen from the places where the points were looked for: about the best one."""
    shown: NDArray[np.float64]
    """`(m,)` a: how many pixels of level pictures from there showed each, in units of their mean."""


def views_all_over(simulator: Simulator, settings: TaskSettings) -> Iterator[SampledView]:
    """What is seen all around from places all over the floor, the same ones every time."""
    centres = simulator.area.centres
    places = centres[np.unique(np.linspace(0, len(centres) - 1, min(len(centres), _PLACES)).astype(int))]
    yaw, pitch = (np.radians(grid.ravel()) for grid in np.meshgrid(_YAWS_DEG, _PITCHES_DEG))
    for place in places:
        pose = sensor_poses(settings, np.repeat(place[None], len(yaw), axis=0), yaw, pitch)
        depth = simulator.render(pose, _CAMERA, rgb=False).depth
        for each, image in zip(pose, depth, strict=True):
            hit = (image > 0) & (image <= settings.max_range_m)
            yield SampledView(place, each, np.asarray(unproject(image, each, _CAMERA), dtype=np.float64), hit)


@once_per_simulator("sensor_height_m", "max_range_m")
def scene_surface(simulator: Simulator, settings: TaskSettings) -> SceneSurface:
    """The surface of a scene; found once for an open simulator.

    Of the pixels that show the same cube, facing alike, the one that is seen best gives point and normal.

    Raises:
        UsageError: the scene shows no surface at all.
    """
    found: list[NDArray[np.float64]] = [np.zeros((0, 8))]
    for view in views_all_over(simulator, settings):
        pixels = _flat_pixels(view.points, view.hit, view.camera_to_world[:3, 3].copy())
        pixels[:, 7] = view.camera_to_world[1, 1] > _LEVEL
        found.append(_best(pixels))
    rows = _best(np.concatenate(found))
    if not len(rows):
        raise UsageError(f"reward or observation surface: {simulator.scene} shows none; expected walls or furniture")
    points, normals = np.ascontiguousarray(rows[:, :3]), np.ascontiguousarray(rows[:, 3:6])
    best, pixels = np.ascontiguousarray(rows[:, 6:].T)
    # Where no level picture shows any, as from high above a floor, all count alike.
    shown = pixels / pixels.mean() if pixels.any() else np.ones(len(pixels))
    return SceneSurface(points, normals, best, shown)


@njit(cache=True)
def _flat_pixels(points, hit, eye):
    """Where the surface is flat enough to have a normal: `(k, 8)` points, unit normals towards the eye, qualities, 0.

    `points` `(height, width, 3)` and `hit` `(height, width)` are those of a `SampledView`, the eye is `(3,)` metres.
    """
    found, count = np.zeros((hit.size, 8)), 0
    for i in range(1, hit.shape[0] - 1):
        for j in range(1, hit.shape[1] - 1):
            if not (hit[i, j] and hit[i, j + 1] and hit[i, j - 1] and hit[i + 1, j] and hit[i - 1, j]):
                continue
            ax, ay, az = _difference(points[i, j + 1], points[i, j - 1])
            bx, by, bz = _difference(points[i + 1, j], points[i - 1, j])
            nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
            length = max(np.sqrt(nx * nx + ny * ny + nz * nz), 1e-12)
            tx, ty, tz = _difference(eye, points[i, j])
            if nx * tx + ny * ty + nz * tz < 0:
                length = -length
            nx, ny, nz = nx / length, ny / length, nz / length
            off = 0.0
            for di, dj in ((0, 1), (0, -1), (1, 0), (-1, 0)):
                x, y, z = _difference(points[i + di, j + dj], points[i, j])
                off = max(off, abs(nx * x + ny * y + nz * z))
            if off <= _FLAT_SHARE * np.sqrt(tx * tx + ty * ty + tz * tz):
                row = found[count]
                row[:3], row[3], row[4], row[5] = points[i, j], nx, ny, nz
                row[6] = quality(eye, points[i, j], row[3:6])
                count += 1
    return found[:count]


@njit(cache=True)
def _difference(a, b):
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


def _best(rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """Of `(n, 8)` points, normals, qualities and numbers of level pixels the best one of each cube and direction.

    They are ordered by these; the pixels are all that show them.
    """
    # Just before the surface: a wall that lies in the border of two layers of cubes would else be in both.
    cube = np.floor((rows[:, :3] + _BEFORE_M * rows[:, 3:6]) / EDGE_M).astype(np.int64)
    axis = np.abs(rows[:, 3:6]).argmax(axis=1)
    side = np.take_along_axis(rows[:, 3:6], axis[:, None], axis=1)[:, 0] > 0
    order = np.lexsort([-rows[:, 6], side, axis, *cube.T])
    keys = np.column_stack([cube, axis, side])[order]
    first = np.ones(len(rows), dtype=np.bool_)
    first[1:] = (keys[1:] != keys[:-1]).any(axis=1)
    best = rows[order[first]]
    if len(rows):
        best[:, 7] = np.add.reduceat(rows[order, 7], np.flatnonzero(first))
    return best
