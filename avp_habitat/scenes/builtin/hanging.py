"""What hangs on walls and from the ceiling: pictures, a clock, a lamp."""

import numpy as np

from avp_habitat.scenes.builtin import decor
from avp_habitat.scenes.builtin.dice import Dice
from avp_habitat.scenes.builtin.floorplan import Floor, Placed, places, stand_at
from avp_habitat.scenes.builtin.groups import Member
from avp_habitat.scenes.builtin.kit import Kit
from avp_habitat.scenes.builtin.piece import Piece, shifted
from avp_habitat.scenes.builtin.shell import Wall

PICTURES = ((0.9, 0.65), (0.5, 0.7), (0.6, 0.85), (0.7, 0.5), (1.2, 0.8))
"""Widths and heights of frames in metres."""
MIDDLE_M = 1.6
"""Height at which the middle of a picture hangs."""


def _hang_one(floor: Floor, dice: Dice, kit: Kit, wall: Wall, right: float, *, clock: bool) -> bool:
    """Hang a picture or clock at a place on a wall if nothing is in its way."""
    width, height = (0.34, 0.34) if clock else dice.pick(PICTURES)
    low, high = MIDDLE_M - height / 2, MIDDLE_M + height / 2
    stand = stand_at(Member(Piece("", [], width, 0.06, high), 0.0, 0.03), wall, right, 0.0)
    if not floor.is_free(stand, low, high, 0.1):
        return False
    surfaces = decor.clock(kit) if clock else decor.picture(kit, dice, width, height)
    piece = Piece("clock" if clock else "picture", shifted(surfaces, 0.0, MIDDLE_M, -0.03), width, 0.06, high)
    floor.hang(Placed(piece, stand.axes, stand.position, stand.footprint), low, high)
    return True


def hang_pictures(floor: Floor, dice: Dice, kit: Kit) -> None:
    """Pictures on every wall that has room for them, one clock in some rooms."""
    clock = dice.chance(0.6)
    for wall in dice.shuffled(floor.shell.walls):
        wanted = 3 if wall.length > 3 else 1
        for right in dice.shuffled(places(0.5, wall.length - 0.4, 0.2)):
            if wanted and _hang_one(floor, dice, kit, wall, right, clock=clock):
                wanted, clock = wanted - 1, False


def hang_lamp(floor: Floor, dice: Dice, kit: Kit) -> None:
    """A pendant above the dining table, or where the room is open."""
    shell = floor.shell
    tables = [stand.position for stand in floor.placed if stand.piece.kind == "dining table"]
    x0, z0, x1, z1 = shell.bounds
    bottom = min(2.1, round(shell.ceiling - 0.62, 2))
    piece = decor.pendant(kit, dice, shell.ceiling, bottom)
    half = piece.width / 2
    for x, z in tables or [((x0 + x1) / 2 + 0.1, (z0 + z1) / 2), (x0 + 1.2, z0 + 1.2), (x1 - 1.2, z1 - 1.2)]:
        stand = Placed(piece, np.eye(3), (x, z), (x - half, z - half, x + half, z + half))
        if floor.is_free(stand, bottom - 0.05, shell.ceiling, 0.03):
            floor.hang(stand, bottom - 0.05, shell.ceiling)
            return
