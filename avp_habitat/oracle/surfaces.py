"""Points all over what can be seen in a scene: walls, furniture, ceiling."""

import numpy as np
from numpy.typing import NDArray

from avp_habitat.settings import TaskSettings
from avp_habitat.simulators.base import Simulator
from avp_habitat.surfaces import views_all_over

SPACING_M = 0.4
"""One point for each cube of this edge that holds some surface, metres."""
SURFACE_RANGE_M = 4.0
"""A surface counts as seen from this near, metres: from farther off its texture is too coarse to reconstruct."""
_FLOOR_M = 0.05
"""Surfaces this close above or below the walkable floor are the floor, which has points of its own."""


def surface_points(simulator: Simulator, settings: TaskSettings) -> NDArray[np.float64]:
    """`(k, 3)` points on the surfaces seen from all over the floor, without the floor itself, metres.

    Args:
        simulator: of the scene.
        settings: of the task: sensor height and range.
    """
    seen = []
    for view in views_all_over(simulator, settings):
        points = view.points[view.hit]
        seen.append(_thinned(points[np.abs(points[:, 1] - view.place[1]) > _FLOOR_M]))
    return np.asarray(_thinned(np.concatenate(seen)), dtype=np.float64)


def _thinned(points: NDArray[np.floating]) -> NDArray[np.floating]:
    """The first of `(n, 3)` points in every cube."""
    _, first = np.unique(np.floor(points / SPACING_M).astype(np.int64), axis=0, return_index=True)
    return points[np.sort(first)]
