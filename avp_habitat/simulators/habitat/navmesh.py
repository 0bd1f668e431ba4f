"""From Habitat-Sim's NavMesh to the navigable area, on the floor that its own renderer shows."""

import warnings
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from avp_habitat.errors import SceneError
from avp_habitat.navigation.area import Float, NavigableArea
from avp_habitat.navigation.build import area_in_outline
from avp_habitat.navigation.settings import NavigationSettings
from avp_habitat.poses import camera_to_world
from avp_habitat.simulators.habitat.engine import HabitatEngine, OverheadCamera

_TILE = OverheadCamera(pixels=1024, side_m=10.24)
"""One pixel a centimetre."""
_BELONGS = 0.85
_OPEN_TO_SKY_M = 0.5


def navmesh_area(engine: HabitatEngine, navmesh: Path | None) -> NavigableArea:
    """The largest island of the scene's NavMesh that is not a roof.

    Args:
        engine: with the scene open.
        navmesh: a `.navmesh` file instead of the one that is computed for the design's agent.

    Raises:
        SceneError: there is no floor, or the file is no NavMesh of this scene.
    """
    settings = NavigationSettings()
    engine.recompute_navmesh(settings)
    own = _area(engine, settings)
    return own if navmesh is None else _given(engine, navmesh, own, settings)


def _given(engine: HabitatEngine, path: Path, own: NavigableArea, settings: NavigationSettings) -> NavigableArea:
    agent = engine.load_navmesh(path)
    try:
        area = _area(engine, settings)
    except SceneError as error:
        raise SceneError(f"{path}: is this the NavMesh of another scene? The open one has no floor below it") from error
    # A NavMesh for a wider agent lies within ours, one for a narrower agent around it.
    inside, around = own.contains(area.centres).mean(), area.contains(own.centres).mean()
    if max(inside, around) < _BELONGS:
        raise SceneError(
            f"{path}: is this the NavMesh of another scene? Only {100 * inside:.0f} % of its area is navigable in the "
            f"open one, and it holds {100 * around:.0f} % of that one's; expected {100 * _BELONGS:.0f} % of either"
        )
    design = {
        "agent_radius": settings.agent_radius_m,
        "agent_height": settings.agent_height_m,
        "agent_max_climb": settings.max_climb_m,
        "agent_max_slope": settings.max_slope_deg,
    }
    other = {name: value for name, value in agent.items() if abs(value - design[name]) > 1e-4}
    if other:
        found = ", ".join(f"{name} {value:g} (ours: {design[name]:g})" for name, value in other.items())
        warnings.warn(f"{path}: made for another agent, so coverage is not comparable: {found}", stacklevel=2)
    return area


def _area(engine: HabitatEngine, settings: NavigationSettings) -> NavigableArea:
    def below(points: Float) -> NDArray[np.floating]:
        return surface_below(engine, points)

    return area_in_outline(_main_island(engine), below, settings, engine.bounds())


def _main_island(engine: HabitatEngine) -> NDArray[np.float64]:
    """`(k, 3, 3)` triangles of the largest island that is not a roof: open to the sky and over another island."""
    islands = sorted(engine.islands(), key=lambda triangles: -_plan_area(triangles))
    for island in islands:
        if not _is_roof(engine, island, islands):
            return island
    return islands[0]


def _is_roof(engine: HabitatEngine, island: Float, islands: list[Float]) -> bool:
    import shapely

    shape, height = _outline(island), island[..., 1].mean()
    beneath = [other for other in islands if other is not island and other[..., 1].mean() < height]
    if not any(_outline(other).intersection(shape).area > 0.5 * max(_plan_area(other), 1e-9) for other in beneath):
        return False
    centres = island.mean(axis=1)
    centres = centres[shapely.contains_xy(shape, centres[:, 0], centres[:, 2])]
    seen = surface_below(engine, np.stack([centres[:, 0], np.full(len(centres), _top(engine)), centres[:, 2]], axis=1))
    return bool((np.abs(seen - centres[:, 1]) < _OPEN_TO_SKY_M).mean() >= 0.5) if len(centres) else False


def _outline(triangles: Float):
    import shapely

    return shapely.union_all(shapely.buffer(shapely.polygons(triangles[:, :, [0, 2]]), 1e-3))


def _plan_area(triangles: Float) -> float:
    a, b, c = (triangles[:, i][:, [0, 2]] for i in range(3))
    return float(np.abs((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]).sum() / 2)


def _top(engine: HabitatEngine) -> float:
    return float(engine.bounds()[1, 1]) + 1.0


def surface_below(engine: HabitatEngine, points: Float) -> NDArray[np.float64]:
    """Height of the first surface straight below each point, as the renderer shows it: to a centimetre across.

    NavMesh heights are rounded up to whole voxels of 0.2 m, so the floor itself has to be asked for. A camera that
    looks down and is blind above the points sees all of the floor, also where furniture is cut open, because surfaces
    are not drawn from behind.

    Args:
        engine: with the scene open.
        points: `(n, 3)` metres, world frame; those of equal height are answered by the same pictures.

    Returns:
        `(n,)` y in metres, NaN where there is nothing below.
    """
    points = np.asarray(points, dtype=np.float64)
    found = np.full(len(points), np.nan)
    keys = np.floor(points[:, [0, 2]] / _TILE.side_m).astype(np.int64)
    groups = np.column_stack([keys, np.round(points[:, 1] * 1000).astype(np.int64)])
    tiles, member = np.unique(groups, axis=0, return_inverse=True)
    for number, tile in enumerate(tiles):
        rows = np.flatnonzero(member.reshape(-1) == number)
        found[rows] = _below_in_tile(engine, points[rows], tile[:2] * _TILE.side_m)
    return found


def _below_in_tile(engine: HabitatEngine, points: Float, corner: Float) -> NDArray[np.float64]:
    """Heights below `(k, 3)` points of one height within the tile whose least corner is x, z."""
    top = points[0, 1]
    middle = corner + _TILE.side_m / 2
    above = np.array([[middle[0], top + _TILE.distance_m, middle[1]]])
    # Looking straight down with yaw 0, columns run along +X and rows along +Z.
    below = engine.render_overhead(camera_to_world(above, yaw=np.zeros(1), pitch=np.full(1, -np.pi / 2))[0], _TILE)
    offset, depth = points[:, [2, 0]] - middle[::-1], np.zeros(len(points))
    for _ in range(2):
        # Rays spread a little below the cut plane: on a slope, the right one is known once the depth is.
        share = _TILE.distance_m / (_TILE.distance_m + np.nan_to_num(depth))
        at = np.floor((offset * share[:, None] / _TILE.side_m + 0.5) * _TILE.pixels).astype(np.int64)
        row, column = np.clip(at, 0, _TILE.pixels - 1).T
        depth = below[row, column]
    return top - depth
