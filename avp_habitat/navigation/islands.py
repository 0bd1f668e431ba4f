"""The navigable area from a navigation mesh: which of its islands, and on which floor."""

import warnings
from pathlib import Path
from typing import Any

import numpy as np

from avp_habitat.errors import SceneError
from avp_habitat.navigation.area import Float, NavigableArea, SurfaceBelow
from avp_habitat.navigation.build import area_in_outline
from avp_habitat.navigation.navmesh_file import read_navmesh
from avp_habitat.navigation.settings import NavigationSettings

_BELONGS = 0.85
_OPEN_TO_SKY_M = 0.5


def area_of_islands(islands: list[Float], surface_below: SurfaceBelow, bounds: Float) -> NavigableArea:
    """The area of the largest island that is not a roof.

    Args:
        islands: connected parts of a navigation mesh, each `(k, 3, 3)` corners of triangles in metres, world frame.
        surface_below: finds the scene's first surface straight below points, which come on few different heights.
        bounds: `(2, 3)` least and greatest corner of the scene's mesh, metres.

    Raises:
        SceneError: there is no island, it is smaller than one cell, or there is no floor below it.
    """
    if not islands:
        raise SceneError("the navigation mesh is empty: there is no floor on which an agent can stand")
    island = _main_island(islands, surface_below, float(bounds[1, 1]) + 1.0)
    return area_in_outline(island, surface_below, NavigationSettings(), bounds)


def area_of_file(path: Path, own: NavigableArea, surface_below: SurfaceBelow, bounds: Float) -> NavigableArea:
    """The area of a `.navmesh` file, when it is one of the open scene; a warning when it was made for another agent.

    Args:
        path: of the file.
        own: what was computed for the open scene.
        surface_below: as for `area_of_islands`.
        bounds: as for `area_of_islands`.

    Raises:
        SceneError: the file is no NavMesh, or one of another scene.
    """
    navmesh = read_navmesh(path)
    try:
        area = area_of_islands(navmesh.islands, surface_below, bounds)
    except SceneError as error:
        raise SceneError(f"{path}: is this the NavMesh of another scene? {error}") from error
    # A NavMesh for a wider agent lies within ours, one for a narrower agent around it.
    inside, around = own.contains(area.centres).mean(), area.contains(own.centres).mean()
    if max(inside, around) < _BELONGS:
        raise SceneError(
            f"{path}: is this the NavMesh of another scene? Only {100 * inside:.0f} % of its area is navigable in the "
            f"open one, and it holds {100 * around:.0f} % of that one's; expected {100 * _BELONGS:.0f} % of either"
        )
    _warn_of_another_agent(path, navmesh.agent)
    return area


def _warn_of_another_agent(path: Path, agent: dict[str, float]) -> None:
    settings = NavigationSettings()
    design = {
        "agent_radius": settings.agent_radius_m,
        "agent_height": settings.agent_height_m,
        "agent_max_climb": settings.max_climb_m,
        "agent_max_slope": settings.max_slope_deg,
    }
    other = {name: value for name, value in agent.items() if abs(value - design[name]) > 1e-4}
    if other:
        found = ", ".join(f"{name} {value:g} (ours: {design[name]:g})" for name, value in other.items())
        warnings.warn(f"{path}: made for another agent, so coverage is not comparable: {found}", stacklevel=3)


def _main_island(islands: list[Float], surface_below: SurfaceBelow, top: float) -> Float:
    """The largest island that is not a roof: open to the sky and over another island."""
    ordered = sorted(islands, key=lambda triangles: -_plan_area(triangles))
    for island in ordered:
        if not _is_roof(island, ordered, surface_below, top):
            return island
    return ordered[0]


def _is_roof(island: Float, islands: list[Float], surface_below: SurfaceBelow, top: float) -> bool:
    import shapely

    shape, height = _outline(island), island[..., 1].mean()
    beneath = [other for other in islands if other is not island and other[..., 1].mean() < height]
    if not any(_outline(other).intersection(shape).area > 0.5 * max(_plan_area(other), 1e-9) for other in beneath):
        return False
    centres = island.mean(axis=1)
    centres = centres[shapely.contains_xy(shape, centres[:, 0], centres[:, 2])]
    seen = np.asarray(surface_below(np.stack([centres[:, 0], np.full(len(centres), top), centres[:, 2]], axis=1)))
    return bool((np.abs(seen - centres[:, 1]) < _OPEN_TO_SKY_M).mean() >= 0.5) if len(centres) else False


def _outline(triangles: Float) -> Any:
    import shapely

    return shapely.union_all(shapely.buffer(shapely.polygons(triangles[:, :, [0, 2]]), 1e-3))


def _plan_area(triangles: Float) -> float:
    a, b, c = (triangles[:, i][:, [0, 2]] for i in range(3))
    return float(np.abs((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]).sum() / 2)
