"""How well views show the surface of a scene, looked up: a bit per surface point and place of the lattice."""

import hashlib
import weakref

import numpy as np
from numpy.typing import NDArray

from avp_habitat.lookup import kernels
from avp_habitat.lookup.disk import TileFiles
from avp_habitat.lookup.lattice import Lattice
from avp_habitat.lookup.rows import PlaceRows, words_for
from avp_habitat.lookup.sight import seen_bits, single_rays
from avp_habitat.lookup.tables import SPACING_M
from avp_habitat.senses import Views
from avp_habitat.settings import TaskSettings
from avp_habitat.simulators.base import Simulator, SingleRays
from avp_habitat.surface_senses import raise_quality
from avp_habitat.surfaces import FULL_DISTANCE_M, SceneSurface, scene_surface

_VERSION = 1


class SurfaceTables:
    """Which surface points are seen from the places that were asked for."""

    def __init__(self, simulator: SingleRays, settings: TaskSettings) -> None:
        """Make empty tables."""
        # Not held: the tables live as long as their simulator, whose users hold it.
        self._simulator: SingleRays = weakref.proxy(simulator)
        self.surface: SceneSurface = scene_surface(simulator, settings)
        """The points that the bits stand for."""
        self._height_m, self._tolerance_m = settings.sensor_height_m, settings.tolerance_m
        self._reach_m = settings.max_range_m + 2 * SPACING_M
        content = hashlib.sha256(simulator.area.centres.tobytes() + self.surface.points.tobytes())
        numbers = (self._height_m, self._tolerance_m, self._reach_m, SPACING_M)
        content.update(f"{simulator.scene_digest} surface {_VERSION} {numbers}".encode())
        empty = {"visible": np.zeros((0, words_for(len(self.surface.points))), dtype=np.uint64)}
        lattice = Lattice(simulator.area, SPACING_M)
        self._rows = PlaceRows(lattice, TileFiles(content.hexdigest()[:32]), empty, self._compute)

    @property
    def visible(self) -> NDArray[np.uint64]:
        """`(slots, words)`: bit j % 64 of word j // 64 says whether point j is seen from the slot's place."""
        return self._rows.columns["visible"]

    def around(self, position: NDArray[np.floating]) -> NDArray[np.int32]:
        """`(k, 4)` the slots around `(k, 3)` feet, made now where they are new."""
        return self._rows.around(position)[0]

    def _compute(self, feet: NDArray[np.floating]) -> dict[str, NDArray]:
        eye = feet + [0.0, self._height_m, 0.0]
        points, reach, tolerance = self.surface.points, self._reach_m, self._tolerance_m
        return {"visible": seen_bits(self._simulator, eye, points, reach_m=reach, tolerance_m=tolerance)}


class TableSurface:
    """Points on which the tables' places differ are cast as rays, the others looked up."""

    def __init__(self, simulator: Simulator, settings: TaskSettings) -> None:
        """Use the scene's tables.

        Raises:
            UsageError: the simulator cannot cast single rays, or the scene shows no surface.
        """
        self._simulator = single_rays(simulator, "lookup")
        self._settings = settings
        self._tables = surface_tables(self._simulator, settings)
        camera = settings.intrinsics
        self._camera = (
            *(float(camera.width), float(camera.height)),
            *(camera.fx, camera.fy, camera.cx, camera.cy),
        )
        self._doubtful, self._doubtful_q = _room_for(4096)

    def capture(self, views: Views, quality: NDArray[np.float32], rows: NDArray[np.integer]) -> NDArray[np.float64]:
        """See `SurfaceSenses`."""
        slots, points = self._tables.around(views.position), self._tables.surface.points
        gain = np.zeros(len(slots))
        doubts = self._sure_points(views, slots, quality, rows, gain)
        if doubts:
            pairs, value = self._doubtful[:doubts], self._doubtful_q[:doubts]
            eye = views.camera_to_world[:, :3, 3]
            reached = self._simulator.reached(eye, points, pairs, tolerance_m=self._settings.tolerance_m)
            gain += raise_quality(quality, rows, pairs[reached, 0], pairs[reached, 1], value[reached])
        return gain

    def _sure_points(
        self,
        views: Views,
        slots: NDArray[np.int32],
        quality: NDArray[np.float32],
        rows: NDArray[np.integer],
        gain: NDArray[np.float64],
    ) -> int:
        """Raise what is certain; returns how many pairs (view, point) only a ray can decide."""
        while True:
            doubts = kernels.new_surface(
                self._tables.visible,
                slots,
                views.camera_to_world,
                self._tables.surface.points,
                self._tables.surface.normals,
                self._camera,
                self._settings.max_range_m,
                FULL_DISTANCE_M,
                rows,
                quality,
                new := np.empty_like(gain),
                self._doubtful,
                self._doubtful_q,
            )
            gain += new
            if doubts <= len(self._doubtful):
                return doubts
            # Once more with enough room: the sure points are raised by now and not found again.
            self._doubtful, self._doubtful_q = _room_for(2 * doubts)


def _room_for(pairs: int) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    return np.empty((pairs, 2), dtype=np.int64), np.empty(pairs, dtype=np.float32)


_shared: weakref.WeakKeyDictionary[SingleRays, dict[tuple[float, ...], SurfaceTables]] = weakref.WeakKeyDictionary()


def surface_tables(simulator: SingleRays, settings: TaskSettings) -> SurfaceTables:
    """The tables for a scene and a task; tasks on the same open simulator share them."""
    key = (settings.sensor_height_m, settings.max_range_m, settings.tolerance_m)
    known = _shared.setdefault(simulator, {})
    if key not in known:
        known[key] = SurfaceTables(simulator, settings)
    return known[key]
