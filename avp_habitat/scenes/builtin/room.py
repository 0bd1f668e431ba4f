"""Furnished rooms that are made up from a number, `builtin:SEED`, with light baked into their vertices."""

from dataclasses import replace

import numpy as np

from avp_habitat.scenes.builtin.furnish import Placed, furnish
from avp_habitat.scenes.builtin.kit import Kit
from avp_habitat.scenes.builtin.light import bake
from avp_habitat.scenes.builtin.noise import Random
from avp_habitat.scenes.builtin.shapes import MeshSurface, by_material
from avp_habitat.scenes.builtin.shell import Shell, build_shell, plan_shell
from avp_habitat.scenes.mesh import TexturedMesh, merge

GENERATOR_VERSION = 1
"""Rises whenever a seed's room changes, so that results name the room that they were measured in."""


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


def lit_room(kit: Kit, rng: Random, shell: Shell, placed: list[Placed]) -> list[TexturedMesh]:
    """The room and its furniture with baked light, a mesh for each of their surfaces."""
    surfaces = build_shell(kit, rng, shell)
    for stand in placed:
        surfaces += stand.surfaces()
    lamps = [lamp for stand in placed for lamp in stand.lamps()]
    surfaces = [replace(s, vertices=_snapped(s.vertices), uv=_snapped(s.uv)) for s in by_material(surfaces)]
    colours = bake(shell, surfaces, lamps)
    return [_mesh(surface, colour) for surface, colour in zip(surfaces, colours, strict=True)]


def generate_room(seed: int) -> TexturedMesh:
    """A furnished room: metres, Y up, floor at y = 0, closed on all sides, the same for the same seed of 0 or more."""
    kit, shell, placed = plan_room(seed)
    return merge(lit_room(kit, Random(seed, 3), shell, placed))
