"""Furnishes a home, each room for its use, so that most of the floor stays walkable."""

from collections.abc import Callable
from dataclasses import replace
from itertools import product

from avp_habitat.scenes.builtin import decor, groups, seating
from avp_habitat.scenes.builtin.furnish import (
    FloorPlan,
    Placed,
    Spots,
    anywhere,
    at_wall,
    hang_lamp,
    hang_pictures,
    in_corners,
    places,
    put,
    stand_at,
)
from avp_habitat.scenes.builtin.groups import Arrange, Group, Member, against_wall
from avp_habitat.scenes.builtin.home import fittings
from avp_habitat.scenes.builtin.home.plan import Room
from avp_habitat.scenes.builtin.kit import Kit
from avp_habitat.scenes.builtin.noise import Random

Make = Callable[[Kit, Random], list[Arrange]]
"""Ways to arrange something, the fullest first."""

WALKABLE = 0.51
"""Share of a home's floor that stays walkable, by the careful count of `FloorPlan`; 0.05 more for an agent of 0.1 m."""
_LEAST_IN_ROOM = 0.36
"""And of each room's."""
_PICTURE_M2 = 4.0
"""Floor for each picture."""
_LAMP_M = 3.2
"""Between lamps of a long ceiling."""


def _alone(make: Callable, clear: float) -> Make:
    """One piece at a wall with free floor before it, metres."""
    return lambda kit, rng: [against_wall(make(kit, rng), clear)]


def _one(make: Callable[[Kit, Random], Arrange]) -> Make:
    """A group that is arranged in one way."""
    return lambda kit, rng: [make(kit, rng)]


def _counter(kit: Kit, rng: Random) -> list[Arrange]:
    return [against_wall(fittings.kitchen_counter(kit, rng.spawn(), width), 0.75) for width in (2.8, 2.3, 1.8)]


def _sleeping(kit: Kit, rng: Random) -> list[Arrange]:
    arrange = groups.sleeping(kit, rng)

    def covered(depth: float) -> Group | None:
        group = arrange(depth)
        if group is None:
            return None
        bed, *others = group.members
        return replace(group, members=(replace(bed, piece=fittings.covered(kit, bed.piece)), *others))

    return [covered]


_SHELF, _WARDROBE, _DRAWERS = _alone(decor.bookshelf, 0.55), _alone(decor.wardrobe, 0.6), _alone(decor.drawers, 0.5)
_TABLE, _BASKET, _BOXES = (
    _alone(make, clear) for make, clear in ((seating.side_table, 0.3), (fittings.basket, 0.0), (fittings.boxes, 0.2))
)
_PLANT, _DESK, _DINING = _alone(decor.plant, 0.0), _one(groups.working), _one(groups.dining)
_MAIN: dict[str, tuple[Make, ...]] = {
    "living": (groups.living,),
    "kitchen": (_counter, _alone(fittings.fridge, 0.6)),
    "bedroom": (_sleeping,),
    "study": (_DESK,),
    "bath": (_alone(fittings.toilet, 0.5), _alone(fittings.wash_stand, 0.6), _alone(fittings.bath_tub, 0.5)),
    "corridor": (),
}
"""What a room is for."""
_EXTRA: dict[str, tuple[Make, ...]] = {
    "living": (_DINING, _SHELF, groups.reading, _PLANT, _DRAWERS, _BASKET, _PLANT, _SHELF),
    "kitchen": (_DINING, _PLANT, _BASKET, _DRAWERS),
    "bedroom": (_WARDROBE, _DRAWERS, _PLANT, _DESK, _BASKET, _BOXES, groups.reading),
    "study": (_SHELF, groups.reading, _BOXES, _SHELF, _PLANT, _DRAWERS),
    "bath": (_BASKET, _PLANT),
    "corridor": (_alone(fittings.shoe_cabinet, 0.4), _BASKET, _TABLE, _BOXES),
}
"""And what comes to it while there is floor."""
_SPOTS: dict[Make, Spots] = {_DINING: anywhere, _PLANT: in_corners}


class _Home:
    """Rooms that fill with furniture, one floor plan each."""

    def __init__(self, rooms: list[Room], kits: list[Kit]) -> None:
        self.rooms, self.kits = rooms, kits
        self.floors = [FloorPlan(room.shell) for room in rooms]
        self._walkable = [floor.walkable_share() * floor.shell.floor_area for floor in self.floors]

    @property
    def walkable_share(self) -> float:
        """Of the floor of all rooms."""
        return sum(self._walkable) / sum(floor.shell.floor_area for floor in self.floors)

    def put(self, index: int, rng: Random, make: Make) -> None:
        """Place something in a room, if the home stays walkable as a whole and in that room."""
        floor = self.floors[index]
        spare = sum(self._walkable) - WALKABLE * sum(each.shell.floor_area for each in self.floors)
        least = max(_LEAST_IN_ROOM, (self._walkable[index] - spare) / floor.shell.floor_area)
        spots = _SPOTS.get(make, at_wall)
        if any(put(floor, rng, arrange, spots, least) for arrange in make(self.kits[index], rng)):
            self._count(index)

    def open_door(self, index: int, rng: Random) -> None:
        """Hang the leaves of a room's doorways, each open before the wall beside it where there is room."""
        floor = self.floors[index]
        for hole in floor.shell.openings:
            if hole.kind == "passage" and rng.chance(0.6):
                width, wall = hole.right - hole.left, floor.shell.walls[hole.wall]
                leaf = Group((Member(fittings.open_leaf(self.kits[index], width - 0.02), 0.0, 0.08),))
                beside = (hole.right + 0.12 + width / 2, hole.left - 0.12 - width / 2)
                any(floor.try_group(leaf, wall, right, least_share=_LEAST_IN_ROOM) for right in beside)
        self._count(index)

    def _count(self, index: int) -> None:
        floor = self.floors[index]
        self._walkable[index] = floor.walkable_share() * floor.shell.floor_area


def _hang_ceiling_lamps(floor: FloorPlan, kit: Kit) -> None:
    """Flat lamps along the middle of a ceiling."""
    ceiling, wall = floor.shell.ceiling, max(floor.shell.walls, key=lambda wall: wall.length)
    lamp, half = fittings.ceiling_lamp(kit, ceiling), floor.shell.depth_at(wall, wall.length / 2) / 2
    count = max(1, round(wall.length / _LAMP_M))
    for right in places(wall.length / count / 2, wall.length, round(wall.length / count, 2)):
        stand = stand_at(Member(lamp, 0.0, 0.0), wall, right, half)
        if floor.is_free(stand, ceiling - 0.12, ceiling, 0.02):
            floor.hang(stand, ceiling - 0.12, ceiling)


def _hang(use: str, floor: FloorPlan, rng: Random, kit: Kit) -> None:
    """Lamps and pictures of a room."""
    if use in ("living", "kitchen", "bedroom"):
        hang_lamp(floor, rng, kit)
    else:
        _hang_ceiling_lamps(floor, kit)
    hang_pictures(floor, rng, kit, 1 + round(floor.shell.floor_area / _PICTURE_M2))


def furnish_home(rooms: list[Room], rng: Random, kits: list[Kit]) -> tuple[list[list[Placed]], float]:
    """Furniture by room.

    Args:
        rooms: of a home.
        rng: decides.
        kits: of each room, what its furniture is made of.

    Returns:
        Pieces by room, and the share of the home's floor that stays walkable: one part in every room, with each doorway
        in it.
    """
    home = _Home(rooms, kits)
    order = rng.shuffled(list(range(len(rooms))))
    for index in order:
        for make in _MAIN[rooms[index].use]:
            home.put(index, rng.spawn(), make)
    for index in order:
        if rooms[index].use != "corridor":
            home.open_door(index, rng.spawn())
    for turn, index in product(range(max(map(len, _EXTRA.values()))), order):
        for make in _EXTRA[rooms[index].use][turn : turn + 1]:
            home.put(index, rng.spawn(), make)
    for room, floor, kit in zip(rooms, home.floors, kits, strict=True):
        _hang(room.use, floor, rng.spawn(), kit)
    return [floor.placed for floor in home.floors], home.walkable_share
