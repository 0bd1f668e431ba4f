"""Where furniture stands: against walls, facing what it should, clear of doors and of one another."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from avp_habitat.scenes.builtin import decor, groups, storage, tables
from avp_habitat.scenes.builtin.dice import Dice
from avp_habitat.scenes.builtin.groups import Arrange, Group, Member
from avp_habitat.scenes.builtin.kit import Kit
from avp_habitat.scenes.builtin.masonry import CURTAIN_M, curtain_bottom
from avp_habitat.scenes.builtin.piece import FLAT_M, Piece
from avp_habitat.scenes.builtin.shapes import Surface, moved
from avp_habitat.scenes.builtin.shell import Point, Shell, Wall
from avp_habitat.scenes.builtin.walkway import walkable_share

Float = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Placed:
    """A piece and where it stands."""

    piece: Piece
    """What."""
    axes: Float
    """`(3, 3)` columns are the piece's x, y and z in the world."""
    position: Point
    """x, z of its foot in metres."""
    footprint: tuple[float, float, float, float]
    """x0, z0, x1, z1 of the axis-aligned rectangle that it keeps to."""

    def surfaces(self) -> list[Surface]:
        """Its triangles in the world frame."""
        return moved(self.piece.surfaces, self.axes, np.array([self.position[0], 0.0, self.position[1]]))


@dataclass(frozen=True)
class Block:
    """An axis-aligned box that furniture occupies or that must stay free."""

    x0: float
    z0: float
    x1: float
    z1: float
    low: float = 0.0
    high: float = 2.0
    solid: bool = True

    def meets(self, other: "Block", margin: float = 0.0) -> bool:
        """Whether two boxes come closer than the margin on the floor and overlap in height."""
        return (
            self.x0 < other.x1 + margin
            and other.x0 < self.x1 + margin
            and self.z0 < other.z1 + margin
            and other.z0 < self.z1 + margin
            and self.low < other.high
            and other.low < self.high
        )


_QUARTERS = ((1, 0), (0, 1), (-1, 0), (0, -1))
"""Cosine and sine of quarter turns."""


class Floor:
    """A room that fills with furniture."""

    def __init__(self, shell: Shell) -> None:
        """Start with the empty room; doors, windows and curtains claim their places.

        Args:
            shell: the empty room.
        """
        self.shell = shell
        self.placed: list[Placed] = []
        self.blocks: list[Block] = []
        self.rugs: list[Block] = []
        for hole in shell.openings:
            wall = shell.walls[hole.wall]
            if hole.kind == "door":
                self.blocks.append(_before(wall, hole.left - 0.1, hole.right + 0.1, 1.0, 0.03, 2.1, solid=False))
                continue
            self.blocks.append(_before(wall, hole.left, hole.right, 0.4, hole.bottom, hole.top, solid=False))
            for left, right in ((hole.left - CURTAIN_M, hole.left + 0.05), (hole.right - 0.05, hole.right + CURTAIN_M)):
                low = curtain_bottom(shell, hole)
                self.blocks.append(_before(wall, left, right, 0.16, low, hole.top + 0.2, solid=True))

    def try_group(self, group: Group, wall: Wall, right: float, inwards: float = 0.0, *, least_share: float) -> bool:
        """Place a group with the middle of its back at a point, if everything fits and the room stays walkable."""
        stands = [_stand(member, wall, right, inwards) for member in group.members]
        solids, rugs = [], []
        for stand in stands:
            if not self.shell.contains(*stand.footprint):
                return False
            (rugs if stand.piece.height <= FLAT_M else solids).append(Block(*stand.footprint, 0.03, stand.piece.height))
        areas = [_area(rectangle, wall, right, inwards) for rectangle in group.clear]
        if not all(self.shell.contains(area.x0, area.z0, area.x1, area.z1) for area in areas):
            return False
        if any(block.meets(solid, 0.02 if block.solid else 0.0) for block in self.blocks for solid in solids):
            return False
        if any(block.solid and block.meets(area) for block in self.blocks for area in areas):
            return False
        if any(rug.meets(other, 0.05) for rug in rugs for other in self.rugs):
            return False
        solid_blocks = [block for block in self.blocks if block.solid] + solids
        if walkable_share(self.shell, [(b.x0, b.z0, b.x1, b.z1) for b in solid_blocks]) < least_share:
            return False
        self.placed += stands
        self.blocks += solids + areas
        self.rugs += rugs
        return True

    def hang(self, stand: Placed, low: float, high: float) -> bool:
        """Place something on a wall or ceiling if nothing is there, without asking for floor."""
        block = Block(*stand.footprint, low, high)
        if not self.shell.contains(*stand.footprint) or any(block.meets(other, 0.03) for other in self.blocks):
            return False
        self.placed.append(stand)
        self.blocks.append(Block(*stand.footprint, low, high, False))
        return True


def _before(wall: Wall, left: float, right: float, deep: float, low: float, high: float, *, solid: bool) -> Block:
    (xa, za), (xb, zb) = wall.point(left, 0.0), wall.point(right, deep)
    return Block(min(xa, xb), min(za, zb), max(xa, xb), max(za, zb), low, high, solid)


def _area(rectangle: tuple[float, float, float, float], wall: Wall, right: float, inwards: float) -> Block:
    (xa, za), (xb, zb) = (
        wall.point(right + rectangle[0], inwards + rectangle[1]),
        wall.point(right + rectangle[2], inwards + rectangle[3]),
    )
    return Block(min(xa, xb), min(za, zb), max(xa, xb), max(za, zb), 0.03, 1.9, False)


def _stand(member: Member, wall: Wall, right: float, inwards: float) -> Placed:
    """A member of a group in the world."""
    cosine, sine = _QUARTERS[member.quarter]
    if member.twist:
        c, s = float(np.cos(member.twist)), float(np.sin(member.twist))
        cosine, sine = cosine * c - sine * s, sine * c + cosine * s
    turn = np.array([[cosine, 0.0, sine], [0.0, 1.0, 0.0], [-sine, 0.0, cosine]])
    axes = wall.axes() @ turn
    x, z = wall.point(right + member.x, inwards + member.z)
    half = np.abs(axes[:, [0, 2]]) @ np.array([member.piece.width / 2, member.piece.depth / 2])
    footprint = (x - float(half[0]), z - float(half[2]), x + float(half[0]), z + float(half[2]))
    return Placed(member.piece, axes, (x, z), footprint)


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
        for right, inwards in dice.shuffled(places)[:40]:
            group = arrange(floor.shell.depth_at(wall, right) - inwards)
            if group is not None and floor.try_group(group, wall, right, inwards, least_share=least_share):
                return True
    return False


def _put_divider(floor: Floor, dice: Dice, kit: Kit) -> bool:
    arrange = groups.divider(kit, dice, floor.shell.ceiling)
    for wall in dice.shuffled([wall for wall in floor.shell.walls if wall.length >= 3.2]):
        for share in dice.shuffled([0.36, 0.43, 0.5, 0.57, 0.64]):
            right = round(wall.length * share, 2)
            group = arrange(floor.shell.depth_at(wall, right))
            if group is not None and floor.try_group(group, wall, right, least_share=0.6):
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
    sleeps = dice.chance(0.5 if area > 22 else 0.35)
    if area > 15:
        _put_divider(floor, dice, kit)
    if area > 18 or not sleeps:
        _put_at_wall(floor, dice, groups.living(kit, dice), least_share=0.5)
    if sleeps:
        _put_at_wall(floor, dice, groups.sleeping(kit, dice), least_share=0.5)
    if area > 19 or (sleeps and area > 14):
        _put_anywhere(floor, dice, groups.dining(kit, dice), least_share=0.5)
    extra = [groups.working(kit, dice), *_storage(kit, dice), groups.reading(kit, dice)]
    for arrange in extra:
        _put_at_wall(floor, dice, arrange, least_share=0.48)
    for _ in range(2):
        _put_at_wall(floor, dice, groups.against_wall(decor.plant(kit, dice), 0.0), least_share=0.47, corner=0.42)
    _put_at_wall(floor, dice, groups.against_wall(tables.side_table(kit, dice), 0.3), least_share=0.47)


def _hang_pictures(floor: Floor, dice: Dice, kit: Kit) -> None:
    for number, wall in enumerate(floor.shell.walls):
        wanted = 3 if wall.length > 3 else 1
        for right in dice.shuffled([round(place, 2) for place in np.arange(0.5, wall.length - 0.4, 0.2)]):
            if not wanted:
                break
            width, height = dice.pick(((0.9, 0.6), (0.5, 0.7), (0.6, 0.8), (0.7, 0.5), (1.2, 0.7)))
            middle = 1.6
            surfaces = decor.clock(kit) if number == 0 and wanted == 1 else None
            piece = Piece("clock" if surfaces else "picture", surfaces or [], width, 0.06, 0.0)
            stand = _stand(Member(piece, 0.0, 0.03), wall, right, 0.0)
            if floor.hang(stand, middle - height / 2, middle + height / 2):
                made = surfaces or decor.picture(kit, dice, width, height)
                lifted = [*moved(made, np.eye(3), np.array([0.0, middle, -0.03]))]
                floor.placed[-1] = Placed(
                    Piece(piece.kind, lifted, width, 0.06, middle + height / 2),
                    stand.axes,
                    stand.position,
                    stand.footprint,
                )
                wanted -= 1


def _hang_lamps(floor: Floor, dice: Dice, kit: Kit) -> None:
    """A pendant above the dining table, or in the middle of the room."""
    shell = floor.shell
    tables_ = [stand.position for stand in floor.placed if stand.piece.kind == "dining table"]
    x0, z0, x1, z1 = shell.bounds
    for position in tables_ or [((x0 + x1) / 2 + 0.1, (z0 + z1) / 2), (x0 + 1.2, z0 + 1.2), (x1 - 1.2, z1 - 1.2)]:
        piece = decor.pendant(kit, dice, shell.ceiling, 1.95)
        half = piece.width / 2
        footprint = (position[0] - half, position[1] - half, position[0] + half, position[1] + half)
        if floor.hang(Placed(piece, np.eye(3), position, footprint), 1.9, shell.ceiling):
            return


def furnish(shell: Shell, dice: Dice, kit: Kit) -> list[Placed]:
    """Furniture of a room, none of it in another's place, the door free, the floor walkable and in one part."""
    floor = Floor(shell)
    _put_furniture(floor, dice, kit)
    _hang_lamps(floor, dice, kit)
    _hang_pictures(floor, dice, kit)
    return floor.placed
