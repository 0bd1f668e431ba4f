"""What views show of a scene, looked up in its tables."""

import numpy as np
from numpy.typing import NDArray

from avp_habitat.errors import UsageError
from avp_habitat.sight import panorama
from avp_habitat.sight.newly_seen import new_cells
from avp_habitat.sight.rules import camera_numbers
from avp_habitat.sight.tables import pitches, scene_tables, single_rays
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
        self._lowest = pitches(settings)[0]
        self._centres = np.ascontiguousarray(simulator.area.centres)
        self._camera = camera_numbers(settings.intrinsics)

    def look(self, views: Views) -> Shown:
        """See `Sensor`."""
        slots, weights = self._tables.around(views.position)
        return self._shown(views, slots, weights, np.zeros(len(slots), dtype=np.int64))

    def capture(
        self, views: Views, first_seen: NDArray[np.int16], rows: NDArray[np.integer], steps: NDArray[np.integer]
    ) -> Shown:
        """See `Sensor`."""
        slots, weights = self._tables.around(views.position)
        pose, reach_m = views.camera_to_world, self._settings.max_range_m
        visible = self._tables.columns["visible"]
        found, pairs = new_cells(visible, slots, pose, self._centres, self._camera, reach_m, rows, steps, first_seen)
        if len(pairs):
            reached = self._simulator.reached(
                pose[:, :3, 3], self._centres, pairs, tolerance_m=self._settings.tolerance_m
            )
            agent, cell = pairs[reached].T
            first_seen[rows[agent], cell] = steps[agent]
            found += np.bincount(agent, minlength=len(found))
        return self._shown(views, slots, weights, found)

    def _shown(
        self, views: Views, slots: NDArray[np.int32], weights: NDArray[np.float32], found: NDArray[np.int64]
    ) -> Shown:
        yaw, pitch = (views.yaw % (2 * np.pi)) / _YAW_STEP, (views.pitch - self._lowest) / _PITCH_STEP
        least, mean = panorama.interpolate(self._tables.columns["statistics"], slots, weights, yaw, pitch)
        return Shown(least, mean, found)
