"""Which furniture a room gets and where it is tried first."""

import numpy as np

from avp_habitat.scenes.builtin import decor, groups, storage, tables
from avp_habitat.scenes.builtin.dice import Dice
from avp_habitat.scenes.builtin.floorplan import Floor, Placed
from avp_habitat.scenes.builtin.groups import Arrange
from avp_habitat.scenes.builtin.hanging import hang_lamp, hang_pictures
from avp_habitat.scenes.builtin.kit import Kit
from avp_habitat.scenes.builtin.shell import Shell


def _put_at_wall(
    floor: Floor, dice: Dice, arrange: Arrange, *, least_share: float, corner: float | None = None
) -> bool:
    """Try places along all walls in random order; with `corner`, only those that far from the walls' ends."""
    shell = floor.shell
    for wall in dice.shuffled(shell.walls):
        if corner is not None:
            spots = dice.shuffled([corner, wall.length - corner])
        else:
            spots = dice.shuffled([round(place, 2) for place in np.arange(0.3, wall.length - 0.3, 0.2)])
        for right in spots:
            group = arrange(shell.depth_at(wall, right))
            if group is not None and floor.try_group(group, wall, right, least_share=least_share):
                return True
    return False


def _put_anywhere(floor: Floor, dice: Dice, arrange: Arrange, *, least_share: float) -> bool:
    """Try places in the open floor."""
    for wall in dice.shuffled(floor.shell.walls):
        places = [(r, i) for r in np.arange(0.6, wall.length - 0.5, 0.3) for i in np.arange(0.1, 4.0, 0.3)]
        for right, inwards in dice.shuffled(places)[:120]:
            group = arrange(floor.shell.depth_at(wall, right) - inwards)
            if group is not None and floor.try_group(group, wall, right, inwards, least_share=least_share):
                return True
    return False


def _put_divider(floor: Floor, dice: Dice, kit: Kit) -> bool:
    """Part the room with the longest divider that leaves it walkable."""
    walls = [wall for wall in floor.shell.walls if wall.length >= 3.0]
    for arrange in groups.divider(kit, dice, floor.shell.ceiling):
        for wall in dice.shuffled(walls):
            for share in dice.shuffled([0.3, 0.36, 0.43, 0.5, 0.57, 0.64, 0.7]):
                right = round(wall.length * share, 2)
                group = arrange(floor.shell.depth_at(wall, right))
                if group is not None and floor.try_group(group, wall, right, least_share=0.48):
                    return True
    return False


def _storage(kit: Kit, dice: Dice) -> list[Arrange]:
    return dice.shuffled(
        [
            groups.against_wall(storage.bookshelf(kit, dice), 0.55),
            groups.against_wall(storage.wardrobe(kit, dice), 0.6),
            groups.against_wall(storage.drawers(kit, dice), 0.5),
        ]
    )


def _put_furniture(floor: Floor, dice: Dice, kit: Kit) -> None:
    """Main groups by the room's size, then storage, then what fills corners."""
    area = floor.shell.floor_area
    sleeps = dice.chance(0.6 if area > 22 else 0.4)
    sits = area > 20 or not sleeps
    if sits:
        any(_put_at_wall(floor, dice, arrange, least_share=0.48) for arrange in groups.living(kit, dice))
    if sleeps:
        _put_at_wall(floor, dice, groups.sleeping(kit, dice), least_share=0.48)
    if not (sits and sleeps) or area > 30:
        _put_anywhere(floor, dice, groups.dining(kit, dice), least_share=0.5)
    _put_divider(floor, dice, kit)
    extra = [groups.working(kit, dice), *_storage(kit, dice), groups.reading(kit, dice)]
    for arrange in extra:
        _put_at_wall(floor, dice, arrange, least_share=0.45)
    for _ in range(2):
        _put_at_wall(floor, dice, groups.against_wall(decor.plant(kit, dice), 0.0), least_share=0.44, corner=0.42)
    _put_at_wall(floor, dice, groups.against_wall(tables.side_table(kit, dice), 0.3), least_share=0.44)


def furnish(shell: Shell, dice: Dice, kit: Kit) -> list[Placed]:
    """Furniture of a room, none of it in another's place, the door free, the floor walkable and in one part."""
    floor = Floor(shell)
    _put_furniture(floor, dice, kit)
    hang_lamp(floor, dice, kit)
    hang_pictures(floor, dice, kit)
    return floor.placed
