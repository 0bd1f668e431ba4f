"""The triangle mesh that every scene becomes, as arrays: cut from polygons, merged, with holes where masks say so.

A mask is a picture that says where a surface is and where there is a hole (glTF's alphaMode MASK). Polygons are fans of
triangles where they are convex; where they are not, as around a door in a wall, ears are cut off.
"""

import logging
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

_MOST_PIECES = 2_000_000
_AT_ONCE = 500_000
_MOST_CORNERS = 2000
_STRAIGHT = 1e-9
"""Share of a polygon's area by which a corner may turn the wrong way."""
_log = logging.getLogger(__name__)


@cache
def warn_once(scene: str, text: str) -> None:
    """Log a warning about a scene, named by the path as the user wrote it, once in a process."""
    _log.warning("%s: %s", scene, text)


@dataclass(frozen=True)
class TexturedMesh:
    """An unlit, textured triangle mesh in the world frame (metres, Y up).

    The colour of a surface point is texture x vertex colour, multiplied as they are stored (sRGB-encoded values, no
    conversion): scanned scenes carry baked light that is meant to be shown so.
    """

    vertices: NDArray[np.floating]
    """`(v, 3)` positions in metres, float32; float64 while a file is read, whose coordinates may be large."""
    triangles: NDArray[np.int32]
    """`(t, 3)` vertex indices."""
    uv: NDArray[np.float32]
    """`(v, 2)` texture coordinates; u right, v **down** (glTF's convention), repeating outside [0, 1]."""
    colours: NDArray[np.float32]
    """`(v, 3)` vertex colours times the material's base-colour factor, in [0, 1]; 1 where a mesh has none."""
    texture_index: NDArray[np.int32]
    """`(t,)` index into `textures`, -1 for none."""
    textures: list[NDArray[np.uint8]] = field(default_factory=list)
    """`(height, width, 3)` sRGB pictures."""
    mask_index: NDArray[np.int32] | None = None
    """`(t,)` index into `masks`, -1 for none; None where no triangle has a mask."""
    masks: list[NDArray[np.bool_]] = field(default_factory=list)
    """`(height, width)` where, in texture coordinates, there is a surface; elsewhere is a hole."""

    def __post_init__(self) -> None:
        """Check the shapes, which are the contract between loaders and renderers."""
        vertices, triangles = len(self.vertices), len(self.triangles)
        found = [each.shape for each in (self.vertices, self.triangles, self.uv, self.colours, self.texture_index)]
        assert found == [(vertices, 3), (triangles, 3), (vertices, 2), (vertices, 3), (triangles,)], found

    @property
    def bounds(self) -> NDArray[np.floating]:
        """`(2, 3)` least and greatest corner in metres."""
        return np.stack([self.vertices.min(axis=0), self.vertices.max(axis=0)])


def merge(parts: list[TexturedMesh]) -> TexturedMesh:
    """One mesh of several; textures and masks that are the same object are kept once."""
    offsets = np.cumsum([0] + [len(part.vertices) for part in parts[:-1]], dtype=np.int32)
    textures, lookups = _kept_once([part.textures for part in parts])
    masks, mask_lookups = _kept_once([part.masks for part in parts])
    without = [np.full(len(part.triangles), -1) if part.mask_index is None else part.mask_index for part in parts]
    return TexturedMesh(
        np.concatenate([part.vertices for part in parts]),
        np.concatenate([part.triangles + at for part, at in zip(parts, offsets, strict=True)]),
        np.concatenate([part.uv for part in parts]),
        np.concatenate([part.colours for part in parts]),
        np.concatenate([lookup[part.texture_index] for part, lookup in zip(parts, lookups, strict=True)]),
        textures,
        np.concatenate([lookup[index] for index, lookup in zip(without, mask_lookups, strict=True)]) if masks else None,
        masks,
    )


def _kept_once(pictures: list[list[NDArray]]) -> tuple[list[NDArray], list[NDArray[np.int32]]]:
    """All different pictures, and for each list the new indices of its own, -1 staying -1."""
    every = {id(picture): picture for own in pictures for picture in own}
    slot = {key: number for number, key in enumerate(every)}
    return list(every.values()), [
        np.array([slot[id(picture)] for picture in own] + [-1], dtype=np.int32) for own in pictures
    ]


def only(mesh: TexturedMesh, kept: NDArray[np.bool_]) -> TexturedMesh:
    """The mesh with the `(t,)` triangles that are kept."""
    index = None if mesh.mask_index is None else mesh.mask_index[kept]
    return replace(mesh, triangles=mesh.triangles[kept], texture_index=mesh.texture_index[kept], mask_index=index)


def with_mask(mesh: TexturedMesh, mask: NDArray[np.bool_]) -> TexturedMesh:
    """The mesh where a `(height, width)` picture is true; triangles that lie in holes as a whole are left out."""
    least, most = _least_and_most(mask, mesh.uv[mesh.triangles])
    index = np.where(least, -1, 0).astype(np.int32)[most]
    mesh = only(mesh, most)
    return replace(mesh, mask_index=index, masks=[mask]) if (index >= 0).any() else mesh


def _least_and_most(mask: NDArray[np.bool_], uv: NDArray[np.float32]) -> tuple[NDArray, NDArray]:
    """`(t,)` whether all, and whether any, of the picture around `(t, 3, 2)` texture coordinates is true.

    Around means the rectangle about a triangle; the whole picture for one that repeats it.
    """
    size = np.array(mask.shape[::-1])
    low, high = (np.floor(bound(uv, axis=1).astype(np.float64) * size).astype(np.int64) for bound in (np.min, np.max))
    repeats = (low // size != high // size).any(axis=1)
    low, high = np.where(repeats[:, None], 0, low % size), np.where(repeats[:, None], size - 1, high % size) + 1
    count = np.zeros(np.add(mask.shape, 1), np.int64)
    count[1:, 1:] = mask.cumsum(axis=0, dtype=np.int64).cumsum(axis=1)
    (x0, y0), (x1, y1) = low.T, high.T
    inside = count[y1, x1] - count[y0, x1] - count[y1, x0] + count[y0, x0]
    return inside == (high - low).prod(axis=1), inside > 0


def is_hole(mesh: TexturedMesh, triangles: NDArray[np.integer], at: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Whether points lie in holes of a mesh with masks; the texel that they lie in decides.

    Points have `(n,)` triangles, of which those that the mesh does not have are no holes, and `(n, 2)` shares of the
    second and third corner.
    """
    assert mesh.mask_index is not None
    result = np.zeros(len(triangles), bool)
    valid = np.flatnonzero(triangles < len(mesh.triangles))
    index = mesh.mask_index[triangles[valid]]
    for number in np.unique(index[index >= 0]):
        rays = valid[index == number]
        mask = mesh.masks[number]
        uv = _between(mesh.uv[mesh.triangles[triangles[rays]]], at[rays])
        texel = np.floor(uv * mask.shape[::-1]).astype(np.int64) % mask.shape[::-1]
        result[rays] = ~mask[texel[:, 1], texel[:, 0]]
    return result


def without_holes(mesh: TexturedMesh, size_m: float) -> TexturedMesh:
    """The surfaces alone, for who does not look at pictures: of masked triangles the pieces that are there.

    The pieces' edges are at most `size_m` metres long (longer where there would be millions of pieces).
    """
    if mesh.mask_index is None:
        return mesh
    masked = np.flatnonzero(mesh.mask_index >= 0)
    whole = only(mesh, mesh.mask_index < 0)
    # Corners of the pieces in their triangles' barycentric coordinates.
    pieces = np.tile(np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]), (len(masked), 1, 1))
    owner, done = masked, []
    while len(owner):
        corners = mesh.vertices[mesh.triangles[owner]]
        points = np.stack([_between(corners, pieces[:, corner]) for corner in range(3)], axis=1)
        longest = np.sqrt(((points - np.roll(points, 1, axis=1)) ** 2).sum(axis=2)).max(axis=1)
        small = (longest <= size_m) | (4 * len(owner) > _MOST_PIECES)
        there = small & ~is_hole(mesh, owner, pieces.mean(axis=1))
        done.append(points[there])
        pieces, owner = _in_four(pieces[~small]), np.repeat(owner[~small], 4)
    corners = np.concatenate(done).reshape(-1, 3).astype(np.float32)
    triangles = np.arange(len(corners), dtype=np.int32).reshape(-1, 3)
    untextured = np.full(len(triangles), -1, np.int32)
    there = TexturedMesh(corners, triangles, np.zeros((len(corners), 2), np.float32), np.ones_like(corners), untextured)
    return merge([replace(whole, mask_index=None, masks=[]), there])


def _between(corners: NDArray, at: NDArray) -> NDArray:
    """`(n, k)` values at `(n, 2)` barycentric coordinates of triangles with `(n, 3, k)` values at their corners."""
    a, b, c = np.moveaxis(corners.astype(np.float64), 1, 0)
    return a + at[:, :1] * (b - a) + at[:, 1:] * (c - a)


def _in_four(pieces: NDArray) -> NDArray:
    """`(4 n, 3, 2)` quarters of `(n, 3, 2)` triangles, in their order, wound as they are."""
    a, b, c = np.moveaxis(pieces, 1, 0)
    ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
    quarters = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
    return np.stack([np.stack(corners, axis=1) for corners in quarters], axis=1).reshape(-1, 3, 2)


def triangulate(
    lengths: NDArray[np.integer], corners: NDArray[np.integer], positions: NDArray[np.floating]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Cut polygons into triangles that cover them and nothing else.

    Args:
        lengths: `(n,)` corners of each polygon, whose corners follow one another.
        corners: `(sum of lengths,)` their vertices.
        positions: `(v, 3)` of the vertices.

    Returns:
        `(t, 3)` places in the list of all corners, and `(t,)` the polygons that the triangles are of.

    Raises:
        ValueError: a polygon that is not convex has so many corners that to cut it would take minutes.
    """
    lengths = np.asarray(lengths, np.int64)
    each = np.maximum(lengths - 2, 0)
    polygons = np.repeat(np.arange(len(lengths)), each)
    start, begin = np.cumsum(lengths) - lengths, np.cumsum(each) - each
    first = start[polygons]
    step = np.arange(len(polygons)) - begin[polygons]
    places = np.stack([first, first + step + 1, first + step + 2], axis=1)
    large = np.flatnonzero(lengths > 3)
    for some in np.array_split(large, len(large) // _AT_ONCE + 1):
        for polygon, points, normal in _not_convex(some, lengths[some], start[some], corners, positions):
            if len(points) > _MOST_CORNERS:
                raise ValueError(
                    f"polygon {polygon + 1} is not convex and has {len(points)} corners; expected {_MOST_CORNERS} at "
                    "most: export the scene with triangles"
                )
            places[begin[polygon] :][: len(points) - 2] = start[polygon] + _ears(points, normal)
    return places, polygons


def _not_convex(
    some: NDArray, lengths: NDArray, start: NDArray, corners: NDArray, positions: NDArray
) -> Iterator[tuple[int, NDArray, NDArray]]:
    """Index, `(n, 3)` corners and normal of each polygon with a corner that turns the wrong way."""
    of = np.repeat(np.arange(len(some)), lengths)
    end = np.cumsum(lengths)
    own = np.arange(len(of)) - (end - lengths)[of]
    first = positions[corners[start]].astype(np.float64)[of]
    here, before, after = (
        positions[corners[start[of] + (own + step) % lengths[of]]].astype(np.float64) - first for step in (0, -1, 1)
    )
    with np.errstate(over="ignore", invalid="ignore"):
        crossed = np.cross(here, after)
        normals = np.stack([np.bincount(of, crossed[:, axis], len(some)) for axis in range(3)], axis=1)
        turns = (np.cross(here - before, after - here) * normals[of]).sum(axis=1)
        wrong = turns < -_STRAIGHT * (normals**2).sum(axis=1)[of]
    for index in np.unique(of[wrong]):
        yield int(some[index]), here[end[index] - lengths[index] : end[index]], normals[index]


def _ears(corners: NDArray[np.float64], normal: NDArray[np.float64]) -> NDArray[np.int64]:
    """`(n - 2, 3)` triangles of a polygon of `(n, 3)` corners, seen from where its normal points to."""
    axis = int(np.abs(normal).argmax())
    flat = corners[:, [(axis + 1) % 3, (axis + 2) % 3]]
    if normal[axis] < 0:
        flat = flat[:, ::-1]
    left, triangles, at, missed = list(range(len(flat))), [], 0, 0
    while len(left) > 3:
        at %= len(left)
        corner = left[at - 1], left[at], left[(at + 1) % len(left)]
        # Where a polygon crosses itself there may be no ear.
        if missed == len(left) or _is_ear(flat[list(corner)], flat[left]):
            triangles.append(corner)
            del left[at]
            missed = 0
        else:
            missed += 1
        at += 1
    return np.array([*triangles, left], np.int64)


def _is_ear(corner: NDArray[np.float64], left: NDArray[np.float64]) -> bool:
    """Whether a corner with its neighbours turns to the left, and no other point lies in their triangle."""
    sides = np.roll(corner, -1, axis=0) - corner
    if not sides[0, 0] * sides[1, 1] - sides[0, 1] * sides[1, 0] > 0:
        return False
    to = left[:, None] - corner
    inside = (sides[:, 0] * to[..., 1] - sides[:, 1] * to[..., 0] >= 0).all(axis=1)
    return not (inside & (to != 0).any(axis=2).all(axis=1)).any()
