"""The empty home: what each room is for, its walls and height, doorways that connect all rooms, windows."""

from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from avp_habitat.scenes.builtin.home.cells import Plot, plan_cells
from avp_habitat.scenes.builtin.noise import Random
from avp_habitat.scenes.builtin.shapes import Rectangle
from avp_habitat.scenes.builtin.shell import WALL_M, Opening, Shell, plan_window

MOST_ROOMS = 6
"""Corridors are not counted."""
LEAST_M2, MOST_M2 = 30.0, 150.0
"""Floor of a home, walls not counted."""
_CORNER_M = 0.16
"""Wall that is left between a doorway and a corner."""
_WIDEST_DOORWAY_M = 1.0
_DOORWAY_WALL_M = WALL_M + 2 * _CORNER_M + _WIDEST_DOORWAY_M
_WINDOW_WALL_M, _DOOR_WALL_M = 2.4, 1.2
"""Least stretches of outer wall for a window and the front door."""
_RANK = {"corridor": 0, "living": 1, "kitchen": 2, "study": 3, "bedroom": 3, "bath": 4}
"""Doors lead rather from rooms of a low rank."""
_LARGEST_BATH_M2 = 14.0
_SIDES = 4


@dataclass(frozen=True)
class Room:
    """One room of a home, or a corridor."""

    use: str
    """`living`, `kitchen`, `bedroom`, `study`, `bath` or `corridor`."""
    shell: Shell


@dataclass(frozen=True)
class _Stretch:
    """A part of one side of a cell, metres along x or z."""

    cell: int
    side: int
    """Of the wall, in the order of a shell's walls."""
    start: float
    end: float

    @property
    def length(self) -> float:
        return round(self.end - self.start, 2)


def _side(cell: Plot, side: int) -> tuple[float, float, float]:
    """Where a side lies across its direction, and where it begins and ends along it."""
    x0, z0, x1, z1 = cell.area
    return ((z0, x0, x1), (x1, z0, z1), (z1, x0, x1), (x0, z0, z1))[side]


def _shared(cells: list[Plot], first: int, second: int) -> _Stretch | None:
    """The stretch of the first cell's side at which the second one lies."""
    for side in range(_SIDES):
        across, start, end = _side(cells[first], side)
        there, begin, stop = _side(cells[second], (side + 2) % _SIDES)
        if across == there and min(end, stop) - max(start, begin) > 0:
            return _Stretch(first, side, max(start, begin), min(end, stop))
    return None


def _outer(cells: list[Plot]) -> list[_Stretch]:
    """Stretches at which no other cell lies."""
    found = []
    for index, cell in enumerate(cells):
        others = [_shared(cells, index, other) for other in range(len(cells)) if other != index]
        for side in range(_SIDES):
            _, at, end = _side(cell, side)
            for other in sorted((each for each in others if each and each.side == side), key=lambda each: each.start):
                found.append(_Stretch(index, side, at, other.start))
                at = other.end
            found.append(_Stretch(index, side, at, end))
    return [each for each in found if each.length > 0]


def _uses(rng: Random, cells: list[Plot]) -> list[str]:
    """What each cell is for, by size: the largest room is lived in, the smallest of four or more is the bath."""
    rooms = sorted((i for i, cell in enumerate(cells) if not cell.corridor), key=lambda i: cells[i].sides, reverse=True)
    rooms.sort(key=lambda index: -np.prod(cells[index].sides).round(2))
    uses = ["corridor"] * len(cells)
    uses[rooms.pop(0)] = "living"
    if len(rooms) >= 3 and np.prod(cells[rooms[-1]].sides) < _LARGEST_BATH_M2:
        uses[rooms.pop()] = "bath"
    rest = ["bedroom", "kitchen", "study" if rng.chance(0.5) else "bedroom", "bedroom", "bedroom"]
    if len(rooms) == 1 and rng.chance(0.3):
        rest = ["kitchen"]
    for index, use in zip(rooms, rest, strict=False):
        uses[index] = use
    return uses


def _connected(rng: Random, cells: list[Plot], uses: list[str]) -> list[tuple[int, _Stretch]] | None:
    """Walls that get a doorway, with the cell behind: a tree from corridors and the living room on, and some more.

    None where a cell has no wall that is long enough.
    """
    pairs = rng.shuffled(list(combinations(range(len(cells)), 2)))
    walls = [(b, wall) for a, b in pairs if (wall := _shared(cells, a, b)) and wall.length >= _DOORWAY_WALL_M]
    ranks = [sorted((_RANK[uses[wall.cell]], _RANK[uses[behind]])) for behind, wall in walls]
    part, chosen = list(range(len(cells))), []
    for index in sorted(range(len(walls)), key=lambda index: ranks[index]):
        behind, wall = walls[index]
        if part[wall.cell] != part[behind]:
            joined = part[behind]
            part = [part[wall.cell] if each == joined else each for each in part]
            chosen.append(walls[index])
        elif ranks[index][0] <= 1 and ranks[index][1] <= 2 and rng.chance(0.35):
            chosen.append(walls[index])
    return chosen if len(set(part)) == 1 else None


def _without_passage_baths(uses: list[str], walls: list[tuple[int, _Stretch]]) -> list[str]:
    """The same uses, but that nobody has to cross a bath."""
    ends = [end for behind, wall in walls for end in (behind, wall.cell)]
    return ["study" if use == "bath" and ends.count(index) > 1 else use for index, use in enumerate(uses)]


def _inner(cell: Plot) -> Rectangle:
    """The floor between a cell's walls."""
    half = WALL_M / 2
    x0, z0, x1, z1 = (round(each + move, 2) for each, move in zip(cell.area, (half, half, -half, -half), strict=True))
    return x0, z0, x1, z1


def _opening(cell: Plot, side: int, start: float, end: float, top: float, kind: str) -> Opening:
    """A hole from the floor up between two places along a side, in the frame of its wall."""
    x0, z0, x1, z1 = _inner(cell)
    left = (start - x0, start - z0, x1 - end, z1 - end)[side]
    return Opening(side, round(left, 2), round(left + end - start, 2), 0.0, top, kind)


def _doorways(rng: Random, cells: list[Plot], walls: list[tuple[int, _Stretch]]) -> list[list[Opening]]:
    """Open doorways by cell, each in both of its walls, near a corner or anywhere."""
    openings: list[list[Opening]] = [[] for _ in cells]
    for behind, wall in walls:
        width, top = rng.uniform(0.8, _WIDEST_DOORWAY_M), rng.uniform(2.0, 2.12)
        least, most = wall.start + WALL_M / 2 + _CORNER_M, wall.end - WALL_M / 2 - _CORNER_M - width
        start = rng.choice((least, most, least + (most - least) * rng.uniform(0.0, 1.0)))
        start = round(start, 2)
        for index, side in ((wall.cell, wall.side), (behind, (wall.side + 2) % _SIDES)):
            openings[index].append(_opening(cells[index], side, start, round(start + width, 2), top, "passage"))
    return openings


def _add_front_door(cells: list[Plot], uses: list[str], outer: list[_Stretch], openings: list[list[Opening]]) -> None:
    """A closed door from a corridor, or else the living room, to the outside; takes its stretch of wall."""
    fitting = [each for each in outer if each.length >= _DOOR_WALL_M]
    wall = min(fitting, key=lambda each: (_RANK[uses[each.cell]], each.length))
    start = round((wall.start + wall.end) / 2 - 0.45, 2)
    openings[wall.cell].append(_opening(cells[wall.cell], wall.side, start, round(start + 0.9, 2), 2.05, "door"))
    outer.remove(wall)


def _add_windows(
    rng: Random, cells: list[Plot], outer: list[_Stretch], ceilings: list[float], openings: list[list[Opening]]
) -> None:
    """One window in each room that has outer walls, two in large ones."""
    for index, cell in enumerate(cells):
        walls = [each for each in outer if each.cell == index and each.length >= _WINDOW_WALL_M + WALL_M]
        wanted = 2 if np.prod(cell.sides) > 17 else 1
        for wall in rng.shuffled(walls)[:wanted]:
            start, end = round(wall.start + WALL_M / 2, 2), round(wall.end - WALL_M / 2, 2)
            hole = plan_window(rng, wall.side, round(end - start, 2), ceilings[index])
            begin = _opening(cell, wall.side, start, end, 0.0, "").left
            left, right = round(hole.left + begin, 2), round(hole.right + begin, 2)
            openings[index].append(replace(hole, left=left, right=right))


def _ceilings(rng: Random, uses: list[str]) -> list[float]:
    """Heights in metres: the living room's is the greatest as a rule, corridors and baths are low."""
    base = rng.uniform(2.5, 2.85)
    added = {"living": (0.0, 0.5), "corridor": (-0.15, 0.0), "bath": (-0.12, 0.05)}
    return [round(base + rng.uniform(*added.get(use, (-0.08, 0.25))), 2) for use in uses]


def plan_home(rng: Random, count: int) -> list[Room] | None:
    """The empty rooms of a home, in no order; None where the plan came to nothing."""
    cells = plan_cells(rng, count)
    if cells is None:
        return None
    uses = _uses(rng, cells)
    walls = _connected(rng, cells, uses)
    if walls is None:
        return None
    uses = _without_passage_baths(uses, walls)
    openings, outer, ceilings = _doorways(rng, cells, walls), _outer(cells), _ceilings(rng, uses)
    _add_front_door(cells, uses, outer, openings)
    _add_windows(rng, cells, outer, ceilings, openings)
    rooms = []
    for index, cell in enumerate(cells):
        x0, z0, x1, z1 = _inner(cell)
        corners = ((x0, z0), (x1, z0), (x1, z1), (x0, z1))
        rooms.append(Room(uses[index], Shell(corners, None, ceilings[index], tuple(openings[index]))))
    return rooms if LEAST_M2 <= sum(room.shell.floor_area for room in rooms) <= MOST_M2 else None
