"""A room with half a dividing wall, ray-cast analytically: a second simulator, small enough to check by eye.

The room is 6 m along x, 3 m along z and 2.6 m high; a wall 0.2 m thick crosses it at x = 3 m from z = 0 to z = 1.8 m.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from avp_habitat.poses import pixel_directions
from avp_habitat.scenes.location import Frame
from avp_habitat.sight.rules import pairs_in_image
from avp_habitat.simulators.base import Frames

ROOM = np.array([[0.0, 0.0, 0.0], [6.0, 2.6, 3.0]])
WALL = np.array([[2.9, 0.0, 0.0], [3.1, 2.6, 1.8]])
RADIUS = 0.1
RGB = np.array([200, 30, 90], dtype=np.uint8)


def free(points):
    """Whether an agent of 0.1 m radius fits at `(n, 3)` points."""
    x, z = points[..., 0], points[..., 2]
    inside = (x >= RADIUS) & (x <= 6 - RADIUS) & (z >= RADIUS) & (z <= 3 - RADIUS)
    return inside & ~((x > 2.9 - RADIUS) & (x < 3.1 + RADIUS) & (z < 1.8 + RADIUS))


@dataclass
class CorridorArea:
    cell_m: float = 0.1

    @cached_property
    def origin(self):
        return np.zeros(2)

    @cached_property
    def mask(self):
        rows, columns = np.mgrid[0:30, 0:60]
        return free(np.stack([(columns + 0.5) * 0.1, 0 * rows, (rows + 0.5) * 0.1], axis=-1))

    @cached_property
    def centres(self):
        rows, columns = np.nonzero(self.mask)
        return np.stack([(columns + 0.5) * 0.1, np.zeros(len(rows)), (rows + 0.5) * 0.1], axis=1)

    area_m2 = property(lambda self: len(self.centres) * self.cell_m**2)
    diameter_m = property(lambda self: float(np.hypot(5.8, 2.8)))

    def cell_of(self, points):
        return np.floor(points[:, [2, 0]] / self.cell_m + 1e-9).astype(int)

    def floor_height(self, points):
        return np.zeros(len(points))

    def contains(self, points):
        return free(points)

    def random_points(self, rng, count):
        return self.centres[rng.integers(len(self.centres), size=count)]

    def slide(self, positions, displacements):
        """In 1 cm pieces, each axis by itself: good enough for an axis-aligned room."""
        here = np.array(positions)
        for _ in range(100):
            for axis in (0, 2):
                there = here.copy()
                there[:, axis] += displacements[:, axis] / 100
                here = np.where(free(there)[:, None], there, here)
        return here


def hit_distance(origins, directions):
    """`(k,)` parameter t at which `(k, 3)` rays from inside the room meet the room's shell or the wall."""
    with np.errstate(divide="ignore", invalid="ignore"):
        shell = np.where(directions > 0, (ROOM[1] - origins) / directions, (ROOM[0] - origins) / directions)
        shell = np.where(directions == 0, np.inf, shell).min(axis=1)
        a, b = (WALL[0] - origins) / directions, (WALL[1] - origins) / directions
        enter = np.nanmax(np.minimum(a, b), axis=1)
        leave = np.nanmin(np.maximum(a, b), axis=1)
    wall = np.where((enter <= leave) & (enter > 0), enter, np.inf)
    return np.minimum(shell, wall)


def reached(eye, points, pairs, tolerance_m):
    """`(k,)` whether rays from `(n, 3)` places reach `(m, 3)` points, for `(k, 2)` rows (place, point)."""
    origins = eye[pairs[:, 0]]
    rays = points[pairs[:, 1]] - origins
    length = np.linalg.norm(rays, axis=1)
    return hit_distance(origins, rays / length[:, None]) >= length - tolerance_m


class Corridor:
    """A `Simulator` of its own, which shows whole images only."""

    name = "corridor"
    version = "1"
    scene = "corridor"
    scene_digest = "c0" * 32
    scene_frame = Frame()

    def __init__(self):
        self.area = CorridorArea()

    def render(self, camera_to_world, intrinsics, *, rgb):
        local = pixel_directions(intrinsics).reshape(-1, 3)
        depth = np.stack(
            [
                hit_distance(np.broadcast_to(pose[:3, 3], local.shape), local @ pose[:3, :3].T)
                for pose in camera_to_world
            ]
        )
        shape = (len(camera_to_world), intrinsics.height, intrinsics.width)
        colours = np.broadcast_to(RGB, (*shape, 3)).copy() if rgb else None
        return Frames(colours, depth.reshape(shape).astype(np.float32))

    def visible(self, camera_to_world, intrinsics, points, pairs, *, tolerance_m):
        inside = pairs_in_image(camera_to_world, intrinsics, points, pairs)
        return inside & reached(camera_to_world[:, :3, 3], points, pairs, tolerance_m)

    def close(self):
        pass


class RayCorridor(Corridor):
    """The same, casting single rays too."""

    def reached(self, eye, points, pairs, *, tolerance_m):
        return reached(eye, points, pairs, tolerance_m)

    def distance(self, origin, direction):
        return hit_distance(origin, direction)
