"""What a planner remembers of its episode: where it stood, and which floor it looked at in vain."""

import numpy as np
from numpy.typing import NDArray

from avp_habitat.agent_view import AgentView
from avp_habitat.baselines.known_map import FREE, UNKNOWN, KnownMap, known_map
from avp_habitat.baselines.sight import in_view, make_lens


class Memory:
    """Of one agent within one episode."""

    def __init__(self) -> None:
        """Remember nothing."""
        self._stood = np.empty((0, 3))
        self._misses = np.zeros((0, 0), dtype=np.uint8)
        self._first = np.zeros(2, dtype=np.int64)

    def update(self, view: AgentView) -> tuple[KnownMap, NDArray[np.uint8]]:
        """Take in the newest view; call it once per step.

        Returns:
            The map, and `(rows, columns)` how many views should have observed a cell that is still not observed:
            something stands there or hides it.
        """
        self._stood = np.concatenate([self._stood, view.position[None]])
        known = known_map(view, self._stood)
        misses = np.zeros_like(known.state)
        row, column = np.maximum(self._first - known.first, 0)
        height, width = self._misses.shape
        misses[row : row + height, column : column + width] = self._misses
        if view.steps:
            missed = _should_see(view, known)
            misses[tuple(missed.T)] = np.minimum(misses[tuple(missed.T)], 254) + 1
        self._misses, self._first = misses, known.first
        return known, misses


def _should_see(view: AgentView, known: KnownMap) -> NDArray[np.int64]:
    """`(k, 2)` cells not observed that the newest view should have shown."""
    cells = np.argwhere((known.state == FREE) | (known.state == UNKNOWN))
    row, column = known.at(view.position)
    lens = make_lens(view.settings, known.cell_m)
    return cells[in_view(known.state, cells, row, column, view.yaw, view.pitch, lens)]
