"""What an agent knows of the floor, as a grid, and the walks over it."""

import heapq
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from avp_habitat.compiled import njit
from avp_habitat.task.agent_view import AgentView

UNKNOWN, FREE, OBSERVED, BLOCKED = range(4)
"""FREE: navigable as far as known, but not observed yet. OBSERVED: navigable and observed. BLOCKED: not navigable."""
BODY_M = 0.3
"""An agent knows the floor this far around every place where it has stood, metres."""
MARGIN_M = 2.0
"""Unknown floor kept around the known floor, metres."""

_NEIGHBOURS = np.array([(row, column) for row in (-1, 0, 1) for column in (-1, 0, 1)])


@dataclass(frozen=True)
class KnownMap:
    """A grid over the known floor with a margin around it; rows along +Z, columns along +X, as in `NavigableArea`."""

    state: NDArray[np.uint8]
    """`(rows, columns)` UNKNOWN, FREE, OBSERVED or BLOCKED."""
    first: NDArray[np.int64]
    """`(2,)` row and column of cell (0, 0) in the scene's grid."""
    cell_m: float
    """Side of a cell in metres."""
    corner: NDArray[np.float64]
    """`(2,)` z and x of the least corner of cell (0, 0), metres."""

    @property
    def navigable(self) -> NDArray[np.bool_]:
        """`(rows, columns)` cells known to be navigable."""
        return (self.state == FREE) | (self.state == OBSERVED)

    def at(self, point: NDArray[np.floating]) -> NDArray[np.float64]:
        """`(2,)` row and column of a `(3,)` point in metres, in cells; a cell's centre lies at +0.5."""
        return (np.asarray(point)[[2, 0]] - self.corner) / self.cell_m


def known_map(view: AgentView, stood: NDArray[np.float64]) -> KnownMap:
    """What an agent that has stood at `(k, 3)` places in metres knows about the floor.

    An observed cell is navigable, and the depth image around its floor point shows which of its 8 neighbours are;
    around its own body the agent knows the cells within `BODY_M`. Nothing else of the scene is read: the grid's size
    follows from these cells too.
    """
    area = view.area
    observed = area.cell_of(area.centres[view.observed])
    body = _around(area.cell_of(stood), BODY_M / area.cell_m)
    known = np.concatenate([(observed[:, None] + _NEIGHBOURS).reshape(-1, 2), body])
    margin = int(np.ceil(MARGIN_M / area.cell_m))
    first = known.min(axis=0) - margin
    state = np.full(known.max(axis=0) + margin + 1 - first, UNKNOWN, dtype=np.uint8)
    inside = ((known >= 0) & (known < area.mask.shape)).all(axis=1)
    navigable = np.zeros(len(known), dtype=np.bool_)
    navigable[inside] = area.mask[tuple(known[inside].T)]
    state[tuple((known - first).T)] = np.where(navigable, FREE, BLOCKED)
    state[tuple((observed - first).T)] = OBSERVED
    return KnownMap(state, first, area.cell_m, area.origin[::-1] + first * area.cell_m)


def _around(cells: NDArray[np.int64], radius: float) -> NDArray[np.int64]:
    """`(k, 2)` cells whose centres lie within a radius, in cells, of the centres of other cells."""
    reach = int(radius)
    offsets = np.argwhere(np.ones((2 * reach + 1,) * 2)) - reach
    offsets = offsets[np.hypot(*offsets.T) <= radius + 1e-9]
    return (np.unique(cells, axis=0)[:, None] + offsets).reshape(-1, 2)


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
def shortest_walks(navigable, start_row, start_column):
    """Dijkstra over 8-connected cells `(rows, columns)`, without cutting corners; the start need not be navigable.

    Returns:
        `(rows, columns)` lengths in cells, inf where unreachable, and the flat index of the cell before, -1 for none.
    """
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
