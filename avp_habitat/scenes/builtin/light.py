"""Light from windows, lamps and open doorways, softly shadowed, on the vertices of one room."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter

from avp_habitat.scenes.builtin.kit import Lamp
from avp_habitat.scenes.builtin.shapes import Float, MeshSurface
from avp_habitat.scenes.builtin.shell import Shell

_VOXEL_M = 0.1
_PADDING = 8
"""Voxels around the room that count as solid."""
_OFF_THE_GRID = 3.7e-5
"""Metres by which voxels are shifted, so that no wall lies exactly between two of them."""


def _doorways(shell: Shell) -> Iterator[tuple[Float, Float]]:
    """Least and greatest corner of the space in and behind each open doorway."""
    for hole in shell.openings:
        if hole.kind == "passage":
            wall = shell.walls[hole.wall]
            (xa, za), (xb, zb) = wall.point(hole.left, 0.0), wall.point(hole.right, -(_PADDING - 0.5) * _VOXEL_M)
            yield np.array([min(xa, xb), 0.02, min(za, zb)]), np.array([max(xa, xb), hole.top, max(za, zb)])


class _Voxels:
    """What of the room's space is filled, and how filled the surroundings of each place are."""

    def __init__(self, shell: Shell, surfaces: list[MeshSurface]) -> None:
        """Fill every voxel that a surface passes through and everything outside the room but behind open doorways."""
        x0, z0, x1, z1 = shell.bounds
        extent = np.array([x1 - x0, shell.ceiling, z1 - z0])
        self._origin = np.array([x0, 0.0, z0]) - _PADDING * _VOXEL_M - _OFF_THE_GRID
        shape = tuple(int(n) for n in np.ceil(extent / _VOXEL_M) + 2 * _PADDING)
        filled = np.ones(shape, np.float32)
        inside = [np.arange(n) * _VOXEL_M + _VOXEL_M / 2 - _PADDING * _VOXEL_M for n in shape]
        room = [(along > 0) & (along < extent[axis]) for axis, along in enumerate(inside)]
        filled[np.ix_(*room)] = 0
        if shell.notch is not None:
            a, b, c, d = shell.notch
            x, z = inside[0] + x0, inside[2] + z0
            filled[np.ix_((x > a) & (x < c), room[1], (z > b) & (z < d))] = 1
        for corner, end in _doorways(shell):
            (a, b, c), (d, e, f) = self._voxel(corner), self._voxel(end)
            filled[a : d + 1, b : e + 1, c : f + 1] = 0
        self.solid = filled
        for surface in surfaces:
            index = self._index(_samples(surface))
            filled[index[:, 0], index[:, 1], index[:, 2]] = 1
        self.soft = {reach: uniform_filter(filled, 2 * reach + 1, mode="nearest") for reach in (1, 2, 4, 7)}

    def _voxel(self, points: Float) -> NDArray[np.int64]:
        return np.floor((points - self._origin) / _VOXEL_M).astype(np.int64)

    def _index(self, points: Float) -> NDArray[np.int64]:
        return np.clip(self._voxel(points), 0, np.array(self.solid.shape) - 1)

    def fullness(self, points: Float, reach: int) -> NDArray[np.float32]:
        """Trilinear share of filled space within `reach` voxels of `(n, 3)` points."""
        grid = self.soft[reach]
        place = np.clip((points - self._origin) / _VOXEL_M - 0.5, 0, np.array(grid.shape) - 1.001)
        low = np.floor(place).astype(np.int64)
        part = (place - low).astype(np.float32)
        total = np.zeros(len(points), np.float32)
        for corner in range(8):
            bits = np.array([corner >> 2 & 1, corner >> 1 & 1, corner & 1])
            weight = np.prod(np.where(bits, part, 1 - part), axis=1)
            at = low + bits
            total += weight * grid[at[:, 0], at[:, 1], at[:, 2]]
        return total

    def clear_view(self, points: Float, light: Float) -> NDArray[np.float32]:
        """Share of light that reaches `(n, 3)` points from a `(3,)` point past what is filled."""
        grid, steps = self.soft[1], 14
        through = np.ones(len(points), np.float32)
        for step in range(1, steps):
            at = self._index(points + (light - points) * (step / steps))
            through *= 1 - 0.55 * grid[at[:, 0], at[:, 1], at[:, 2]]
        return through


def _samples(surface: MeshSurface) -> Float:
    """Points on the triangles, close enough together to fill every voxel that they pass through."""
    corners = surface.vertices[surface.triangles]
    weights = np.array([[i, j, 4 - i - j] for i in range(5) for j in range(5 - i)]) / 4
    return np.einsum("kc,tcd->tkd", weights, corners).reshape(-1, 3)


def _open_sky(voxels: _Voxels, points: Float, normals: Float) -> NDArray[np.float32]:
    """How unobstructed the half space above each point is, 0 to 1."""
    openness = np.ones(len(points), np.float32)
    for reach, weight in ((1, 0.22), (2, 0.3), (4, 0.32), (7, 0.34)):
        openness -= np.float32(weight) * voxels.fullness(points + normals * (reach + 0.6) * _VOXEL_M, reach)
    return np.clip(openness, 0.3, 1)


def _from_lamp(voxels: _Voxels, points: Float, normals: Float, position: Float, reach: float) -> NDArray[np.float32]:
    """Light of a point source: falls off with distance and slant, shadowed softly."""
    offset = position - points
    square = (offset * offset).sum(axis=1)
    slant = (offset * normals).sum(axis=1) / np.sqrt(square + 1e-6)
    falloff = np.clip(slant * 0.8 + 0.2, 0, 1) / (1 + square / reach**2)
    return (falloff * voxels.clear_view(points + normals * 1.6 * _VOXEL_M, position)).astype(np.float32)


def _openings(shell: Shell) -> Iterator[tuple[Float, float]]:
    """Points of light just inside each window or open doorway and their strength."""
    for hole in shell.openings:
        wall, width = shell.walls[hole.wall], hole.right - hole.left
        if hole.kind == "passage":
            x, z = wall.point(hole.left + width / 2, 0.2)
            yield np.array([x, 1.5, z]), 0.16 * width
        if hole.kind == "window":
            for share in (0.25, 0.75):
                x, z = wall.point(hole.left + width * share, 0.3)
                yield np.array([x, (hole.bottom + hole.top) / 2 + 0.2, z]), 0.3 * width


def bake(shell: Shell, surfaces: list[MeshSurface], lamps: list[Lamp]) -> list[NDArray[np.float32]]:
    """`(v, 3)` light in [0, 1] on each surface, from windows and lamps; all is in the world frame."""
    voxels = _Voxels(shell, surfaces)
    points, normals = (np.concatenate([getattr(each, name) for each in surfaces]) for name in ("vertices", "normals"))
    openness = _open_sky(voxels, points, normals)
    ambient = openness * (0.76 + 0.05 * normals[:, 1]).astype(np.float32)
    light = ambient[:, None] * np.array([1.0, 0.99, 0.97], np.float32)
    lights = [(position, strength, 2.4, (0.97, 1.0, 1.04)) for position, strength in _openings(shell)]
    lights += [(np.asarray(lamp.position), lamp.strength, 0.9, (1.05, 0.92, 0.7)) for lamp in lamps]
    for position, strength, reach, colour in lights:
        falling = _from_lamp(voxels, points, normals, position, reach) * np.float32(strength)
        light += falling[:, None] * np.array(colour, np.float32)
    light = np.where(light > 0.8, 0.8 + (light - 0.8) * 0.45, light)
    parts = np.split(np.clip(light, 0, 1), np.cumsum([len(surface.vertices) for surface in surfaces])[:-1])
    return [
        np.ones_like(part) if surface.material.glows else part for surface, part in zip(surfaces, parts, strict=True)
    ]
