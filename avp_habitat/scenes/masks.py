"""Surfaces of which a picture says where they are and where there is a hole (glTF's alphaMode MASK)."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from avp_habitat.scenes.mesh import TexturedMesh

_MOST_PIECES = 2_000_000


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
    """Whether points of triangles lie in holes; the texel that they lie in decides.

    Args:
        mesh: with masks.
        triangles: `(n,)` indices; those that the mesh does not have are no holes.
        at: `(n, 2)` barycentric coordinates, shares of the second and third corner.
    """
    assert mesh.mask_index is not None
    result = np.zeros(len(triangles), bool)
    valid = np.flatnonzero(triangles < len(mesh.triangles))
    index = mesh.mask_index[triangles[valid]]
    for number in np.unique(index[index >= 0]):
        rays = valid[index == number]
        mask = mesh.masks[number]
        a, b, c = np.moveaxis(mesh.uv[mesh.triangles[triangles[rays]]].astype(np.float64), 1, 0)
        u, v = at[rays, :1], at[rays, 1:]
        texel = np.floor((a + u * (b - a) + v * (c - a)) * mask.shape[::-1]).astype(np.int64) % mask.shape[::-1]
        result[rays] = ~mask[texel[:, 1], texel[:, 0]]
    return result


def without_holes(mesh: TexturedMesh, size_m: float) -> TexturedMesh:
    """The surfaces alone, for who does not look at pictures: of masked triangles the pieces that are there.

    Args:
        mesh: metres.
        size_m: how long the pieces' edges are at most (longer ones where there would be millions).
    """
    if mesh.mask_index is None:
        return mesh
    masked = np.flatnonzero(mesh.mask_index >= 0)
    whole = only(mesh, mesh.mask_index < 0)
    # Corners of the pieces in their triangles' barycentric coordinates.
    pieces = np.tile(np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]), (len(masked), 1, 1))
    owner, done = masked, []
    while len(owner):
        points = _points(mesh, owner, pieces)
        longest = np.sqrt(((points - np.roll(points, 1, axis=1)) ** 2).sum(axis=2)).max(axis=1)
        small = (longest <= size_m) | (4 * len(owner) > _MOST_PIECES)
        there = small & ~is_hole(mesh, owner, pieces.mean(axis=1))
        done.append(points[there])
        pieces, owner = _in_four(pieces[~small]), np.repeat(owner[~small], 4)
    corners = np.concatenate(done).reshape(-1, 3).astype(np.float32)
    count = len(corners) // 3
    return TexturedMesh(
        np.concatenate([mesh.vertices, corners]),
        np.concatenate([whole.triangles, len(mesh.vertices) + np.arange(3 * count, dtype=np.int32).reshape(-1, 3)]),
        np.concatenate([mesh.uv, np.zeros((len(corners), 2), np.float32)]),
        np.concatenate([mesh.colours, np.ones_like(corners)]),
        np.concatenate([whole.texture_index, np.full(count, -1, np.int32)]),
        mesh.textures,
    )


def _points(mesh: TexturedMesh, owner: NDArray, pieces: NDArray) -> NDArray:
    """`(n, 3, 3)` corners in metres of `(n, 3, 2)` pieces of triangles."""
    a, b, c = np.moveaxis(mesh.vertices[mesh.triangles[owner]].astype(np.float64), 1, 0)
    return a[:, None] + pieces[..., :1] * (b - a)[:, None] + pieces[..., 1:] * (c - a)[:, None]


def _in_four(pieces: NDArray) -> NDArray:
    """`(4 n, 3, 2)` quarters of `(n, 3, 2)` triangles, in their order, wound as they are."""
    a, b, c = np.moveaxis(pieces, 1, 0)
    ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
    quarters = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
    return np.stack([np.stack(corners, axis=1) for corners in quarters], axis=1).reshape(-1, 3, 2)
