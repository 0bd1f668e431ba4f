"""The colours and materials that one room is furnished with."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

from avp_habitat.scenes.builtin import finishes, pictures, textures
from avp_habitat.scenes.builtin.random import Dice
from avp_habitat.scenes.builtin.shapes import Material, Surface, Vector, moved
from avp_habitat.scenes.builtin.textures import Colour, blend, shade

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


@dataclass(frozen=True)
class Scheme:
    """Colours that go together, sRGB in [0, 1]."""

    wall: Colour
    """Most walls."""
    feature: Colour
    """The wall that stands out."""
    floor: Colour
    """Floor boards."""
    wood: Colour
    """Most wooden furniture."""
    upholstery: Colour
    """Sofa and armchair."""
    accents: tuple[Colour, Colour, Colour]
    """Cushions, rug, curtains, paintings, books."""


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


def legible(ground: Colour, ink: Colour) -> Colour:
    """The ink, darker where it would hardly show on the ground."""
    for _ in range(8):
        if abs(_brightness(ink) - _brightness(ground)) > 0.3:
            break
        ink = shade(ink, 0.87)
    return ink


class Kit:
    """Materials of one room, painted when first looked at and the same in whatever order that happens."""

    def __init__(self, seed: int) -> None:
        """Choose the colour scheme.

        Args:
            seed: of the room.
        """
        self._seed = seed
        dice = self._dice(0)
        scheme = dice.pick(SCHEMES)
        light = dice.number(0.96, 1.04)
        self.scheme = replace(scheme, floor=shade(scheme.floor, light), wood=shade(scheme.wood, dice.number(0.9, 1.1)))
        self._count = 0

    def _dice(self, stream: int) -> Dice:
        return Dice(self._seed, 1000 + stream)

    @property
    def colours(self) -> list[Colour]:
        """Accents and the main colours, at least four."""
        return [*self.scheme.accents, self.scheme.feature, self.scheme.upholstery]

    @cached_property
    def floor(self) -> Material:
        """Boards, parquet or tiles."""
        dice, colour = self._dice(1), self.scheme.floor
        kind = dice.whole(0, 5)
        if kind <= 2:
            return Material(partial(finishes.boards, dice, colour), 2.0, 1.67)
        if kind == 3:
            return Material(partial(finishes.parquet, dice, colour), 1.6, 1.6)
        ink = blend(self.scheme.feature, (0.3, 0.3, 0.35), 0.4)
        base = (0.88, 0.85, 0.79) if kind == 5 else blend(colour, (0.8, 0.75, 0.7), 0.5)
        return Material(partial(finishes.tiles, dice, base, ink, patterned=kind == 5), 1.5, 1.5)

    @cached_property
    def wall(self) -> Material:
        """Painted plaster."""
        return Material(partial(finishes.plaster, self._dice(2), self.scheme.wall), 1.8, 1.8)

    @cached_property
    def feature_wall(self) -> Material:
        """Wallpaper or brick."""
        dice = self._dice(3)
        if dice.chance(0.25):
            warm = blend(self.scheme.feature, (0.7, 0.42, 0.33), 0.7)
            return Material(partial(finishes.brick, dice, warm), 1.25, 1.2)
        ground = blend(self.scheme.feature, self.scheme.wall, dice.pick((0.0, 0.35, 0.7)))
        ink = blend(self.scheme.wall, self.scheme.feature, 0.1) if dice.chance(0.5) else shade(self.scheme.feature, 0.6)
        return Material(partial(finishes.wallpaper, dice, ground, legible(ground, ink)), 1.2, 1.2)

    @cached_property
    def papered_wall(self) -> Material:
        """A quieter wallpaper in the colour of most walls."""
        ink = blend(self.scheme.wall, self.scheme.feature, 0.85)
        ink = legible(self.scheme.wall, ink)
        return Material(partial(finishes.wallpaper, self._dice(4), self.scheme.wall, ink), 1.0, 1.0)

    @cached_property
    def ceiling(self) -> Material:
        """White plaster."""
        return Material(partial(finishes.plaster, self._dice(5), (0.96, 0.96, 0.95)), 2.4, 2.4)

    @cached_property
    def trim(self) -> Material:
        """White paint of frames, doors and skirting."""
        return Material(partial(finishes.paint, self._dice(6), (0.96, 0.96, 0.94)), 1.2, 0.6)

    @cached_property
    def wood(self) -> Material:
        """The wood of most furniture."""
        return Material(partial(finishes.wood, self._dice(7), self.scheme.wood), 1.2, 0.6)

    @cached_property
    def dark_wood(self) -> Material:
        """A darker wood for legs and frames."""
        return Material(partial(finishes.wood, self._dice(8), shade(self.scheme.wood, 0.6)), 1.2, 0.6)

    @cached_property
    def upholstery(self) -> Material:
        """Coarse cloth of the sofa."""
        colour = self.scheme.upholstery
        return Material(
            partial(textures.weave, self._dice(9), shade(colour, 1.1), blend(colour, (1, 1, 1), 0.5)), 0.6, 0.6
        )

    @cached_property
    def second_cloth(self) -> Material:
        """Coarse cloth of armchairs and chairs."""
        colour = self.scheme.accents[self._dice(10).whole(0, 1)]
        return Material(partial(textures.weave, self._dice(10), shade(colour, 1.05), shade(colour, 0.6)), 0.6, 0.6)

    @cached_property
    def cushions(self) -> list[Material]:
        """Printed cloths for pillows."""
        made = []
        for index in range(3):
            dice = self._dice(20 + index)
            first, second, third = dice.shuffled([*self.scheme.accents])
            made.append(Material(partial(textures.printed, dice, (first, second, third)), 0.5, 0.5))
        return made

    @cached_property
    def curtain(self) -> Material:
        """Printed cloth of the curtains."""
        dice, accents = self._dice(30), self.scheme.accents
        ground = blend(accents[2], (0.95, 0.93, 0.9), 0.5)
        return Material(partial(textures.printed, dice, (ground, accents[0], accents[1])), 0.7, 0.7)

    @cached_property
    def bedding(self) -> Material:
        """The quilt."""
        first, second, third = self._dice(31).shuffled([*self.scheme.accents])
        return Material(
            partial(textures.bedding, self._dice(31), (blend(first, (1, 1, 1), 0.4), second, third)), 1.2, 1.2
        )

    @cached_property
    def linen(self) -> Material:
        """Light cloth of mattress and pillows."""
        return Material(partial(textures.weave, self._dice(32), (0.93, 0.91, 0.87), (0.75, 0.77, 0.82)), 0.6, 0.6)

    @cached_property
    def metal(self) -> Material:
        """Dark or brass-like metal."""
        colour = self._dice(33).pick(((0.28, 0.28, 0.30), (0.72, 0.58, 0.34), (0.62, 0.63, 0.65)))
        return Material(partial(finishes.brushed, self._dice(33), colour), 0.4, 0.4)

    @cached_property
    def black(self) -> Material:
        """Black plastic."""
        return Material(partial(finishes.speckled, self._dice(34), (0.12, 0.12, 0.13), (0.2, 0.2, 0.22)), 0.4, 0.4)

    @cached_property
    def ceramics(self) -> list[Material]:
        """Glazes of pots and vases."""
        made = []
        for index, colour in enumerate((*self.scheme.accents[:2], (0.88, 0.86, 0.82))):
            dice = self._dice(40 + index)
            made.append(
                Material(partial(finishes.speckled, dice, colour, shade(colour, dice.pick((0.5, 1.5)))), 0.4, 0.4)
            )
        return made

    @cached_property
    def stone(self) -> Material:
        """Marble of table tops."""
        base, vein = self._dice(50).pick(
            (((0.93, 0.92, 0.90), (0.5, 0.5, 0.54)), ((0.3, 0.36, 0.33), (0.8, 0.82, 0.76)))
        )
        return Material(partial(finishes.marble, self._dice(50), base, vein), 1.2, 1.2)

    @cached_property
    def wicker(self) -> Material:
        """Basket weave."""
        return Material(partial(finishes.wicker, self._dice(51), (0.80, 0.62, 0.40)), 0.3, 0.3)

    @cached_property
    def leaf(self) -> Material:
        """One leaf."""
        green = self._dice(52).pick(((0.26, 0.45, 0.22), (0.34, 0.50, 0.28), (0.22, 0.40, 0.30)))
        return Material(partial(finishes.foliage, self._dice(52), green), 1.0, 1.0)

    @cached_property
    def books(self) -> Material:
        """The atlas of book spines."""
        return Material(partial(pictures.spines, self._dice(53), self.colours), 1.0, 1.0)

    @cached_property
    def lampshade(self) -> Material:
        """Cloth that is lit from behind."""
        cloth = partial(textures.weave, self._dice(54), (0.99, 0.91, 0.74), (0.9, 0.78, 0.56))
        return Material(cloth, 0.4, 0.4, glows=True)

    @cached_property
    def screen(self) -> Material:
        """A computer screen that is on."""
        return Material(partial(pictures.screen, self._dice(55), self.colours), 1.0, 1.0, glows=True)

    @cached_property
    def television(self) -> Material:
        """A film on the television."""
        return Material(partial(pictures.film, self._dice(56), self.colours), 1.0, 1.0, glows=True)

    @cached_property
    def keys(self) -> Material:
        """A keyboard."""
        return Material(partial(pictures.keys, self._dice(57)), 1.0, 1.0)

    def _next(self) -> Dice:
        self._count += 1
        return self._dice(100 + self._count)

    def _unique(self, paint: Callable[[Dice], finishes.Picture], *, glows: bool = False) -> Material:
        return Material(partial(paint, self._next()), 1.0, 1.0, glows=glows)

    def view(self) -> Material:
        """Another view through a window."""
        return self._unique(pictures.view, glows=True)

    def painting(self, *, wide: bool) -> Material:
        """Another painting."""
        return self._unique(lambda dice: pictures.painting(dice, dice.shuffled(self.colours), wide=wide))

    def rug(self, width_m: float, depth_m: float) -> Material:
        """Another rug of the given size in metres."""
        return self._unique(lambda dice: textures.rug(dice, dice.shuffled(self.colours), width_m, depth_m))
