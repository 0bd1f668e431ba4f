"""The definition of what a view shows: a depth image of full size, and a ray to every cell not yet seen inside it."""

import numpy as np
from numpy.typing import NDArray

from avp_habitat.compiled import njit
from avp_habitat.poses import Intrinsics, pixel_directions
from avp_habitat.sight.rules import candidates
from avp_habitat.simulators.base import Simulator
from avp_habitat.task.settings import TaskSettings
from avp_habitat.task.views import Float, Shown, Views, depth_statistics


class CastSensor:
    """The definition itself: a depth image of full size, and a ray to every cell not yet seen inside the image."""

    def __init__(self, simulator: Simulator, settings: TaskSettings) -> None:
        """Use a simulator's rays."""
        self._simulator = simulator
        self._settings = settings
        self._intrinsics = settings.intrinsics
        area = simulator.area
        self._cells = len(area.centres)
        self._cell_index = np.full(area.mask.shape, -1, dtype=np.int64)
        self._cell_index[area.mask] = np.arange(self._cells)

    def look(self, views: Views) -> Shown:
        """See `Sensor`."""
        return self._shown(self._depth(views), np.zeros(len(views.position), dtype=np.int64))

    def capture(
        self, views: Views, first_seen: NDArray[np.int16], rows: NDArray[np.integer], steps: NDArray[np.integer]
    ) -> Shown:
        """See `Sensor`."""
        depth = self._depth(views)
        unseen = first_seen[rows, : self._cells] == 0
        agent, cell = self._new_over(views, depth, unseen) if self._wide else self._new_visible(views, unseen)
        first_seen[np.asarray(rows)[agent], cell] = np.asarray(steps)[agent]
        return self._shown(depth, np.bincount(agent, minlength=len(depth)))

    @property
    def _wide(self) -> bool:
        return self._settings.coverage_mode == "over"

    def _depth(self, views: Views) -> Float:
        return self._simulator.render(views.camera_to_world, self._intrinsics, rgb=False).depth

    def _shown(self, depth: Float, new_cells: NDArray[np.int64]) -> Shown:
        least, mean = depth_statistics(depth, self._settings.max_range_m)
        return Shown(least, mean, new_cells)

    def _new_visible(self, views: Views, unseen: NDArray[np.bool_]) -> tuple[NDArray, NDArray]:
        """Indices of agents and cells that the views observe for the first time."""
        settings, centres = self._settings, self._simulator.area.centres
        pose = views.camera_to_world
        pairs = candidates(pose, self._intrinsics, centres, unseen, max_range_m=settings.max_range_m)
        reached = self._simulator.visible(pose, self._intrinsics, centres, pairs, tolerance_m=settings.tolerance_m)
        return pairs[reached, 0], pairs[reached, 1]

    def _new_over(self, views: Views, depth: Float, unseen: NDArray[np.bool_]) -> tuple[NDArray, NDArray]:
        area = self._simulator.area
        passed = cells_passed_over(
            views.camera_to_world,
            self._intrinsics,
            depth,
            self._cell_index,
            area.origin,
            cell_m=area.cell_m,
            cells=self._cells,
            max_range_m=self._settings.max_range_m,
        )
        agent, cell = np.nonzero(unseen & passed)
        return agent, cell


def cells_passed_over(
    camera_to_world: Float,
    intrinsics: Intrinsics,
    depth: Float,
    cell_index: NDArray[np.integer],
    origin: Float,
    *,
    cell_m: float,
    cells: int,
    max_range_m: float,
) -> NDArray[np.bool_]:
    """Which navigable cells the rays of n depth images pass over, from the camera to the hit or the range.

    Args:
        camera_to_world: `(n, 4, 4)` habitat poses.
        intrinsics: of the depth images.
        depth: `(n, height, width)` planar depth in metres, 0 where nothing was hit.
        cell_index: `(rows, columns)` number of each navigable cell, -1 elsewhere; rows along +Z, columns along +X.
        origin: `(2,)` x and z in metres of the least corner of cell (0, 0).
        cell_m: side of a cell in metres.
        cells: number of navigable cells m.
        max_range_m: rays end after this length, metres.

    Returns:
        `(n, m)`.
    """
    local = pixel_directions(intrinsics).reshape(-1, 3)
    reach = max_range_m / np.linalg.norm(local, axis=1)
    over = np.zeros((len(depth), cells), dtype=np.bool_)
    for agent, pose in enumerate(camera_to_world):
        seen = depth[agent].reshape(-1)
        length = np.where(seen > 0, np.minimum(seen, reach), reach)
        ends = (local * length[:, None]) @ pose[:3, :3].T + pose[:3, 3]
        start = (pose[[0, 2], 3] - origin) / cell_m
        _traverse(start, (ends[:, [0, 2]] - origin) / cell_m, cell_index, over[agent])
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
