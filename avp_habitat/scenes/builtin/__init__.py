"""Furnished rooms that are made up from a number: `builtin:SEED`."""

from dataclasses import replace

import numpy as np

from avp_habitat.errors import UsageError
from avp_habitat.scenes.builtin.dice import Dice
from avp_habitat.scenes.builtin.floorplan import Placed
from avp_habitat.scenes.builtin.kit import Kit
from avp_habitat.scenes.builtin.layout import furnish
from avp_habitat.scenes.builtin.lighting import bake
from avp_habitat.scenes.builtin.masonry import build_shell
from avp_habitat.scenes.builtin.piece import Lamp
from avp_habitat.scenes.builtin.shapes import Surface, joined
from avp_habitat.scenes.builtin.shell import Shell, plan_shell
from avp_habitat.scenes.mesh import TexturedMesh, merge

GENERATOR_VERSION = 1
"""Rises whenever a seed's room changes, so that results name the room that they were measured in."""


def _checked(seed: int) -> int:
    if isinstance(seed, bool) or not isinstance(seed, (int, np.integer)) or seed < 0:
        raise UsageError(f"builtin:{seed}: expected a whole number of 0 or greater as the room's seed, got {seed!r}")
    return int(seed)


def plan_room(seed: int) -> tuple[Shell, list[Placed]]:
    """The empty room and its furniture, before light is baked.

    Args:
        seed: 0 or greater.

    Raises:
        UsageError: the seed is not a whole number of 0 or greater.
    """
    seed = _checked(seed)
    shell = plan_shell(Dice(seed, 1))
    return shell, furnish(shell, Dice(seed, 2), Kit(seed))


def _snapped(values: np.ndarray) -> np.ndarray:
    """Rounded to whole 2^-13 (0.12 mm), so that the last bits of a platform's sine do not matter.

    A power of two, because sums of decimal lengths then never lie half-way between two steps.
    """
    return np.rint(values * 8192) / 8192


def _mesh(surface: Surface, colours: np.ndarray) -> TexturedMesh:
    """A surface as the renderers take it."""
    return TexturedMesh(
        surface.vertices.astype(np.float32),
        surface.triangles.astype(np.int32),
        surface.uv.astype(np.float32),
        (np.rint(colours * 255) / 255).astype(np.float32),
        np.zeros(len(surface.triangles), np.int32),
        [surface.material.picture],
    )


def _in_world(stand: Placed, lamp: Lamp) -> Lamp:
    x, y, z = stand.axes @ np.asarray(lamp.position) + [stand.position[0], 0.0, stand.position[1]]
    return Lamp((float(x), float(y), float(z)), lamp.strength)


def generate_room(seed: int) -> TexturedMesh:
    """A furnished room: metres, Y up, floor at y = 0, closed on all sides, the same for the same seed.

    Args:
        seed: 0 or greater; decides outline, height, colours, furniture and textures.

    Raises:
        UsageError: the seed is not a whole number of 0 or greater.
    """
    seed = _checked(seed)
    kit = Kit(seed)
    shell = plan_shell(Dice(seed, 1))
    placed = furnish(shell, Dice(seed, 2), kit)
    surfaces = build_shell(kit, Dice(seed, 3), shell)
    lamps = []
    for stand in placed:
        surfaces += stand.surfaces()
        lamps += [_in_world(stand, lamp) for lamp in stand.piece.lamps]
    surfaces = [replace(s, vertices=_snapped(s.vertices), uv=_snapped(s.uv)) for s in joined(surfaces)]
    colours = bake(shell, surfaces, lamps)
    return merge([_mesh(surface, colour) for surface, colour in zip(surfaces, colours, strict=True)])
