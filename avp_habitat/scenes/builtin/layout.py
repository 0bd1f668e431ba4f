"""Which furniture a room gets and where it is tried first."""

from collections.abc import Iterable, Iterator

from avp_habitat.scenes.builtin import decor, groups, storage, tables
from avp_habitat.scenes.builtin.dice import Dice
from avp_habitat.scenes.builtin.floorplan import Floor, Placed, places
from avp_habitat.scenes.builtin.groups import Arrange
from avp_habitat.scenes.builtin.hanging import hang_lamp, hang_pictures
from avp_habitat.scenes.builtin.kit import Kit
from avp_habitat.scenes.builtin.shell import Shell, Wall

Spot = tuple[Wall, float, float]
"""A wall, metres along it and metres in front of it."""

MAIN, EXTRA, SMALL = 0.45, 0.42, 0.41
"""Share of the floor that stays walkable after placing main groups, storage, and what fills corners."""


def _put(floor: Floor, arrange: Arrange, spots: Iterable[Spot], least_share: float) -> bool:
    """Place a group at the first spot where it fits and leaves enough of the floor walkable."""
    for wall, right, inwards in spots:
        group = arrange(floor.shell.depth_at(wall, right) - inwards)
        if group is not None and floor.try_group(group, wall, right, inwards, least_share=least_share):
            return True
    return False


def _at_walls(floor: Floor, dice: Dice) -> Iterator[Spot]:
    """Places along all walls in random order."""
    for wall in dice.shuffled(floor.shell.walls):
        for right in dice.shuffled(places(0.3, wall.length - 0.3, 0.2)):
            yield wall, right, 0.0


def _in_corners(floor: Floor, dice: Dice, distance: float) -> Iterator[Spot]:
    """Places at walls, a distance in metres from their ends, in random order."""
    for wall in dice.shuffled(floor.shell.walls):
        for right in dice.shuffled([distance, wall.length - distance]):
            yield wall, right, 0.0


def _anywhere(floor: Floor, dice: Dice) -> Iterator[Spot]:
    """Places in the open floor in random order."""
    for wall in dice.shuffled(floor.shell.walls):
        spots = [(r, i) for r in places(0.6, wall.length - 0.5, 0.3) for i in places(0.1, 4.0, 0.3)]
        for right, inwards in dice.shuffled(spots)[:120]:
            yield wall, right, inwards


def _across(floor: Floor, dice: Dice) -> Iterator[Spot]:
    """Places at long walls, away from their ends, in random order."""
    for wall in dice.shuffled([wall for wall in floor.shell.walls if wall.length >= 3.0]):
        for share in dice.shuffled([0.3, 0.36, 0.43, 0.5, 0.57, 0.64, 0.7]):
            yield wall, round(wall.length * share, 2), 0.0


def _storage(kit: Kit, dice: Dice) -> list[Arrange]:
    """Tall and low furniture for walls, the second shelf and chest last."""
    first = [
        groups.against_wall(storage.bookshelf(kit, dice), 0.55),
        groups.against_wall(storage.wardrobe(kit, dice), 0.6),
        groups.against_wall(storage.drawers(kit, dice), 0.5),
    ]
    second = [
        groups.against_wall(storage.bookshelf(kit, dice), 0.55),
        groups.against_wall(storage.drawers(kit, dice), 0.5),
    ]
    return dice.shuffled(first) + second


def _put_living(floor: Floor, dice: Dice, kit: Kit) -> bool:
    """Sofa, television and what belongs to them, as much as fits."""
    return any(_put(floor, arrange, _at_walls(floor, dice), MAIN) for arrange in groups.living(kit, dice))


def _put_main_groups(floor: Floor, dice: Dice, kit: Kit) -> None:
    """What the room is for, by its size, and what parts it."""
    area = floor.shell.floor_area
    sleeps = dice.chance(0.6 if area > 22 else 0.4)
    sits = area > 20 or not sleeps
    sits = sits and _put_living(floor, dice, kit)
    sleeps = (sleeps or not sits) and _put(floor, groups.sleeping(kit, dice), _at_walls(floor, dice), MAIN)
    if not sits and not sleeps:
        sits = _put_living(floor, dice, kit)
    if not (sits and sleeps) or area > 30:
        _put(floor, groups.dining(kit, dice), _anywhere(floor, dice), MAIN)
    any(_put(floor, arrange, _across(floor, dice), MAIN) for arrange in groups.divider(kit, dice, floor.shell.ceiling))


def _put_the_rest(floor: Floor, dice: Dice, kit: Kit) -> None:
    """Desk, storage, a place to read, and what fills corners, as long as the floor stays walkable."""
    first, *rest = _storage(kit, dice)
    for arrange in (groups.working(kit, dice), first):
        _put(floor, arrange, _at_walls(floor, dice), EXTRA)
    any(_put(floor, arrange, _at_walls(floor, dice), EXTRA) for arrange in groups.reading(kit, dice))
    for arrange in rest:
        _put(floor, arrange, _at_walls(floor, dice), EXTRA)
    for _ in range(2):
        _put(floor, groups.against_wall(decor.plant(kit, dice), 0.0), _in_corners(floor, dice, 0.42), SMALL)
    if sum(stand.piece.kind == "side table" for stand in floor.placed) < 2:
        _put(floor, groups.against_wall(tables.side_table(kit, dice), 0.3), _at_walls(floor, dice), SMALL)


def furnish(shell: Shell, dice: Dice, kit: Kit) -> list[Placed]:
    """Furniture of a room, none of it in another's place, the door free, the floor walkable and in one part."""
    floor = Floor(shell)
    _put_main_groups(floor, dice, kit)
    _put_the_rest(floor, dice, kit)
    hang_lamp(floor, dice, kit)
    hang_pictures(floor, dice, kit)
    return floor.placed
