"""From a triangle mesh to its navigable area: voxels, standing places, one part, its outline, its floor."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from avp_habitat.errors import SceneError
from avp_habitat.navigation.area import Float, NavigableArea, SurfaceBelow
from avp_habitat.navigation.filters import standing_places
from avp_habitat.navigation.heightfield import Heightfield, check_size, level_triangles, voxelise
from avp_habitat.navigation.parts import common_place, connected_parts, lay_flat, main_part, place_near
from avp_habitat.navigation.settings import NavigationSettings
from avp_habitat.navigation.walls import SKIN_M, are_inside, largest_piece, make_walls, off_walls, outline
from avp_habitat.scenes.mesh import TexturedMesh

_REACH_CELLS = 8
"""How far floor heights are continued beyond the navigable cells: farther than an outline lies from its cells."""


def build_area(
    mesh: TexturedMesh,
    surface_below: SurfaceBelow,
    *,
    start: NDArray[np.floating] | None = None,
    settings: NavigationSettings | None = None,
) -> NavigableArea:
    """The part of a mesh's floor on which an agent can stand, by Recast's rules as Habitat-Sim sets them.

    Args:
        mesh: metres, Y up; triangles may be wound either way round.
        surface_below: casts rays straight down on the same mesh; gives the floor's true height, which voxels round up.
        start: `(3,)` point in metres that selects the part nearest to it; without it the largest part is taken that is
            not a roof (open to the sky and over another part).
        settings: Habitat-Sim's defaults when left out.

    Raises:
        SceneError: no floor, or no place with room for an agent; the message names likely causes.
    """
    settings = settings or NavigationSettings()
    vertices, triangles = _used(mesh)
    check_size(vertices, settings)
    _check_floor(vertices, triangles, settings)
    field = voxelise(vertices, triangles, settings)
    places = standing_places(field, settings)
    part = connected_parts(places, settings.radius_voxels, settings.region_min_size**2)
    if not (part >= 0).any():
        raise SceneError(_no_place(vertices, settings))
    if start is None:
        seed = common_place(places, part, main_part(places, part))
    else:
        seed = place_near(places, part, field.shape[1], _voxel_of(start, field, settings))
    inside, floor = lay_flat(places, part, seed, field.shape)
    low = field.origin.astype(np.float64)
    rings = [low[[0, 2]] + ring * settings.voxel_m for ring in outline(inside, settings.edge_max_error)]
    if not rings:
        raise SceneError(_no_place(vertices, settings))
    # Centres of cells lie in the middle of voxels.
    stride, cell_m = settings.cell_voxels, settings.cell_voxels * settings.voxel_m
    origin = low[[0, 2]] + (settings.voxel_m - cell_m) / 2
    cells = _cells_within(rings, origin, [math.ceil(size / stride) for size in inside.shape], cell_m)
    voxel_floor = np.where(inside, low[1] + floor * settings.voxel_height_m, np.nan)
    above = continued(voxel_floor, _REACH_CELLS, np.fmax)[::stride, ::stride][cells.mask]
    top = np.nan_to_num(above, nan=float(np.nanmax(voxel_floor)))
    return _on_true_floor(cells, top, surface_below, settings, deepest_voxels=2 * settings.climb_voxels + 1)


def _used(mesh: TexturedMesh) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Vertices and triangles; vertices that no triangle uses do not widen the voxels' box."""
    if not len(mesh.triangles):
        raise SceneError("the scene's mesh has no triangles: expected a furnished room; is it a point cloud?")
    used = np.zeros(len(mesh.vertices), bool)
    used[mesh.triangles] = True
    vertices = np.ascontiguousarray(mesh.vertices[used], dtype=np.float32)
    if not np.isfinite(vertices).all():
        raise SceneError("the scene's mesh has vertices that are NaN or infinite: expected metres")
    number = np.cumsum(used, dtype=np.int64) - 1
    return vertices, np.ascontiguousarray(number[mesh.triangles], dtype=np.int32)


def _check_floor(vertices: NDArray[np.float32], triangles: NDArray[np.int32], settings: NavigationSettings) -> None:
    if level_triangles(vertices, triangles, settings.max_slope_deg).any():
        return
    raise SceneError(
        f"the scene has no floor: none of its {len(triangles)} triangles lies within {settings.max_slope_deg:g}° of "
        "level; is the mesh Z-up instead of Y-up?"
    )


def _no_place(vertices: NDArray[np.float32], settings: NavigationSettings) -> str:
    size = vertices.max(axis=0) - vertices.min(axis=0)
    least = settings.region_min_size**2 * settings.voxel_m**2
    return (
        f"no agent can stand in the scene, which measures {size[0]:.3g} x {size[1]:.3g} x {size[2]:.3g} m (x, y, z): "
        f"expected {least:g} m² of connected floor with {settings.height_voxels * settings.voxel_height_m:g} m of free "
        "height; is it not in metres, Z-up instead of Y-up, or the ceiling lower "
        f"than {settings.agent_height_m:g} m?"
    )


def _voxel_of(point: NDArray, field: Heightfield, settings: NavigationSettings) -> tuple[float, float, float]:
    """Row, column and level of a `(3,)` point in metres."""
    x, y, z = np.asarray(point, dtype=np.float64) - field.origin
    return z // settings.voxel_m, x // settings.voxel_m, y / settings.voxel_height_m


def area_in_outline(
    triangles: Float, surface_below: SurfaceBelow, settings: NavigationSettings, bounds: Float
) -> NavigableArea:
    """The navigable area of a navigation mesh that was made elsewhere, on the scene's true floor.

    Args:
        triangles: `(k, 3, 3)` corners in metres, world frame, of one connected navigation mesh; heights may lie above
            the floor by what their maker rounded up.
        surface_below: finds the scene's first surface straight below points, which come on few different heights.
        settings: of the cells.
        bounds: `(2, 3)` least and greatest corner of the scene's mesh, metres: cells lie where `build_area` lays them.

    Raises:
        SceneError: the mesh is smaller than one cell, or no ray meets the floor.
    """
    import shapely

    shapes = np.asarray(shapely.polygons(triangles[:, :, [0, 2]]))
    # Neighbours share corners only up to rounding; a seam would cut the area in two.
    rings = largest_piece(shapely.union_all(shapely.buffer(shapes, SKIN_M, join_style="mitre")))
    cell_m = settings.cell_voxels * settings.voxel_m
    cells = _cells_within(rings, *_grid_over(rings[0], bounds, cell_m, settings.voxel_m), cell_m)
    floor = _height_on(triangles, shapes, cells.centres)
    # On half voxels, so that a slope is asked about on few heights.
    step = settings.voxel_height_m / 2
    top = np.ceil(floor / step - 1e-6) * step
    # A navigation mesh follows the floor's outline; across a slope its few corners leave it well above the floor.
    return _on_true_floor(cells, top, surface_below, settings, deepest_voxels=settings.height_voxels)


def _grid_over(outer: Float, bounds: Float, cell_m: float, voxel_m: float) -> tuple[Float, NDArray[np.int64]]:
    """Least corner x, z of the cells over an outline and the scene, and how many rows and columns there are."""
    low, high = outer.min(axis=0), outer.max(axis=0)
    origin = bounds[0, [0, 2]] + (voxel_m - cell_m) / 2
    # Recast rounds the number of voxels.
    voxels = np.floor((bounds[1] - bounds[0])[[0, 2]] / voxel_m + 0.5)
    cells = np.ceil(voxels * voxel_m / cell_m - 1e-6).astype(np.int64)
    # A mesh of another scene may lie beside this one.
    before = np.maximum(np.ceil((origin - low) / cell_m - 1e-6), 0).astype(np.int64)
    after = np.maximum(np.ceil((high - origin) / cell_m - 1e-6).astype(np.int64), cells)
    return origin - before * cell_m, (before + after)[::-1]


def _height_on(triangles: Float, shapes: NDArray, points: Float) -> Float:
    """`(n,)` heights of `(k, 3, 3)` triangles, seen from above as `shapes`, at the `(n, 2)` points next to them."""
    import shapely

    at = shapely.STRtree(shapes).nearest(shapely.points(points))
    a, b, c = (triangles[at, corner] for corner in range(3))
    ab, ac, ap = (b - a)[:, [0, 2]], (c - a)[:, [0, 2]], points - a[:, [0, 2]]
    doubled = ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0]
    doubled = np.where(np.abs(doubled) > 1e-12, doubled, np.inf)
    right = (ap[:, 0] * ac[:, 1] - ap[:, 1] * ac[:, 0]) / doubled
    up = (ab[:, 0] * ap[:, 1] - ab[:, 1] * ap[:, 0]) / doubled
    return a[:, 1] + right * (b - a)[:, 1] + up * (c - a)[:, 1]


class _Cells(NamedTuple):
    """The navigable cells within an outline."""

    rings: list[Float]
    cell_m: float
    origin: Float
    """`(2,)` x and z of the least corner."""
    mask: NDArray[np.bool_]
    """`(rows, columns)`; True where the centre is inside and not on a wall, where an agent could not stand."""
    centres: Float
    """`(m, 2)` x and z of the navigable ones."""


def _cells_within(rings: list[Float], origin: Float, shape: Sequence[int] | NDArray, cell_m: float) -> _Cells:
    rows, columns = shape
    x = origin[0] + (np.arange(columns) + 0.5) * cell_m
    z = origin[1] + (np.arange(rows) + 0.5) * cell_m
    points, walls = np.stack(np.meshgrid(x, z), axis=-1).reshape(-1, 2), make_walls(rings)
    navigable = are_inside(walls, points) & (off_walls(walls, points) == points).all(axis=1)
    if not navigable.any():
        raise SceneError(f"the navigable area is smaller than one cell of {cell_m:g} m; is the scene not in metres?")
    return _Cells(rings, cell_m, origin, navigable.reshape(rows, columns), points[navigable])


def _on_true_floor(
    cells: _Cells, floor: Float, surface_below: SurfaceBelow, settings: NavigationSettings, *, deepest_voxels: int
) -> NavigableArea:
    """The area whose navigable cells have these `(m,)` floor heights, each made true by a ray from a step above.

    What is seen farther below than `deepest_voxels` is not this floor.
    """
    top = floor + settings.climb_voxels * settings.voxel_height_m
    x, z = cells.centres.T
    found = np.asarray(surface_below(np.stack([x, top, z], axis=1)), dtype=np.float64)
    deepest = deepest_voxels * settings.voxel_height_m + SKIN_M
    heights = np.full(cells.mask.shape, np.nan)
    heights[cells.mask] = np.where((top - found >= 0) & (top - found <= deepest), found, np.nan)
    if not np.isfinite(heights).any():
        raise SceneError("no ray meets the floor below the navigable cells: the mesh and its ray caster disagree")
    heights = continued(heights, _REACH_CELLS, np.fmin)
    heights = np.where(np.isfinite(heights), heights, np.nanmedian(heights))
    return NavigableArea(cells.cell_m, cells.origin, cells.mask, heights, tuple(cells.rings))


def continued(heights: Float, reach: int, choose: np.ufunc) -> Float:
    """Fill NaN pixels from their four neighbours, ring by ring.

    Args:
        heights: `(rows, columns)`, NaN where unknown.
        reach: how many pixels far.
        choose: which of the neighbours' values wins, `np.fmin` or `np.fmax`.
    """
    heights = heights.copy()
    for _ in range(reach):
        padded = np.pad(heights, 1, constant_values=np.nan)
        best = choose(choose(padded[:-2, 1:-1], padded[2:, 1:-1]), choose(padded[1:-1, :-2], padded[1:-1, 2:]))
        heights = np.where(np.isnan(heights), best, heights)
    return heights
