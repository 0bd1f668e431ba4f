"""How well agents have seen the surface of their scenes so far in their episodes."""

import hashlib

import numpy as np
from numpy.typing import NDArray

from avp_habitat.sight.lattice import PlaceTable
from avp_habitat.sight.newly_seen import new_surface
from avp_habitat.sight.rules import camera_numbers, candidates, view_quality
from avp_habitat.sight.tables import SPACING_M, once_per_simulator, point_table, single_rays
from avp_habitat.simulators.base import Simulator, SingleRays
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
        self._quality = np.zeros((len(rows), len(self._surface.points)), dtype=np.float32)

    def reset(self, rows: Rows) -> None:
        """Forget what some agents saw."""
        self._quality[self._row[rows]] = 0.0

    def capture(self, views: Views, rows: Rows) -> NDArray[np.float64]:
        """`(k,)` ΔS of the newest views of k agents, which are remembered."""
        rows = self._row[rows]
        return self._cast(views, rows) if self._rays is None else self._look_up(self._rays, views, rows)

    def observe(self, rows: Rows, position: Float, yaw: Float) -> NDArray[np.float32]:
        """`(k, surface.map.SIZE)` what k agents know of the surface; see `SurfaceMapper.observe`."""
        return self._mapper.observe(self._quality, self._row[rows], position, yaw)

    def quality(self, row: int) -> NDArray[np.float32]:
        """`(m,)` how well one agent has seen each point of its scene's surface, within [0, 1]."""
        return self._quality[self._row[row]]

    def _cast(self, views: Views, rows: Rows) -> NDArray[np.float64]:
        """The definition itself: a ray to every point inside the image that the view would show better than before."""
        settings, surface, pose = self._settings, self._surface, views.camera_to_world
        found = view_quality(pose[:, :3, 3], surface.points, surface.normals).astype(np.float32)
        better, reach_m = found > self._quality[rows], settings.max_range_m
        pairs = candidates(pose, settings.intrinsics, surface.points, better, max_range_m=reach_m)
        tolerance_m = settings.tolerance_m
        reached = self._simulator.visible(pose, settings.intrinsics, surface.points, pairs, tolerance_m=tolerance_m)
        agent, point = pairs[reached].T
        return raise_quality(self._quality, rows, agent, point, found[agent, point])

    def _look_up(self, rays: SingleRays, views: Views, rows: Rows) -> NDArray[np.float64]:
        """Points on which the tables' places differ are cast as rays, the others looked up."""
        points, normals, pose = self._surface.points, self._surface.normals, views.camera_to_world
        tables = surface_tables(rays, self._settings)
        slots, visible = tables.around(views.position)[0], tables.columns["visible"]
        reach_m, tolerance_m = self._settings.max_range_m, self._settings.tolerance_m
        gain, pairs, value = new_surface(
            visible, slots, pose, points, normals, self._camera, reach_m, rows, self._quality
        )
        if len(pairs):
            reached = rays.reached(pose[:, :3, 3], points, pairs, tolerance_m=tolerance_m)
            gain += raise_quality(self._quality, rows, pairs[reached, 0], pairs[reached, 1], value[reached])
        return gain


def raise_quality(quality: Float, rows: Rows, agent: Rows, point: Rows, value: Float) -> NDArray[np.float64]:
    """Enter greater qualities `value` `(p,)` into `quality` `(n, m)`, whose `rows` `(k,)` are the agents'.

    Each pair of `agent` `(p,)`, an index into `rows`, and `point` `(p,)` is there at most once.

    Returns:
        `(k,)` sums of the growth.
    """
    at = np.asarray(rows)[agent], point
    growth = (value - quality[at]).astype(np.float64)
    quality[at] = value
    return np.bincount(agent, weights=growth, minlength=len(rows)).astype(np.float64)
