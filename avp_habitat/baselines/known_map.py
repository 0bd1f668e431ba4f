"""The floor as one agent knows it: a grid of what its views and its own steps have shown."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from avp_habitat.agent_view import AgentView

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
    """What an agent knows about the floor.

    An observed cell is navigable, and the depth image around its floor point shows which of its 8 neighbours are;
    around its own body the agent knows the cells within `BODY_M`. Nothing else of the scene is read: the grid's size
    follows from these cells too.

    Args:
        view: the agent.
        stood: `(k, 3)` where it has stood in this episode, metres.
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
