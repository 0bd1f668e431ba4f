"""The empty room as numbers: outline, height, walls, windows and door."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from avp_habitat.scenes.builtin.dice import Dice

Point = tuple[float, float]


@dataclass(frozen=True)
class Wall:
    """A straight wall; seen from inside it runs from `start` to the right."""

    start: Point
    """x, z in metres."""
    along: Point
    """Unit vector to the right on the floor."""
    length: float
    """Metres."""

    @property
    def inward(self) -> Point:
        """Unit vector into the room on the floor."""
        return (-self.along[1], self.along[0])

    def axes(self) -> NDArray[np.float64]:
        """`(3, 3)`: columns are along, up and inward."""
        (ax, az), (nx, nz) = self.along, self.inward
        return np.array([[ax, 0.0, nx], [0.0, 1.0, 0.0], [az, 0.0, nz]])

    def point(self, right: float, inwards: float) -> Point:
        """x, z of a point that far along the wall and in front of it, metres."""
        (ax, az), (nx, nz) = self.along, self.inward
        return self.start[0] + ax * right + nx * inwards, self.start[1] + az * right + nz * inwards


@dataclass(frozen=True)
class Opening:
    """A window or door in a wall."""

    wall: int
    """Index of the wall."""
    left: float
    """Metres along the wall."""
    right: float
    """Metres along the wall."""
    bottom: float
    """Metres above the floor."""
    top: float
    """Metres above the floor."""
    kind: str
    """`"window"` or `"door"`."""


@dataclass(frozen=True)
class Shell:
    """The empty room."""

    corners: tuple[Point, ...]
    """Outline on the floor in the order of the walls, metres."""
    notch: tuple[float, float, float, float] | None
    """x0, z0, x1, z1 of the rectangle that an L-shaped room lacks."""
    ceiling: float
    """Metres above the floor."""
    openings: tuple[Opening, ...]
    """Windows and the door."""

    @cached_property
    def walls(self) -> tuple[Wall, ...]:
        """One wall from each corner to the next."""
        made = []
        for (x0, z0), (x1, z1) in zip(self.corners, self.corners[1:] + self.corners[:1], strict=True):
            length = abs(x1 - x0) + abs(z1 - z0)
            made.append(Wall((x0, z0), ((x1 - x0) / length, (z1 - z0) / length), length))
        return tuple(made)

    @cached_property
    def bounds(self) -> tuple[float, float, float, float]:
        """x0, z0, x1, z1 of the outline."""
        xs, zs = [x for x, _ in self.corners], [z for _, z in self.corners]
        return min(xs), min(zs), max(xs), max(zs)

    @property
    def floor_area(self) -> float:
        """Square metres."""
        x0, z0, x1, z1 = self.bounds
        missing = 0.0 if self.notch is None else (self.notch[2] - self.notch[0]) * (self.notch[3] - self.notch[1])
        return (x1 - x0) * (z1 - z0) - missing

    def contains(self, x0: float, z0: float, x1: float, z1: float) -> bool:
        """Whether a rectangle on the floor lies inside the outline."""
        left, near, right, far = self.bounds
        slack = 1e-6
        if x0 < left - slack or z0 < near - slack or x1 > right + slack or z1 > far + slack:
            return False
        if self.notch is None:
            return True
        a, b, c, d = self.notch
        return x1 <= a + slack or x0 >= c - slack or z1 <= b + slack or z0 >= d - slack

    def depth_at(self, wall: Wall, right: float) -> float:
        """Metres from a point of a wall straight to what stands opposite."""
        point, inward = wall.point(right, 0.0), wall.inward
        ahead = 0 if inward[0] else 1
        sign, aside = (1 if inward[ahead] > 0 else -1), 1 - ahead
        depth = (self.bounds[ahead + 2 if sign > 0 else ahead] - point[ahead]) * sign
        if self.notch is not None and self.notch[aside] < point[aside] < self.notch[aside + 2]:
            gap = (self.notch[ahead if sign > 0 else ahead + 2] - point[ahead]) * sign
            depth = min(depth, gap) if gap > 1e-6 else depth
        return round(depth, 2)


def _outline(dice: Dice) -> tuple[tuple[Point, ...], tuple[float, float, float, float] | None]:
    width, depth = dice.number(4.0, 8.0), dice.number(3.5, 6.5)
    x0, z0 = -round(width / 2, 2), -round(depth / 2, 2)
    x1, z1 = round(x0 + width, 2), round(z0 + depth, 2)
    if width < 5.2 or depth < 4.6 or dice.chance(0.4):
        return ((x0, z0), (x1, z0), (x1, z1), (x0, z1)), None
    wide = min(round(width * dice.number(0.32, 0.5), 2), width - 2.6)
    deep = min(round(depth * dice.number(0.32, 0.5), 2), depth - 2.4)
    corner = dice.whole(0, 3)
    if corner == 0:
        xa, za = round(x0 + wide, 2), round(z0 + deep, 2)
        return ((xa, z0), (x1, z0), (x1, z1), (x0, z1), (x0, za), (xa, za)), (x0, z0, xa, za)
    if corner == 1:
        xa, za = round(x1 - wide, 2), round(z0 + deep, 2)
        return ((x0, z0), (xa, z0), (xa, za), (x1, za), (x1, z1), (x0, z1)), (xa, z0, x1, za)
    if corner == 2:
        xa, za = round(x1 - wide, 2), round(z1 - deep, 2)
        return ((x0, z0), (x1, z0), (x1, za), (xa, za), (xa, z1), (x0, z1)), (xa, za, x1, z1)
    xa, za = round(x0 + wide, 2), round(z1 - deep, 2)
    return ((x0, z0), (x1, z0), (x1, z1), (xa, z1), (xa, za), (x0, za)), (x0, za, xa, z1)


def _window(dice: Dice, wall: int, length: float, ceiling: float) -> Opening:
    width = min(dice.number(1.1, 2.0), length - 1.4)
    left = round((length - width) * dice.number(0.35, 0.65), 2)
    bottom = dice.pick((0.85, 0.9, 0.95, 0.55))
    return Opening(wall, left, round(left + width, 2), bottom, round(min(ceiling - 0.35, 2.25), 2), "window")


def plan_shell(dice: Dice) -> Shell:
    """A rectangular or L-shaped room with one door and one to three windows on other walls."""
    corners, notch = _outline(dice)
    ceiling = dice.number(2.5, 3.2)
    shell = Shell(corners, notch, ceiling, ())
    walls = shell.walls
    order = dice.shuffled([index for index, wall in enumerate(walls) if wall.length >= 2.4])
    door_wall = walls[order[0]]
    left = 0.3 if dice.chance(0.5) else round(door_wall.length - 1.2, 2)
    openings = [Opening(order[0], left, round(left + 0.9, 2), 0.0, 2.05, "door")]
    windows = dice.whole(1, 2) if shell.floor_area < 24 else dice.whole(2, 3)
    for index in order[1 : 1 + windows]:
        openings.append(_window(dice, index, walls[index].length, ceiling))
    return Shell(corners, notch, ceiling, tuple(openings))
