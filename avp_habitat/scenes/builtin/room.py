"""Furnished rooms that are made up from a number, `builtin:SEED`, with light baked into their vertices."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter

from avp_habitat.scenes.builtin.furnish import Placed, furnish
from avp_habitat.scenes.builtin.kit import Kit, Lamp
from avp_habitat.scenes.builtin.noise import Random
from avp_habitat.scenes.builtin.shapes import Float, MeshSurface, by_material
from avp_habitat.scenes.builtin.shell import Shell, build_shell, plan_shell
from avp_habitat.scenes.mesh import TexturedMesh, merge

GENERATOR_VERSION = 1
"""Rises whenever a seed's room changes, so that results name the room that they were measured in."""
_VOXEL_M = 0.1
_PADDING = 8
"""Voxels around the room that count as solid."""
_OFF_THE_GRID = 3.7e-5
"""Metres by which voxels are shifted, so that no wall lies exactly between two of them."""


def plan_room(seed: int) -> tuple[Kit, Shell, list[Placed]]:
    """What a room is made of, the empty room and its furniture, before light is baked."""
    kit, shell = Kit(seed), plan_shell(Random(seed, 1))
    return kit, shell, furnish(shell, Random(seed, 2), kit)


def _snapped(values: np.ndarray) -> np.ndarray:
    """Rounded to whole 2^-13 (0.12 mm), so that the last bits of a platform's sine do not matter.

    A power of two, because sums of decimal lengths then never lie half-way between two steps.
    """
    return np.rint(values * 8192) / 8192


def _mesh(surface: MeshSurface, colours: np.ndarray) -> TexturedMesh:
    return TexturedMesh(
        surface.vertices.astype(np.float32),
        surface.triangles.astype(np.int32),
        surface.uv.astype(np.float32),
        (np.rint(colours * 255) / 255).astype(np.float32),
        np.zeros(len(surface.triangles), np.int32),
        [surface.material.picture],
    )


def generate_room(seed: int) -> TexturedMesh:
    """A furnished room: metres, Y up, floor at y = 0, closed on all sides, the same for the same seed of 0 or more."""
    kit, shell, placed = plan_room(seed)
    surfaces = build_shell(kit, Random(seed, 3), shell)
    for stand in placed:
        surfaces += stand.surfaces()
    lamps = [lamp for stand in placed for lamp in stand.lamps()]
    surfaces = [replace(s, vertices=_snapped(s.vertices), uv=_snapped(s.uv)) for s in by_material(surfaces)]
    colours = _bake(shell, surfaces, lamps)
    return merge([_mesh(surface, colour) for surface, colour in zip(surfaces, colours, strict=True)])


class _Voxels:
    """What of the room's space is filled, and how filled the surroundings of each place are."""

    def __init__(self, shell: Shell, surfaces: list[MeshSurface]) -> None:
        """Fill every voxel that a surface passes through and everything outside the room."""
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
        self.solid = filled
        for surface in surfaces:
            index = self._index(_samples(surface))
            filled[index[:, 0], index[:, 1], index[:, 2]] = 1
        self.soft = {reach: uniform_filter(filled, 2 * reach + 1, mode="nearest") for reach in (1, 2, 4, 7)}

    def _index(self, points: Float) -> NDArray[np.int64]:
        index = np.floor((points - self._origin) / _VOXEL_M).astype(np.int64)
        return np.clip(index, 0, np.array(self.solid.shape) - 1)

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


def _windows(shell: Shell) -> Iterator[tuple[Float, float]]:
    """Points of light just inside each window and their strength."""
    for hole in shell.openings:
        if hole.kind == "window":
            wall, width = shell.walls[hole.wall], hole.right - hole.left
            for share in (0.25, 0.75):
                x, z = wall.point(hole.left + width * share, 0.3)
                yield np.array([x, (hole.bottom + hole.top) / 2 + 0.2, z]), 0.3 * width


def _bake(shell: Shell, surfaces: list[MeshSurface], lamps: list[Lamp]) -> list[NDArray[np.float32]]:
    """`(v, 3)` light in [0, 1] on each surface, from windows and lamps; all is in the world frame."""
    voxels = _Voxels(shell, surfaces)
    points, normals = (np.concatenate([getattr(each, name) for each in surfaces]) for name in ("vertices", "normals"))
    openness = _open_sky(voxels, points, normals)
    ambient = openness * (0.76 + 0.05 * normals[:, 1]).astype(np.float32)
    light = ambient[:, None] * np.array([1.0, 0.99, 0.97], np.float32)
    lights = [(position, strength, 2.4, (0.97, 1.0, 1.04)) for position, strength in _windows(shell)]
    lights += [(np.asarray(lamp.position), lamp.strength, 0.9, (1.05, 0.92, 0.7)) for lamp in lamps]
    for position, strength, reach, colour in lights:
        falling = _from_lamp(voxels, points, normals, position, reach) * np.float32(strength)
        light += falling[:, None] * np.array(colour, np.float32)
    light = np.where(light > 0.8, 0.8 + (light - 0.8) * 0.45, light)
    parts = np.split(np.clip(light, 0, 1), np.cumsum([len(surface.vertices) for surface in surfaces])[:-1])
    return [
        np.ones_like(part) if surface.material.glows else part for surface, part in zip(surfaces, parts, strict=True)
    ]
