"""The navigable area from a navigation mesh: which of its islands, and on which floor."""

import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avp_habitat.errors import SceneError, did_you_mean
from avp_habitat.navigation.area import Float, NavigableArea, SurfaceBelow
from avp_habitat.navigation.build import area_in_outline
from avp_habitat.navigation.settings import NavigationSettings

# The file as Habitat-Sim writes it, and Detour 7's structures of its one tile (DetourNavMesh.h).
_OF_AGENT = ("agent_height", "agent_radius", "agent_max_climb", "agent_max_slope")
_COUNTS = ("polys", "vertices", "links", "details", "detail_vertices", "detail_triangles", "boxes", "connections")
_SET = np.dtype([("magic", "S4"), ("version", "<i4"), ("tiles", "<i4"), ("place", "<f4", 5), ("most", "<i4", 2)])
_SETTINGS = np.dtype(
    [("voxel", "<f4", 2), *((name, "<f4") for name in _OF_AGENT), ("others", "<f4", 7), ("filters", "u1", 4)]
)
_TILE = np.dtype([("reference", "<u4"), ("bytes", "<i4")])
_HEADER = np.dtype(
    [
        *(("magic", "S4"), ("version", "<i4"), ("place", "<i4", 4)),
        *((name, "<i4") for name in _COUNTS),
        *(("first_connection", "<i4"), ("agent_and_bounds", "<f4", 10)),
    ]
)
_POLY = np.dtype(
    [("link", "<u4"), ("corners", "<u2", 6), ("beside", "<u2", 6), ("flags", "<u2"), ("count", "u1"), ("kind", "u1")]
)
_LINK, _POSITION, _CORNERS = np.dtype("V12"), np.dtype(("<f4", 3)), np.dtype(("u1", 4))
_DETAIL = np.dtype(
    [("vertex", "<u4"), ("triangle", "<u4"), ("vertices", "u1"), ("triangles", "u1"), ("unused", "u1", 2)]
)
_FAR_M = 1e6


@dataclass(frozen=True)
class NavMesh:
    """A navigation mesh."""

    islands: list[NDArray[np.float64]]
    """Its connected parts, each `(k, 3, 3)` corners of triangles in metres, world frame."""
    agent: dict[str, float]
    """Of the agent that it was made for: `agent_height`, `agent_radius` and `agent_max_climb` in metres,
    `agent_max_slope` in degrees; empty where the file does not say."""


def read_navmesh(path: Path) -> NavMesh:
    """Read a NavMesh file; takes milliseconds.

    Raises:
        SceneError: it cannot be read, or is not what Habitat-Sim or Recast writes.
    """
    if not path.is_file():
        names = (entry.name for entry in path.parent.glob("*.navmesh") if entry.is_file())
        raise SceneError(f"{path}: no such NavMesh file (.navmesh){did_you_mean(path.name, names)}")
    try:
        content = _Content(path.read_bytes())
        agent = _agent(content)
        return NavMesh(_islands(content), agent)
    except OSError as error:
        raise SceneError(f"{path}: cannot be read: {error.strerror}") from error
    except (ValueError, IndexError) as error:
        raise SceneError(
            f"{path}: expected a NavMesh as Habitat-Sim writes it (.navmesh), but {error}; is it damaged?"
        ) from error


class _Content:
    """Bytes that are taken one structure after the other; ValueError where they end too early."""

    def __init__(self, content: bytes) -> None:
        self._content, self._at = content, 0

    @property
    def left(self) -> int:
        return len(self._content) - self._at

    def take(self, kind: np.dtype, count: int = 1) -> NDArray:
        if not 0 <= count * kind.itemsize <= self.left:
            raise ValueError(f"it ends after {len(self._content)} bytes")
        found = np.frombuffer(self._content, kind, count, self._at)
        self._at += count * kind.itemsize
        return found

    def positions(self, count: int) -> NDArray[np.float64]:
        found = self.take(_POSITION, count).astype(np.float64)
        if not (np.abs(found) < _FAR_M).all():
            raise ValueError("a position cannot be right")
        return found


def _agent(content: _Content) -> dict[str, float]:
    start = content.take(_SET)[0]
    if start["magic"] != b"TESM" or start["version"] not in (1, 2) or start["tiles"] != 1:
        raise ValueError("it does not begin as one of a single tile")
    settings = content.take(_SETTINGS)[0] if start["version"] == 2 else None
    return {} if settings is None else {name: float(settings[name]) for name in _OF_AGENT}


def _islands(content: _Content) -> list[NDArray[np.float64]]:
    size = int(content.take(_TILE)[0]["bytes"])
    if size != content.left:
        raise ValueError(f"its tile has {content.left} bytes where {size} are said")
    header = content.take(_HEADER)[0]
    if header["magic"] != b"VAND" or header["version"] != 7 or header["details"] != header["polys"]:
        raise ValueError("its tile does not begin as one of Detour 7")
    vertices = content.positions(int(header["vertices"]))
    polygons = content.take(_POLY, int(header["polys"]))
    content.take(_LINK, int(header["links"]))
    details = content.take(_DETAIL, len(polygons))
    more = content.positions(int(header["detail_vertices"]))
    corners = content.take(_CORNERS, int(header["detail_triangles"]))[:, :3].astype(np.int64)
    triangles, owner = _triangles(polygons, details, corners, vertices, more)
    island = _connected(polygons)
    walkable = np.unique(island[polygons["flags"] != 0])
    return [triangles[island[owner] == number] for number in walkable]


def _triangles(
    polygons: NDArray, details: NDArray, corners: NDArray, vertices: NDArray, more: NDArray
) -> tuple[NDArray, NDArray]:
    """`(k, 3, 3)` corners of all triangles, and the `(k,)` polygons that they are part of."""
    own = details["triangles"].astype(np.int64)
    owner = np.repeat(np.arange(len(polygons)), own)
    first = np.cumsum(own) - own
    corner = corners[details["triangle"].astype(np.int64)[owner] + np.arange(len(owner)) - first[owner]]
    # A corner's number goes through the polygon's own corners first, and then through its detail vertices.
    count = polygons["count"].astype(np.int64)[owner, None]
    of_polygon = polygons["corners"].astype(np.int64)[owner[:, None], np.minimum(corner, count - 1)]
    of_details = len(vertices) + details["vertex"].astype(np.int64)[owner, None] + np.maximum(corner - count, 0)
    return np.concatenate([vertices, more])[np.where(corner < count, of_polygon, of_details)], owner


def _connected(polygons: NDArray) -> NDArray[np.integer]:
    """`(n,)` number of the connected part that each polygon is in."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    used = (np.arange(6) < polygons["count"][:, None]) & (polygons["beside"] > 0)
    begin, side = np.nonzero(used)
    # Neighbours are numbered from 1; 0 is a wall.
    end = polygons["beside"][begin, side].astype(np.int64) - 1
    size = len(polygons)
    return connected_components(coo_matrix((np.ones(len(begin)), (begin, end)), (size, size)), directed=False)[1]


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
