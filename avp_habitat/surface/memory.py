"""How well agents have seen the surface of their scenes so far in their episodes."""

import hashlib

import numpy as np
from numpy.typing import NDArray

from avp_habitat.sight.bits import words_for
from avp_habitat.sight.lattice import PlaceTable
from avp_habitat.sight.newly_seen import new_surface, raise_points
from avp_habitat.sight.rules import camera_numbers, candidates, view_quality
from avp_habitat.sight.tables import SPACING_M, once_per_simulator, point_table, single_rays
from avp_habitat.simulators.base import Simulator, SingleRays
from avp_habitat.surface.around import look_around
from avp_habitat.surface.map import SurfaceMapper
from avp_habitat.surface.points import scene_surface
from avp_habitat.task.settings import TaskSettings
from avp_habitat.task.views import Views

Float = NDArray[np.floating]
Rows = NDArray[np.integer]

_VERSION = 1


@once_per_simulator("sensor_height_m", "max_range_m", "tolerance_m")
def surface_tables(simulator: SingleRays, settings: TaskSettings) -> PlaceTable:
    """Which surface points are seen from the places asked for; tasks on the same open simulator share them."""
    points = scene_surface(simulator, settings).points
    reach_m = settings.max_range_m + 2 * SPACING_M
    numbers = (settings.sensor_height_m, settings.tolerance_m, reach_m, SPACING_M)
    name = hashlib.sha256(simulator.area.centres.tobytes() + points.tobytes())
    name.update(f"{simulator.scene_digest} surface {_VERSION} {numbers}".encode())
    return point_table(simulator, settings, points, name.hexdigest())


class RoomSurface:
    """The memory of the agents in one scene; n is the number of all agents, also those elsewhere."""

    def __init__(self, simulator: Simulator, settings: TaskSettings, agents: int, rows: Rows) -> None:
        """Make room for the `(k,)` rows of those of all agents that are in the scene.

        Raises:
            UsageError: the simulator cannot do what the settings ask for, or the scene shows no surface.
        """
        self._simulator, self._settings = simulator, settings
        self._surface = scene_surface(simulator, settings)
        self._rays = single_rays(simulator, "lookup") if settings.lookup else None
        self._camera = camera_numbers(settings.intrinsics)
        self._mapper = SurfaceMapper(self._surface, settings.sensor_height_m)
        self._row = np.zeros(agents, dtype=np.int64)
        self._row[rows] = np.arange(len(rows))
        shape, words = (len(rows), len(self._surface.points)), words_for(settings.budget)
        self._quality = np.zeros(shape, dtype=np.float32)
        # Turning on the spot gives no new eye: there are never more of them than views.
        self._eyes = np.zeros((len(rows), settings.budget, 3))
        self._eye = np.full(len(rows), -1)
        self._pair = np.zeros(shape if settings.with_parallax else (len(rows), 0), dtype=np.float32)
        self._seen_from = np.zeros((*shape, words if settings.with_parallax else 0), dtype=np.uint64)
        self._reached = np.zeros((len(rows), 2))

    def reset(self, rows: Rows) -> None:
        """Forget what some agents saw."""
        for memory in (self._quality, self._pair, self._seen_from, self._reached):
            memory[self._row[rows]] = 0
        self._eye[self._row[rows]] = -1

    def capture(self, views: Views, rows: Rows) -> NDArray[np.float64]:
        """`(k, 2)` ΔQ and ΔS in sum of the newest views of k agents, which are remembered."""
        rows, eyes = self._row[rows], np.ascontiguousarray(views.camera_to_world[:, :3, 3])
        moved = (self._eye[rows] < 0) | (self._eyes[rows, self._eye[rows]] != eyes).any(axis=1)
        self._eye[rows] += moved
        self._eyes[rows, self._eye[rows]] = eyes
        gain = self._cast(views, rows) if self._rays is None else self._look_up(self._rays, views, rows)
        self._reached[rows] += gain
        return gain

    def observe(self, rows: Rows, position: Float, yaw: Float) -> NDArray[np.float32]:
        """`(k, surface.map.SIZE)` what k agents know of the surface; see `SurfaceMapper.observe`."""
        return self._mapper.observe(self._quality, self._row[rows], position, yaw)

    def around(self, views: Views, rows: Rows) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """What k agents know of the surface, with how well along two rays where that is computed; see `look_around`."""
        pair = self._pair if self._settings.with_parallax else self._quality
        eye = views.camera_to_world[:, :3, 3]
        return look_around(self._surface, self._quality, pair, self._row[rows], eye, views.yaw)

    def quality(self, row: int) -> NDArray[np.float32]:
        """`(m,)` how well one agent has seen each point of its scene's surface, within [0, 1]."""
        return self._quality[self._row[row]]

    def parallax(self, row: int) -> NDArray[np.float32]:
        """`(m,)` how well one agent has seen each point along two rays, within [0, 1]."""
        return self._pair[self._row[row]]

    def shares(self, rows: Rows) -> NDArray[np.float64]:
        """`(k, 2)` ΣQ and ΣS by the sum of the best qualities in the scene, which no agent knows, at most 1."""
        return np.minimum(self._reached[self._row[rows]] / self._surface.best.sum(), 1.0)

    @property
    def _pairing(self) -> tuple[NDArray, NDArray, NDArray]:
        return self._pair, self._seen_from, self._eyes

    def _cast(self, views: Views, rows: Rows) -> NDArray[np.float64]:
        """The definition itself: a ray to every point inside the image that the view could show better than before."""
        settings, surface, pose = self._settings, self._surface, views.camera_to_world
        found = view_quality(pose[:, :3, 3], surface.points, surface.normals).astype(np.float32)
        better, reach_m = found > self._quality[rows], settings.max_range_m
        if settings.with_parallax:
            better |= found > self._pair[rows] ** 2
        pairs = candidates(pose, settings.intrinsics, surface.points, better, max_range_m=reach_m)
        tolerance_m = settings.tolerance_m
        reached = self._simulator.visible(pose, settings.intrinsics, surface.points, pairs, tolerance_m=tolerance_m)
        gain, pairs = np.zeros((len(rows), 2)), pairs[reached]
        self._raise(rows, pairs, found[pairs[:, 0], pairs[:, 1]], gain)
        return gain

    def _look_up(self, rays: SingleRays, views: Views, rows: Rows) -> NDArray[np.float64]:
        """Points on which the tables' places differ are cast as rays, the others looked up."""
        points, normals, pose = self._surface.points, self._surface.normals, views.camera_to_world
        tables = surface_tables(rays, self._settings)
        slots, visible = tables.around(views.position)[0], tables.columns["visible"]
        reach_m, camera, number = self._settings.max_range_m, self._camera, self._eye[rows]
        known = self._quality, self._pairing, number
        gain, pairs, value = new_surface(visible, slots, pose, points, normals, camera, reach_m, rows, *known)
        if len(pairs):
            reached = rays.reached(pose[:, :3, 3], points, pairs, tolerance_m=self._settings.tolerance_m)
            self._raise(rows, pairs[reached], value[reached], gain)
        return gain

    def _raise(self, rows: Rows, pairs: Rows, value: NDArray[np.float32], gain: Float) -> None:
        surface, number = self._surface, self._eye[rows]
        raise_points(rows, pairs, value, number, surface.points, surface.normals, self._quality, self._pairing, gain)
