"""Shortest walks over the cells that an agent knows to be navigable."""

import heapq

import numpy as np
from numpy.typing import NDArray

from avp_habitat.compiled import njit


def shortest_walks(
    navigable: NDArray[np.bool_], start: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Dijkstra over 8-connected cells, without cutting corners.

    Args:
        navigable: `(rows, columns)`.
        start: `(2,)` row and column; it need not be navigable.

    Returns:
        `(rows, columns)` lengths in cells, inf where unreachable, and the flat index of the cell before, -1 for none.
    """
    return _shortest_walks(navigable, int(start[0]), int(start[1]))


def route_to(before: NDArray[np.int64], goal: NDArray[np.int64]) -> NDArray[np.int64]:
    """`(k, 2)` cells from the start, which is left out, to a reachable goal `(2,)`."""
    columns = before.shape[1]
    at = int(goal[0]) * columns + int(goal[1])
    cells = []
    while before.flat[at] >= 0:
        cells.append(divmod(at, columns))
        at = int(before.flat[at])
    return np.array(cells[::-1], dtype=np.int64).reshape(-1, 2)


def farthest_straight(
    navigable: NDArray[np.bool_], at: NDArray[np.float64], route: NDArray[np.int64]
) -> NDArray[np.float64]:
    """`(2,)` centre of the last cell of a route `(k, 2)`, k > 0, to which a straight walk stays in navigable cells."""
    for cell in route[::-1]:
        if walkable(navigable, at[0], at[1], cell[0] + 0.5, cell[1] + 0.5):
            return cell + 0.5
    return route[0] + 0.5


@njit(cache=True)
def walkable(cells, row, column, to_row, to_column):
    """Whether a straight walk between two points of the grid stays in the true cells `(rows, columns)`.

    The cell in which it begins is not asked; the walk is sampled twice per cell of the longer axis.
    """
    steps = int(np.ceil(2.0 * max(abs(to_row - row), abs(to_column - column))))
    for i in range(1, steps + 1):
        r, c = int(row + (to_row - row) * i / steps), int(column + (to_column - column) * i / steps)
        if (r != int(row) or c != int(column)) and not cells[r, c]:
            return False
    return True


@njit(cache=True)
def _shortest_walks(navigable, start_row, start_column):
    rows, columns = navigable.shape
    length = np.full((rows, columns), np.inf)
    before = np.full((rows, columns), -1, np.int64)
    length[start_row, start_column] = 0.0
    queue = [(0.0, start_row * columns + start_column)]
    while queue:
        so_far, at = heapq.heappop(queue)
        row, column = at // columns, at % columns
        if so_far > length[row, column]:
            continue
        for dr in range(-1, 2):
            for dc in range(-1, 2):
                r, c = row + dr, column + dc
                if r < 0 or c < 0 or r >= rows or c >= columns or not navigable[r, c]:
                    continue
                if dr != 0 and dc != 0 and not (navigable[row, c] and navigable[r, column]):
                    continue
                total = so_far + np.sqrt(float(dr * dr + dc * dc))
                if total < length[r, c] - 1e-9:
                    length[r, c] = total
                    before[r, c] = at
                    heapq.heappush(queue, (total, r * columns + c))
    return length, before
