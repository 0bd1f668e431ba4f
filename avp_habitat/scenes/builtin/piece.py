"""A piece of furniture: what it looks like, the room it takes, the light it gives."""

from dataclasses import dataclass

import numpy as np

from avp_habitat.scenes.builtin.shapes import Surface, Vector, moved

FLAT_M = 0.02
"""Pieces no higher than this lie on the floor without being in the way."""


@dataclass(frozen=True, eq=False)
class Lamp:
    """A point from which warm light comes."""

    position: Vector
    """Metres, in the frame of what holds it."""
    strength: float
    """Light one metre away, where 1 is the light that shows colours as they are painted."""


@dataclass(frozen=True, eq=False)
class Piece:
    """Furniture in its own frame: foot at the origin, y up, front towards +z, width along x."""

    kind: str
    """For example `"sofa"`."""
    surfaces: list[Surface]
    """Its triangles."""
    width: float
    """Extent along x in metres, centred."""
    depth: float
    """Extent along z in metres, centred."""
    height: float
    """Extent along y in metres."""
    lamps: tuple[Lamp, ...] = ()
    """Lights in it."""


def shifted(surfaces: list[Surface], x: float, y: float, z: float) -> list[Surface]:
    """The same surfaces elsewhere, metres."""
    return moved(surfaces, np.eye(3), np.array([x, y, z]))
