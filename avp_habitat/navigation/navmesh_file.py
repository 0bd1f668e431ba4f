"""Reads a `.navmesh` file, the NavMesh of a scene as Habitat-Sim keeps it, and finds out whether it is whole.

Habitat-Sim itself checks so little of one that a damaged one ends the process. The file is what Recast's samples write:
a header, in version 2 Habitat-Sim's settings, then tiles as Detour keeps them in memory (DetourNavMesh.h, with
references of 32 bits): a header, vertices, polygons, room for links, detail meshes with vertices and triangles, a tree
of boxes, off-mesh connections. Habitat-Sim writes one tile and none of the latter.
"""

import difflib
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

import numpy as np
from numpy.typing import NDArray

from avp_habitat.errors import SceneError

_SET = np.dtype(
    [
        ("magic", "S4"),
        ("version", "<i4"),
        ("tiles", "<i4"),
        ("place", "<f4", 5),
        ("most_tiles", "<i4"),
        ("polys", "<i4"),
    ]
)
_SETTINGS = np.dtype(
    [
        *((name, "<f4") for name in ("cell_size", "cell_height")),
        *((name, "<f4") for name in ("agent_height", "agent_radius", "agent_max_climb", "agent_max_slope")),
        *((name, "<f4") for name in ("region_min_size", "region_merge_size", "edge_max_len", "edge_max_error")),
        *((name, "<f4") for name in ("verts_per_poly", "detail_sample_dist", "detail_sample_max_error")),
        ("filters", "u1", 4),
    ]
)
_VERSIONS = (1, 2)
_OF_AGENT = ("agent_height", "agent_radius", "agent_max_climb", "agent_max_slope")
_TILE = np.dtype([("reference", "<u4"), ("bytes", "<i4")])
_HEADER = np.dtype(
    [
        ("magic", "S4"),
        ("version", "<i4"),
        ("place", "<i4", 3),
        ("user", "<u4"),
        ("polys", "<i4"),
        ("vertices", "<i4"),
        ("links", "<i4"),
        ("details", "<i4"),
        ("detail_vertices", "<i4"),
        ("detail_triangles", "<i4"),
        ("boxes", "<i4"),
        ("connections", "<i4"),
        ("first_connection", "<i4"),
        ("agent", "<f4", 3),
        ("bounds", "<f4", (2, 3)),
        ("quantum", "<f4"),
    ]
)
_POLY = np.dtype(
    [("link", "<u4"), ("corners", "<u2", 6), ("beside", "<u2", 6), ("flags", "<u2"), ("count", "u1"), ("kind", "u1")]
)
_LINK_BYTES = 12
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
        names = sorted(entry.name for entry in path.parent.glob("*.navmesh") if entry.is_file())
        near = difflib.get_close_matches(path.name, names, n=1, cutoff=0.5)
        hint = f"; did you mean {near[0]}?" if near else ""
        raise SceneError(f"{path}: no such NavMesh file (.navmesh){hint}")
    try:
        content = path.read_bytes()
    except OSError as error:
        raise SceneError(f"{path}: cannot be read: {error.strerror}") from error
    return _Reader(path, content).read()


class _Reader:
    def __init__(self, path: Path, content: bytes) -> None:
        self._path, self._content, self._at = path, content, 0

    def read(self) -> NavMesh:
        header = self._take(_SET, 1)[0]
        if header["magic"] != b"TESM" or int(header["version"]) not in _VERSIONS:
            self._fail("it does not begin as one")
        agent = {}
        if int(header["version"]) == 2:
            settings = self._take(_SETTINGS, 1)[0]
            agent = {name: float(settings[name]) for name in _OF_AGENT}
        self._expect(header["tiles"] == 1, f"its number of tiles, {header['tiles']} where Habitat-Sim writes 1,")
        tile = self._take(_TILE, 1)[0]
        self._expect(self._at + int(tile["bytes"]) == len(self._content), "its size")
        return NavMesh(self._islands(), agent)

    def _islands(self) -> list[NDArray[np.float64]]:
        header = self._take(_HEADER, 1)[0]
        if header["magic"] != b"VAND" or header["version"] != 7:
            self._fail("its tile does not begin as one of Detour 7")
        self._expect(header["details"] == header["polys"] and header["connections"] == 0, "its counts")
        vertices = self._positions(int(header["vertices"]))
        polygons = self._take(_POLY, int(header["polys"]))
        self._check_polygons(polygons, len(vertices))
        self._take(np.dtype("u1"), _LINK_BYTES * int(header["links"]))
        triangles, owner = self._triangles(header, polygons, vertices)
        island = _connected(polygons)
        walkable = np.unique(island[polygons["flags"] != 0])
        return [triangles[island[owner] == number] for number in walkable]

    def _positions(self, count: int) -> NDArray[np.float64]:
        found = self._take(np.dtype("<f4"), 3 * count).reshape(-1, 3).astype(np.float64)
        self._expect((np.abs(found) < _FAR_M).all(), "a position")
        return found

    def _check_polygons(self, polygons: NDArray, vertices: int) -> None:
        count, beside = polygons["count"][:, None], polygons["beside"]
        used = np.arange(6) < count
        self._expect(((count >= 3) & (count <= 6)).all(), "a polygon's number of corners")
        self._expect((~used | (polygons["corners"] < vertices)).all(), "a polygon's corners")
        self._expect((~used | (beside <= len(polygons))).all(), "a polygon's neighbours")

    def _triangles(self, header: np.void, polygons: NDArray, vertices: NDArray) -> tuple[NDArray, NDArray]:
        """`(k, 3, 3)` corners of all triangles, and the `(k,)` polygons that they are part of."""
        details = self._take(_DETAIL, len(polygons))
        more = self._positions(int(header["detail_vertices"]))
        corners = self._take(np.dtype("u1"), 4 * int(header["detail_triangles"])).reshape(-1, 4)[:, :3].astype(np.int64)
        own = {name: details[name].astype(np.int64) for name in ("vertex", "triangle", "vertices", "triangles")}
        self._expect((own["vertex"] + own["vertices"] <= len(more)).all(), "a polygon's details")
        self._expect((own["triangle"] + own["triangles"] <= len(corners)).all(), "a polygon's details")
        owner = np.repeat(np.arange(len(polygons)), own["triangles"])
        first = np.cumsum(own["triangles"]) - own["triangles"]
        corner = corners[own["triangle"][owner] + np.arange(len(owner)) - first[owner]]
        # A corner's number goes through the polygon's own corners first, and then through its detail vertices.
        count = polygons["count"].astype(np.int64)[owner, None]
        self._expect((corner < count + own["vertices"][owner, None]).all(), "a polygon's triangles")
        of_polygon = polygons["corners"].astype(np.int64)[owner[:, None], np.minimum(corner, count - 1)]
        of_details = len(vertices) + own["vertex"][owner, None] + np.maximum(corner - count, 0)
        return np.concatenate([vertices, more])[np.where(corner < count, of_polygon, of_details)], owner

    def _take(self, kind: np.dtype, count: int) -> NDArray:
        end = self._at + count * kind.itemsize
        if count < 0 or end > len(self._content):
            self._fail(f"it ends after {len(self._content)} bytes")
        found = np.frombuffer(self._content, kind, count, self._at)
        self._at = end
        return found

    def _expect(self, holds: object, what: str) -> None:
        if not holds:
            self._fail(f"{what} cannot be right")

    def _fail(self, reason: str) -> NoReturn:
        raise SceneError(f"{self._path}: expected a NavMesh as Habitat-Sim writes it (.navmesh), but {reason}")


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
