"""How well agents have seen the surface of their scenes so far in their episodes."""

import hashlib

import numpy as np
from numpy.typing import NDArray

from avp_habitat.sight.bits import pack, words_for
from avp_habitat.sight.lattice import PlaceTable
from avp_habitat.sight.newly_seen import new_surface, raise_points
from avp_habitat.sight.rules import camera_numbers
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
        self._reached = np.zeros((len(rows), 4))
        self._asked = np.full(shape, -1, dtype=np.int16)
        best = self._surface.best, self._surface.best * self._surface.shown
        self._most = np.repeat([each.sum() for each in best], 2)
        # Places that differ on every point, for who has no tables.
        self._unsure = np.array([0, 1, 1, 1], np.int32), pack(np.arange(2)[:, None] == np.ones(shape[1]))

    def reset(self, rows: Rows) -> None:
        """Forget what some agents saw."""
        for memory in (self._quality, self._pair, self._seen_from, self._reached):
            memory[self._row[rows]] = 0
        self._eye[self._row[rows]] = self._asked[self._row[rows]] = -1

    def capture(self, views: Views, rows: Rows) -> NDArray[np.float64]:
        """Remember the newest views of k agents.

        Returns:
            `(k, 2, 4)` by how much Q, S, a·Q and a·S grew in sum, and their `shares` then.
        """
        rows, eyes = self._row[rows], np.ascontiguousarray(views.camera_to_world[:, :3, 3])
        moved = (self._eye[rows] < 0) | (self._eyes[rows, self._eye[rows]] != eyes).any(axis=1)
        self._eye[rows] += moved
        self._eyes[rows, self._eye[rows]] = eyes
        if not isinstance(self._simulator, SingleRays):
            # From one eye the same ray leads to a point each time, but not the same pixel of a depth image.
            self._asked[rows] = -1
        gain = self._capture(views, rows)
        self._reached[rows] += gain
        return np.stack([gain, np.minimum(self._reached[rows] / self._most, 1.0)], axis=1)

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

    def shares(self, rows: Rows) -> NDArray[np.float64]:
        """`(k, 4)` ΣQ, ΣS, Σa·Q and Σa·S by such sums of the best qualities, which no agent knows, at most 1."""
        return np.minimum(self._reached[self._row[rows]] / self._most, 1.0)

    @property
    def _pairing(self) -> tuple[NDArray, NDArray, NDArray]:
        return self._pair, self._seen_from, self._eyes

    def _capture(self, views: Views, rows: Rows) -> NDArray[np.float64]:
        """Rays to the points that a view could show better than before, as the definition says, or tables of them.

        Of what tables tell, only points on which their places differ are cast as rays.
        """
        surface, pose = (self._surface.points, self._surface.normals, self._surface.shown), views.camera_to_world
        if self._rays is None:
            slots, visible = self._unsure
        else:
            tables = surface_tables(self._rays, self._settings)
            slots, visible = tables.around(views.position)[0], tables.columns["visible"]
        reach_m, camera, number = self._settings.max_range_m, self._camera, self._eye[rows]
        known = self._quality, self._pairing, number
        slots = np.broadcast_to(slots, (len(rows), 4))
        gain, pairs, value = new_surface(visible, slots, pose, *surface, camera, reach_m, rows, *known, self._asked)
        if len(pairs):
            tolerance_m = self._settings.tolerance_m
            if self._rays is None:
                reached = self._simulator.visible(
                    pose, self._settings.intrinsics, surface[0], pairs, tolerance_m=tolerance_m
                )
            else:
                reached = self._rays.reached(pose[:, :3, 3], surface[0], pairs, tolerance_m=tolerance_m)
            raise_points(rows, pairs[reached], value[reached], number, *surface, *known[:2], gain)
        return gain
