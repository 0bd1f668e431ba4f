"""The optional wide reading of "observed": every cell that a camera ray passes over counts.

Cells are traversed exactly, from one cell border to the next (Amanatides and Woo, 1987, "A fast voxel traversal
algorithm for ray tracing"), compiled by Numba, which is imported on first use.
"""

from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avp_habitat.poses import Intrinsics, pixel_directions

Float = NDArray[np.floating]


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
        _traverse()(start, (ends[:, [0, 2]] - origin) / cell_m, cell_index, over[agent])
    return over


@cache
def _traverse() -> Any:
    """The compiled traversal, in units of cells: (start (2,), ends (k, 2), cell_index, out (m,))."""
    from avp_habitat.compiled import njit

    @njit(cache=True)
    def traverse(start: Any, ends: Any, cell_index: Any, out: Any) -> None:
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

    return traverse
