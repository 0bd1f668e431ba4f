"""What views show of a scene, looked up in its tables."""

import numpy as np
from numpy.typing import NDArray

from avp_habitat.errors import UsageError
from avp_habitat.sight import kernels, panorama
from avp_habitat.sight.tables import scene_tables, single_rays
from avp_habitat.simulators.base import Simulator
from avp_habitat.task.settings import TaskSettings
from avp_habitat.task.views import Shown, Views

_YAW_STEP = 2 * np.pi / panorama.YAWS
_PITCH_STEP = np.radians(panorama.PITCH_STEP_DEG)


class TableSensor:
    """Depth statistics interpolated between the tables' places; cells on which the places differ are cast as rays."""

    def __init__(self, simulator: Simulator, settings: TaskSettings) -> None:
        """Use the scene's tables.

        Raises:
            UsageError: the simulator cannot cast single rays, or coverage is counted in another way.
        """
        if settings.coverage_mode != "visible":
            raise UsageError(
                f"lookup: the tables know coverage_mode 'visible' only, got {settings.coverage_mode!r}; "
                "leave lookup off for it"
            )
        self._simulator = single_rays(simulator, "lookup")
        self._settings = settings
        self._tables = scene_tables(self._simulator, settings)
        self._lowest = self._tables.key.pitches[0]
        self._centres = np.ascontiguousarray(simulator.area.centres)
        camera = settings.intrinsics
        self._camera = (
            *(float(camera.width), float(camera.height)),
            *(camera.fx, camera.fy, camera.cx, camera.cy),
        )
        self._doubtful = np.empty((4096, 2), dtype=np.int64)

    def look(self, views: Views) -> Shown:
        """See `Sensor`."""
        slots, weights = self._tables.around(views.position)
        return self._shown(views, slots, weights, np.zeros(len(slots), dtype=np.int64))

    def capture(
        self, views: Views, first_seen: NDArray[np.int16], rows: NDArray[np.integer], steps: NDArray[np.integer]
    ) -> Shown:
        """See `Sensor`."""
        slots, weights = self._tables.around(views.position)
        found = np.zeros(len(slots), dtype=np.int64)
        pairs = self._sure_cells(views, slots, first_seen, rows, steps, found)
        if len(pairs):
            eye = views.camera_to_world[:, :3, 3]
            reached = self._simulator.reached(eye, self._centres, pairs, tolerance_m=self._settings.tolerance_m)
            agent, cell = pairs[reached].T
            first_seen[rows[agent], cell] = steps[agent]
            found += np.bincount(agent, minlength=len(found))
        return self._shown(views, slots, weights, found)

    def _sure_cells(
        self,
        views: Views,
        slots: NDArray[np.int32],
        first_seen: NDArray[np.int16],
        rows: NDArray[np.integer],
        steps: NDArray[np.integer],
        found: NDArray[np.int64],
    ) -> NDArray[np.int64]:
        """Mark the cells that are certainly new; returns the pairs (view, cell) that only a ray can decide."""
        while True:
            doubts = kernels.new_cells(
                self._tables.visible,
                slots,
                views.camera_to_world,
                self._centres,
                self._camera,
                self._settings.max_range_m,
                rows,
                steps,
                first_seen,
                new := np.empty_like(found),
                self._doubtful,
            )
            found += new
            if doubts <= len(self._doubtful):
                return self._doubtful[:doubts]
            # Once more with enough room: the sure cells are marked by now and not found again.
            self._doubtful = np.empty((2 * doubts, 2), dtype=np.int64)

    def _shown(
        self, views: Views, slots: NDArray[np.int32], weights: NDArray[np.float32], found: NDArray[np.int64]
    ) -> Shown:
        least, mean = np.empty(len(slots)), np.empty(len(slots))
        kernels.depth_statistics(
            self._tables.statistics,
            slots,
            weights,
            (views.yaw % (2 * np.pi)) / _YAW_STEP,
            (views.pitch - self._lowest) / _PITCH_STEP,
            least,
            mean,
        )
        return Shown(least, mean, found)
