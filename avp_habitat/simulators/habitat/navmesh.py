"""From Habitat-Sim's NavMesh to the navigable area, on the floor that its own renderer shows."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from avp_habitat.navigation.area import Float, NavigableArea
from avp_habitat.navigation.islands import area_of_file, area_of_islands
from avp_habitat.navigation.settings import NavigationSettings
from avp_habitat.poses import camera_to_world
from avp_habitat.simulators.habitat.engine import HabitatEngine, OverheadCamera

_TILE = OverheadCamera(pixels=1024, side_m=10.24)
"""One pixel a centimetre."""


def navmesh_area(engine: HabitatEngine, navmesh: Path | None) -> NavigableArea:
    """The largest island of the scene's NavMesh that is not a roof.

    Args:
        engine: with the scene open.
        navmesh: a `.navmesh` file instead of the one that is computed for the design's agent.

    Raises:
        SceneError: there is no floor, or the file is no NavMesh of this scene.
    """

    def below(points: Float) -> NDArray[np.floating]:
        return surface_below(engine, points)

    engine.recompute_navmesh(NavigationSettings())
    own = area_of_islands(engine.islands(), below, engine.bounds())
    return own if navmesh is None else area_of_file(navmesh, own, below, engine.bounds())


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
