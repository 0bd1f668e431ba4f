"""The depth cameras of agents: rays, which are the definition, or the scene's tables."""

import numpy as np
from numpy.typing import NDArray

from avp_habitat.compiled import njit
from avp_habitat.errors import UsageError
from avp_habitat.navigation.area import NavigableArea
from avp_habitat.poses import Intrinsics, pixel_directions
from avp_habitat.sight import panorama
from avp_habitat.sight.newly_seen import new_cells
from avp_habitat.sight.rules import camera_numbers, candidates
from avp_habitat.sight.tables import pitches, scene_tables, single_rays
from avp_habitat.simulators.base import Simulator
from avp_habitat.task.settings import TaskSettings
from avp_habitat.task.views import Float, Shown, Views, depth_statistics

_YAW_STEP = 2 * np.pi / panorama.YAWS
_PITCH_STEP = np.radians(panorama.PITCH_STEP_DEG)


class CastSensor:
    """The definition itself: a depth image of full size, and a ray to every cell not yet seen inside the image."""

    def __init__(self, simulator: Simulator, settings: TaskSettings) -> None:
        """Use a simulator's rays."""
        self._simulator = simulator
        self._settings = settings
        self._intrinsics = settings.intrinsics
        self._cells = len(simulator.area.centres)

    def look(self, views: Views) -> Shown:
        """Depth statistics alone, as at a start, which is no captured view."""
        statistics = depth_statistics(self._depth(views), self._settings.max_range_m)
        return Shown(*statistics, np.zeros(len(views.position), dtype=np.int64))

    def capture(
        self, views: Views, first_seen: NDArray[np.int16], rows: NDArray[np.integer], steps: NDArray[np.integer]
    ) -> Shown:
        """Depth statistics, and coverage: cells seen for the first time are marked in place.

        Args:
            views: of k agents.
            first_seen: `(n, >= m)` step at which each cell was first seen, 0 for never.
            rows: `(k,)` the agents' rows of it.
            steps: `(k,)` the agents' steps.
        """
        depth = self._depth(views)
        unseen = first_seen[rows, : self._cells] == 0
        over = self._settings.coverage_mode == "over"
        agent, cell = self._new_over(views, depth, unseen) if over else self._new_visible(views, unseen)
        first_seen[np.asarray(rows)[agent], cell] = np.asarray(steps)[agent]
        found = np.bincount(agent, minlength=len(depth))
        return Shown(*depth_statistics(depth, self._settings.max_range_m), found)

    def _depth(self, views: Views) -> Float:
        return self._simulator.render(views.camera_to_world, self._intrinsics, rgb=False).depth

    def _new_visible(self, views: Views, unseen: NDArray[np.bool_]) -> tuple[NDArray, NDArray]:
        """Indices of agents and cells that the views observe for the first time."""
        settings, centres = self._settings, self._simulator.area.centres
        pose = views.camera_to_world
        pairs = candidates(pose, self._intrinsics, centres, unseen, max_range_m=settings.max_range_m)
        reached = self._simulator.visible(pose, self._intrinsics, centres, pairs, tolerance_m=settings.tolerance_m)
        return pairs[reached, 0], pairs[reached, 1]

    def _new_over(self, views: Views, depth: Float, unseen: NDArray[np.bool_]) -> tuple[NDArray, NDArray]:
        pose, area, reach_m = views.camera_to_world, self._simulator.area, self._settings.max_range_m
        agent, cell = np.nonzero(unseen & cells_passed_over(pose, self._intrinsics, depth, area, max_range_m=reach_m))
        return agent, cell


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
        """As `CastSensor.look`."""
        slots, weights = self._tables.around(views.position)
        return self._shown(views, slots, weights, np.zeros(len(slots), dtype=np.int64))

    def capture(
        self, views: Views, first_seen: NDArray[np.int16], rows: NDArray[np.integer], steps: NDArray[np.integer]
    ) -> Shown:
        """As `CastSensor.capture`."""
        slots, weights = self._tables.around(views.position)
        pose, reach_m = views.camera_to_world, self._settings.max_range_m
        visible = self._tables.columns["visible"]
        found, pairs = new_cells(visible, slots, pose, self._centres, self._camera, reach_m, rows, steps, first_seen)
        if len(pairs):
            eyes, tolerance_m = pose[:, :3, 3], self._settings.tolerance_m
            reached = self._simulator.reached(eyes, self._centres, pairs, tolerance_m=tolerance_m)
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


def cells_passed_over(
    camera_to_world: Float, intrinsics: Intrinsics, depth: Float, area: NavigableArea, *, max_range_m: float
) -> NDArray[np.bool_]:
    """`(n, m)` which of the area's cells the rays of n depth images pass over, from the camera to the hit or the range.

    Args:
        camera_to_world: `(n, 4, 4)` habitat poses.
        intrinsics: of the depth images.
        depth: `(n, height, width)` planar depth in metres, 0 where nothing was hit.
        area: with m cells.
        max_range_m: rays end after this length, metres.
    """
    cells = np.full(area.mask.shape, -1, dtype=np.int64)
    cells[area.mask] = np.arange(len(area.centres))
    local = pixel_directions(intrinsics).reshape(-1, 3)
    reach = max_range_m / np.linalg.norm(local, axis=1)
    over = np.zeros((len(depth), len(area.centres)), dtype=np.bool_)
    for agent, pose in enumerate(camera_to_world):
        seen = depth[agent].reshape(-1)
        length = np.where(seen > 0, np.minimum(seen, reach), reach)
        ends = (local * length[:, None]) @ pose[:3, :3].T + pose[:3, 3]
        start = (pose[[0, 2], 3] - area.origin) / area.cell_m
        _traverse(start, (ends[:, [0, 2]] - area.origin) / area.cell_m, cells, over[agent])
    return over


@njit(cache=True)
def _traverse(start, ends, cell_index, out):
    """Mark the cells of `out` `(m,)` between a start `(2,)` and `(k, 2)` ends, in units of cells.

    From one cell border to the next (Amanatides and Woo, 1987, "A fast voxel traversal algorithm for ray tracing").
    """
    rows, columns = cell_index.shape
    for k in range(len(ends)):
        dx, dz = ends[k, 0] - start[0], ends[k, 1] - start[1]
        column, row = int(np.floor(start[0])), int(np.floor(start[1]))
        step_x, step_z = (1 if dx > 0 else -1), (1 if dz > 0 else -1)
        next_x = np.inf if dx == 0 else (column + (dx > 0) - start[0]) / dx
        next_z = np.inf if dz == 0 else (row + (dz > 0) - start[1]) / dz
        width_x = np.inf if dx == 0 else abs(1 / dx)
        width_z = np.inf if dz == 0 else abs(1 / dz)
        while True:
            if 0 <= row < rows and 0 <= column < columns and cell_index[row, column] >= 0:
                out[cell_index[row, column]] = True
            if min(next_x, next_z) > 1.0:
                break
            if next_x < next_z:
                column += step_x
                next_x += width_x
            else:
                row += step_z
                next_z += width_z
