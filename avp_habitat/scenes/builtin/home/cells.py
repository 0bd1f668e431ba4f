"""A floor plan: a rectangle or an L cut again and again into rooms, with a corridor where there are many."""

from dataclasses import dataclass, replace
from itertools import accumulate, pairwise

import numpy as np

from avp_habitat.scenes.builtin.noise import Random
from avp_habitat.scenes.builtin.shapes import Rectangle

LEAST_SIDE_M = 2.4
"""Shortest side of a room."""
_LONGEST_SHAPE = 2.5
"""A room's long side over its short one."""


@dataclass(frozen=True)
class Plot:
    """A room on the plan, to the middles of its walls."""

    area: Rectangle
    """x0, z0, x1, z1 in metres."""
    corridor: bool = False

    @property
    def sides(self) -> tuple[float, float]:
        """Shorter and longer side."""
        x0, z0, x1, z1 = self.area
        short, long = sorted((round(x1 - x0, 2), round(z1 - z0, 2)))
        return short, long

    @property
    def is_sound(self) -> bool:
        """Whether the room is neither too narrow nor too long."""
        short, long = self.sides
        return self.corridor or (short >= LEAST_SIDE_M and long <= _LONGEST_SHAPE * short)


def _turned(cells: list[Plot]) -> list[Plot]:
    """The plan with x and z exchanged."""
    return [replace(cell, area=(z0, x0, z1, x1)) for cell in cells for x0, z0, x1, z1 in [cell.area]]


def _mirrored(cells: list[Plot]) -> list[Plot]:
    """The plan with left and right exchanged."""
    return [replace(cell, area=(-x1, z0, -x0, z1)) for cell in cells for x0, z0, x1, z1 in [cell.area]]


def _cuts(rng: Random, start: float, end: float, count: int) -> list[float]:
    """Where a stretch is cut into parts of unlike lengths, both ends included; metres."""
    shares = [rng.uniform(0.6, 1.4) for _ in range(count)]
    inner = [round(start + (end - start) * share / sum(shares), 2) for share in accumulate(shares[:-1])]
    return [start, *inner, end]


def _row(rng: Random, area: Rectangle, count: int) -> list[Plot]:
    """Rooms side by side along x."""
    x0, z0, x1, z1 = area
    cuts = _cuts(rng, x0, x1, count)
    return [Plot((a, z0, b, z1)) for a, b in pairwise(cuts)]


def _halved(rng: Random, area: Rectangle, count: int) -> list[Plot]:
    """Two parts along the longer side, each cut on."""
    x0, z0, x1, z1 = area
    if z1 - z0 > x1 - x0:
        return _turned(_halved(rng, (z0, x0, z1, x1), count))
    first = count // 2
    share = rng.uniform(0.42, 0.58) * 2 * first / count
    middle = round(x0 + (x1 - x0) * min(share, 0.62), 2)
    return [*_divided(rng, (x0, z0, middle, z1), first), *_divided(rng, (middle, z0, x1, z1), count - first)]


def _divided(rng: Random, area: Rectangle, count: int) -> list[Plot]:
    return [Plot(area)] if count == 1 else _halved(rng, area, count)


def _along_corridor(rng: Random, area: Rectangle, count: int) -> list[Plot]:
    """A corridor along x with rooms on one side or both."""
    x0, z0, x1, z1 = area
    wide, deep = rng.uniform(1.2, 1.6), z1 - z0
    if count >= 3 and deep - wide >= 2 * LEAST_SIDE_M + 0.2:
        low = round(z0 + (deep - wide) * rng.uniform(0.44, 0.56), 2)
        high, first = round(low + wide, 2), rng.choice((count // 2, count - count // 2))
        rooms = [*_row(rng, (x0, z0, x1, low), first), *_row(rng, (x0, high, x1, z1), count - first)]
        return [Plot((x0, low, x1, high), corridor=True), *rooms]
    edge = round(z0 + wide, 2)
    return [Plot((x0, z0, x1, edge), corridor=True), *_row(rng, (x0, edge, x1, z1), count)]


def _with_living_room(rng: Random, area: Rectangle, count: int) -> list[Plot]:
    """A large room at one end, the others along a corridor that leads there."""
    x0, z0, x1, z1 = area
    share = rng.uniform(1.3, 1.8) / (count + 0.6)
    edge = round(x0 + (x1 - x0) * share, 2)
    return [Plot((x0, z0, edge, z1)), *_along_corridor(rng, (edge, z0, x1, z1), count - 1)]


def _block(rng: Random, area: Rectangle, count: int) -> list[Plot]:
    """Rooms in a rectangle, with a corridor where there are three or more."""
    x0, z0, x1, z1 = area
    if z1 - z0 > x1 - x0:
        return _turned(_block(rng, (z0, x0, z1, x1), count))
    if count <= 2 or (count == 3 and rng.chance(0.4)):
        return _divided(rng, area, count)
    return (_with_living_room if rng.chance(0.65) else _along_corridor)(rng, area, count)


def _outline(rng: Random, count: int, size_m2: float) -> list[tuple[Rectangle, int]]:
    """One rectangle, or the two of an L, each with its number of rooms."""
    if count == 2 or rng.chance(0.55):
        width = round(float(np.sqrt(size_m2 * rng.uniform(1.05, 1.75))), 2)
        return [((0.0, 0.0, width, round(size_m2 / width, 2)), count)]
    share = rng.uniform(0.28, 0.46)
    width = round(float(np.sqrt(size_m2 * (1 - share) * rng.uniform(1.3, 2.1))), 2)
    deep = round(size_m2 * (1 - share) / width, 2)
    wing = round(width * rng.uniform(0.4, 0.62), 2)
    far = round(deep + size_m2 * share / wing, 2)
    rooms = min(count - 1, max(1, round(count * share)))
    return [((0.0, 0.0, width, deep), count - rooms), ((0.0, deep, wing, far), rooms)]


def plan_cells(rng: Random, count: int) -> list[Plot] | None:
    """So many rooms and their corridors around the origin; None where one came out too narrow or too long."""
    size_m2 = min(max(count * rng.uniform(13.0, 27.0), 35.0), 155.0)
    cells = [cell for area, rooms in _outline(rng, count, size_m2) for cell in _block(rng, area, rooms)]
    if not all(cell.is_sound for cell in cells):
        return None
    for change in (_mirrored, _turned, _mirrored):
        cells = change(cells) if rng.chance(0.5) else cells
    return _centred(cells)


def _centred(cells: list[Plot]) -> list[Plot]:
    """The plan with its middle at the origin, to the centimetre."""
    bounds = np.array([cell.area for cell in cells])
    x, z = ((bounds[:, :2].min(axis=0) + bounds[:, 2:].max(axis=0)) / 2).tolist()
    moved = []
    for cell in cells:
        x0, z0, x1, z1 = (round(each - middle, 2) for each, middle in zip(cell.area, (x, z, x, z), strict=True))
        moved.append(replace(cell, area=(x0, z0, x1, z1)))
    return moved
