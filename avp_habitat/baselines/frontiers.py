"""Frontiers of a known map: where observed floor ends and unobserved floor begins (Yamauchi 1997)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from avp_habitat.baselines.known_map import FREE, OBSERVED, KnownMap

LEAST_CELLS = 3
"""Smaller frontiers are ignored."""
TRIES = 8
"""After this many views that should have observed a navigable cell, planners take it for hidden."""

_EIGHT = np.ones((3, 3), dtype=np.bool_)


@dataclass(frozen=True)
class Frontier:
    """A connected group of observed cells that have an unobserved navigable neighbour."""

    cells: NDArray[np.int64]
    """`(k, 2)` rows and columns of the known map."""
    edge: NDArray[np.int64]
    """`(j, 2)` the unobserved neighbours."""


def find_frontiers(known: KnownMap, misses: NDArray[np.uint8]) -> list[Frontier]:
    """The frontiers of a map, in the order of their first cells.

    Args:
        known: the map.
        misses: `(rows, columns)` views that should have observed a cell which is still not observed.
    """
    from scipy.ndimage import binary_dilation, label

    unobserved = (known.state == FREE) & (misses < TRIES)
    beside = binary_dilation(unobserved, _EIGHT) & (known.state == OBSERVED)
    groups, _ = label(beside, _EIGHT)  # type: ignore[misc]
    found = []
    for number in range(1, int(groups.max(initial=0)) + 1):
        group = groups == number
        if np.count_nonzero(group) >= LEAST_CELLS:
            edge = unobserved & binary_dilation(group, _EIGHT)
            found.append(Frontier(np.argwhere(group), np.argwhere(edge)))
    return found
