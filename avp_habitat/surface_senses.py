"""How much better the newest views show the surface of a scene than all views before them, by casting rays."""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from avp_habitat.coverage import candidates
from avp_habitat.senses import Views
from avp_habitat.settings import TaskSettings
from avp_habitat.simulators.base import Simulator
from avp_habitat.surfaces import scene_surface, view_quality


class SurfaceSenses(Protocol):
    """Perceives how well the views of agents in one scene show its surface."""

    def capture(self, views: Views, quality: NDArray[np.float32], rows: NDArray[np.integer]) -> NDArray[np.float64]:
        """Raise the quality of the points that the views show better, in place.

        Args:
            views: of k agents.
            quality: `(n, m)` how well each surface point was seen so far, 0 for never.
            rows: `(k,)` the agents' rows of it.

        Returns:
            `(k,)` by how much the qualities grew in sum.
        """
        ...


class CastSurface:
    """The definition itself: a ray to every point inside the image that the view would show better than before."""

    def __init__(self, simulator: Simulator, settings: TaskSettings) -> None:
        """Use a simulator's rays."""
        self._simulator = simulator
        self._settings = settings
        self._surface = scene_surface(simulator, settings)

    def capture(self, views: Views, quality: NDArray[np.float32], rows: NDArray[np.integer]) -> NDArray[np.float64]:
        """See `SurfaceSenses`."""
        settings, surface = self._settings, self._surface
        eye = views.camera_to_world[:, None, :3, 3]
        found = view_quality(eye, surface.points[None], surface.normals[None]).astype(np.float32)
        better, reach = found > quality[rows], settings.max_range_m
        pose, camera = views.camera_to_world, settings.intrinsics
        pairs = candidates(pose, camera, surface.points, better, max_range_m=reach)
        reached = self._simulator.visible(pose, camera, surface.points, pairs, tolerance_m=settings.tolerance_m)
        agent, point = pairs[reached].T
        return raise_quality(quality, rows, agent, point, found[agent, point])


def raise_quality(
    quality: NDArray[np.float32],
    rows: NDArray[np.integer],
    agent: NDArray[np.integer],
    point: NDArray[np.integer],
    value: NDArray[np.float32],
) -> NDArray[np.float64]:
    """Enter greater qualities.

    Args:
        quality: `(n, m)`, changed in place.
        rows: `(k,)` the agents' rows of it.
        agent: `(p,)` indices into `rows`.
        point: `(p,)`, each pair (agent, point) at most once.
        value: `(p,)` greater than what is there.

    Returns:
        `(k,)` sums of the growth.
    """
    at = np.asarray(rows)[agent], point
    growth = (value - quality[at]).astype(np.float64)
    grown = np.bincount(agent, weights=growth, minlength=len(rows)).astype(np.float64)
    quality[at] = value
    return grown


def make_surface_senses(simulator: Simulator, settings: TaskSettings) -> SurfaceSenses:
    """The senses that the settings ask for.

    Raises:
        UsageError: tables are asked for where they cannot be made, or the scene shows no surface.
    """
    if settings.lookup:
        from avp_habitat.lookup.surface import TableSurface

        return TableSurface(simulator, settings)
    return CastSurface(simulator, settings)
