"""The colours and materials that one room is furnished with, and the pieces that are made of them."""

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from avp_habitat.scenes.builtin import finishes, pictures
from avp_habitat.scenes.builtin.noise import Colour, Picture, Random, blend, shade
from avp_habitat.scenes.builtin.shapes import Material, MeshSurface, Vector, moved

FLAT_M = 0.02
"""Pieces no higher than this lie on the floor without being in the way."""


@dataclass(frozen=True, eq=False)
class Lamp:
    """Where warm light comes from, metres in the frame of what holds it.

    A strength of 1, one metre away, is the light that shows colours as they are painted.
    """

    position: Vector
    strength: float


@dataclass(frozen=True, eq=False)
class Piece:
    """Furniture in its own frame: foot at the origin, y up, front to +z; metres, centred in x (width) and z (depth)."""

    kind: str
    surfaces: list[MeshSurface]
    width: float
    depth: float
    height: float
    lamps: tuple[Lamp, ...] = ()


def shifted(surfaces: list[MeshSurface], x: float, y: float, z: float) -> list[MeshSurface]:
    """The same surfaces elsewhere, metres."""
    return moved(surfaces, np.eye(3), np.array([x, y, z]))


@dataclass(frozen=True)
class Scheme:
    """Colours that go together, sRGB in [0, 1]; of walls, `feature` is the one that stands out."""

    wall: Colour
    feature: Colour
    floor: Colour
    wood: Colour
    upholstery: Colour
    accents: tuple[Colour, Colour, Colour]


SCHEMES = (
    Scheme((0.93, 0.92, 0.88), (0.62, 0.72, 0.70), (0.80, 0.63, 0.44), (0.84, 0.68, 0.48), (0.60, 0.63, 0.66),
           ((0.86, 0.63, 0.25), (0.22, 0.40, 0.47), (0.87, 0.81, 0.72))),
    Scheme((0.94, 0.89, 0.82), (0.80, 0.53, 0.40), (0.58, 0.39, 0.26), (0.62, 0.42, 0.27), (0.80, 0.73, 0.62),
           ((0.72, 0.34, 0.22), (0.37, 0.44, 0.31), (0.91, 0.77, 0.52))),
    Scheme((0.90, 0.91, 0.92), (0.30, 0.41, 0.55), (0.66, 0.49, 0.34), (0.50, 0.34, 0.23), (0.32, 0.42, 0.56),
           ((0.86, 0.84, 0.80), (0.76, 0.28, 0.24), (0.88, 0.71, 0.38))),
    Scheme((0.91, 0.92, 0.85), (0.45, 0.56, 0.46), (0.72, 0.55, 0.37), (0.64, 0.46, 0.30), (0.42, 0.52, 0.43),
           ((0.88, 0.80, 0.62), (0.74, 0.46, 0.28), (0.56, 0.64, 0.52))),
    Scheme((0.95, 0.91, 0.89), (0.84, 0.66, 0.63), (0.84, 0.71, 0.55), (0.88, 0.77, 0.62), (0.76, 0.58, 0.58),
           ((0.50, 0.32, 0.40), (0.90, 0.80, 0.72), (0.50, 0.59, 0.62))),
    Scheme((0.87, 0.87, 0.86), (0.66, 0.40, 0.32), (0.47, 0.35, 0.26), (0.46, 0.32, 0.22), (0.45, 0.46, 0.49),
           ((0.84, 0.50, 0.18), (0.74, 0.73, 0.70), (0.24, 0.42, 0.46))),
    Scheme((0.92, 0.90, 0.94), (0.63, 0.58, 0.73), (0.76, 0.64, 0.52), (0.74, 0.60, 0.46), (0.58, 0.55, 0.66),
           ((0.38, 0.33, 0.52), (0.90, 0.84, 0.60), (0.66, 0.74, 0.62))),
    Scheme((0.95, 0.92, 0.82), (0.87, 0.72, 0.42), (0.62, 0.45, 0.31), (0.70, 0.50, 0.32), (0.27, 0.50, 0.52),
           ((0.90, 0.66, 0.24), (0.18, 0.38, 0.42), (0.90, 0.86, 0.76))),
)  # fmt: skip


def _brightness(colour: Colour) -> float:
    return 0.3 * colour[0] + 0.59 * colour[1] + 0.11 * colour[2]


def _legible(ground: Colour, ink: Colour) -> Colour:
    """The ink, darker where it would hardly show on the ground."""
    for _ in range(8):
        if abs(_brightness(ink) - _brightness(ground)) > 0.3:
            break
        ink = shade(ink, 0.87)
    return ink


class Kit:
    """Materials of one room, painted when first looked at and the same in whatever order that happens."""

    def __init__(self, seed: int) -> None:
        """Choose the colours and what everything is made of."""
        self._seed, self._count = seed, 0
        rng = self._rng(0)
        scheme, light = rng.choice(SCHEMES), rng.uniform(0.96, 1.04)
        floor, wood = shade(scheme.floor, light), shade(scheme.wood, rng.uniform(0.9, 1.1))
        self.scheme = scheme = replace(scheme, floor=floor, wood=wood)
        self._add_walls(scheme)
        self._add_cloth(scheme)
        self.wood = self._material(7, finishes.wood, wood, size=(1.2, 0.6))
        self.dark_wood = self._material(8, finishes.wood, shade(wood, 0.6), size=(1.2, 0.6))
        colour = self._rng(33).choice(((0.28, 0.28, 0.30), (0.72, 0.58, 0.34), (0.62, 0.63, 0.65)))
        self.metal = self._material(33, finishes.brushed, colour, size=0.4)
        self.black = self._material(34, finishes.speckled, (0.12, 0.12, 0.13), (0.2, 0.2, 0.22), size=0.4)
        self.ceramics = []
        for stream, colour in enumerate((*scheme.accents[:2], (0.88, 0.86, 0.82)), start=40):
            rng = self._rng(stream)
            fleck = shade(colour, rng.choice((0.5, 1.5)))
            self.ceramics.append(Material(partial(finishes.speckled, rng, colour, fleck), 0.4, 0.4))
        marbles = (((0.93, 0.92, 0.90), (0.5, 0.5, 0.54)), ((0.3, 0.36, 0.33), (0.8, 0.82, 0.76)))
        self.stone = self._material(50, finishes.marble, *self._rng(50).choice(marbles), size=1.2)
        self.wicker = self._material(51, finishes.wicker, (0.80, 0.62, 0.40), size=0.3)
        green = self._rng(52).choice(((0.26, 0.45, 0.22), (0.34, 0.50, 0.28), (0.22, 0.40, 0.30)))
        self.leaf = self._material(52, finishes.foliage, green)
        self.books = self._material(53, pictures.spines, self.colours)
        self.screen = self._material(55, pictures.screen, self.colours, glows=True)
        self.television = self._material(56, pictures.film, self.colours, glows=True)
        self.keys = self._material(57, pictures.keys)

    def _add_walls(self, scheme: Scheme) -> None:
        self.floor = self._floor(self._rng(1), scheme)
        self.wall = self._material(2, finishes.plaster, scheme.wall, size=1.8)
        rng = self._rng(3)
        if rng.chance(0.25):
            warm = blend(scheme.feature, (0.7, 0.42, 0.33), 0.7)
            self.feature_wall = Material(partial(finishes.brick, rng, warm), 1.25, 1.2)
        else:
            ground = blend(scheme.feature, scheme.wall, rng.choice((0.0, 0.35, 0.7)))
            ink = blend(scheme.wall, scheme.feature, 0.1) if rng.chance(0.5) else shade(scheme.feature, 0.6)
            self.feature_wall = Material(partial(finishes.wallpaper, rng, ground, _legible(ground, ink)), 1.2, 1.2)
        ink = _legible(scheme.wall, blend(scheme.wall, scheme.feature, 0.85))
        self.papered_wall = self._material(4, finishes.wallpaper, scheme.wall, ink)
        self.ceiling = self._material(5, finishes.plaster, (0.96, 0.96, 0.95), size=2.4)
        self.trim = self._material(6, finishes.paint, (0.96, 0.96, 0.94), size=(1.2, 0.6))

    def _floor(self, rng: Random, scheme: Scheme) -> Material:
        """Boards, parquet or tiles."""
        kind = rng.integer(0, 5)
        if kind <= 2:
            return Material(partial(finishes.boards, rng, scheme.floor), 2.0, 1.67)
        if kind == 3:
            return Material(partial(finishes.parquet, rng, scheme.floor), 1.6, 1.6)
        ink = blend(scheme.feature, (0.3, 0.3, 0.35), 0.4)
        base = (0.88, 0.85, 0.79) if kind == 5 else blend(scheme.floor, (0.8, 0.75, 0.7), 0.5)
        return Material(partial(finishes.tiles, rng, base, ink, patterned=kind == 5), 1.5, 1.5)

    def _add_cloth(self, scheme: Scheme) -> None:
        cloth, accents = scheme.upholstery, scheme.accents
        pale = blend(cloth, (1, 1, 1), 0.5)
        self.upholstery = self._material(9, pictures.weave, shade(cloth, 1.1), pale, size=0.6)
        cloth = accents[self._rng(10).integer(0, 1)]
        self.second_cloth = self._material(10, pictures.weave, shade(cloth, 1.05), shade(cloth, 0.6), size=0.6)
        self.cushions = []
        for stream in (20, 21, 22):
            rng = self._rng(stream)
            self.cushions.append(Material(partial(pictures.printed, rng, rng.shuffled(accents)), 0.5, 0.5))
        ground = blend(accents[2], (0.95, 0.93, 0.9), 0.5)
        self.curtain = self._material(30, pictures.printed, [ground, *accents[:2]], size=0.7)
        first, *others = self._rng(31).shuffled(accents)
        self.bedding = self._material(31, pictures.bedding, [blend(first, (1, 1, 1), 0.4), *others], size=1.2)
        self.linen = self._material(32, pictures.weave, (0.93, 0.91, 0.87), (0.75, 0.77, 0.82), size=0.6)
        lit = (0.99, 0.91, 0.74), (0.9, 0.78, 0.56)
        self.lampshade = self._material(54, pictures.weave, *lit, size=0.4, glows=True)

    def _rng(self, stream: int) -> Random:
        return Random(self._seed, 1000 + stream)

    def _material(
        self,
        stream: int,
        paint: Callable[..., Picture],
        *colours: Colour | list[Colour],
        size: float | tuple[float, float] = 1.0,
        glows: bool = False,
    ) -> Material:
        """A material whose picture spans `size` metres (width and height, or both)."""
        width, height = size if isinstance(size, tuple) else (size, size)
        return Material(partial(paint, self._rng(stream), *colours), width, height, glows=glows)

    @property
    def colours(self) -> list[Colour]:
        """Accents and the main colours, at least four."""
        return [*self.scheme.accents, self.scheme.feature, self.scheme.upholstery]

    def variant(self, number: int, **materials: Material) -> "Kit":
        """The same materials but for those given, with views, paintings and rugs of its own for each number."""
        made = copy(self)
        made._count = 1000 * number
        vars(made).update(materials)
        return made

    def _unique(self, paint: Callable[[Random], Picture], *, glows: bool = False) -> Material:
        self._count += 1
        return self._material(100 + self._count, paint, glows=glows)

    def view(self) -> Material:
        """Another view through a window."""
        return self._unique(pictures.view, glows=True)

    def painting(self, *, wide: bool) -> Material:
        """Another painting."""
        return self._unique(lambda rng: pictures.painting(rng, rng.shuffled(self.colours), wide=wide))

    def rug(self, width_m: float, depth_m: float) -> Material:
        """Another rug of the given size in metres."""
        return self._unique(lambda rng: pictures.rug(rng, rng.shuffled(self.colours), width_m, depth_m))
