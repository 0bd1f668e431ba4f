"""Floor heights between the centres of cells."""

import numpy as np

from avp_habitat.compiled import njit


@njit(cache=True)
def interpolated(points, origin, cell_m, heights):
    """`(n,)` heights under `(n, 3)` points, as `NavigableArea.floor_height` gives them.

    Args:
        points: metres; their own heights are ignored.
        origin: `(2,)` x and z of the grid's corner, metres.
        cell_m: side of a cell.
        heights: `(rows, columns)` at the centres of the cells, metres.
    """
    found = np.empty(len(points))
    last_row, last_column = heights.shape[0] - 1, heights.shape[1] - 1
    for k in range(len(points)):
        z = min(max((points[k, 2] - origin[1]) / cell_m - 0.5, 0.0), float(last_row))
        x = min(max((points[k, 0] - origin[0]) / cell_m - 0.5, 0.0), float(last_column))
        row, column = min(int(z), max(last_row - 1, 0)), min(int(x), max(last_column - 1, 0))
        row_after, column_after = min(row + 1, last_row), min(column + 1, last_column)
        up, across = z - row, x - column
        near = heights[row, column] * (1 - across) + heights[row, column_after] * across
        far = heights[row_after, column] * (1 - across) + heights[row_after, column_after] * across
        found[k] = near * (1 - up) + far * up
    return found
