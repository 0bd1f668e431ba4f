"""Fills a room with furniture, none of it in another's place, the door free, the rest walkable."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import label

from avp_habitat.scenes.builtin import decor, groups, seating
from avp_habitat.scenes.builtin.groups import Arrange, Group, Member
from avp_habitat.scenes.builtin.kit import FLAT_M, Kit, Lamp, Piece, shifted
from avp_habitat.scenes.builtin.noise import Random
from avp_habitat.scenes.builtin.shapes import Float, MeshSurface, Rectangle, moved
from avp_habitat.scenes.builtin.shell import CURTAIN_M, Point, Shell, Wall, curtain_bottom

_CELL_M = 0.1
_RADIUS_M = 0.15
"""The agent's radius and half a cell, so that the answer errs on the safe side."""
_QUARTERS = ((1, 0), (0, 1), (-1, 0), (0, -1))
"""Cosine and sine of quarter turns."""
_PICTURES = ((0.9, 0.65), (0.5, 0.7), (0.6, 0.85), (0.7, 0.5), (1.2, 0.8))
"""Widths and heights of frames in metres."""
_MIDDLE_M = 1.6
"""Height at which the middle of a picture hangs."""
_MAIN, _EXTRA, _SMALL = 0.45, 0.42, 0.41
"""Share of the floor that stays walkable after placing main groups, storage, and what fills corners."""
Spots = Callable[[Wall], list[Point]]
"""Where a group may stand at a wall: metres along it and in front of it."""
_MOST_SPOTS = 120


def largest_part(free: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The largest 4-connected part of a mask."""
    parts, _ = label(free)  # pyright: ignore[reportGeneralTypeIssues]
    sizes = np.bincount(parts.ravel())
    sizes[0] = 0
    return free & (parts == sizes.argmax())


def _walkable_share(shell: Shell, blocks: list[Rectangle]) -> float:
    """Share of the floor in the largest walkable part beside blocks; 0 where other parts come to more than 0.3 m²."""
    x0, z0, x1, z1 = shell.bounds
    x = np.arange(x0 + _CELL_M / 2, x1, _CELL_M)
    z = np.arange(z0 + _CELL_M / 2, z1, _CELL_M)
    inside_x = (x > x0 + _RADIUS_M) & (x < x1 - _RADIUS_M)
    free = ((z > z0 + _RADIUS_M) & (z < z1 - _RADIUS_M))[:, None] & inside_x
    for a, b, c, d in filter(None, [*blocks, shell.notch]):
        rows = slice(*np.searchsorted(z, (b - _RADIUS_M, d + _RADIUS_M)))
        columns = slice(*np.searchsorted(x, (a - _RADIUS_M, c + _RADIUS_M)))
        free[rows, columns] = False
    part = int(largest_part(free).sum())
    return 0.0 if (int(free.sum()) - part) * _CELL_M**2 > 0.3 else part * _CELL_M**2 / shell.floor_area


@dataclass(frozen=True, eq=False)
class Placed:
    """A piece and where it stands."""

    piece: Piece
    axes: Float
    """`(3, 3)` columns are the piece's x, y and z in the world."""
    position: Point
    footprint: Rectangle
    """The axis-aligned rectangle that it keeps to."""

    def surfaces(self) -> list[MeshSurface]:
        """Its triangles in the world frame."""
        return moved(self.piece.surfaces, self.axes, self._foot)

    def lamps(self) -> list[Lamp]:
        """Its lights in the world frame."""
        found = [(self.axes @ np.asarray(lamp.position) + self._foot, lamp.strength) for lamp in self.piece.lamps]
        return [Lamp((float(x), float(y), float(z)), strength) for (x, y, z), strength in found]

    @property
    def _foot(self) -> Float:
        return np.array([self.position[0], 0.0, self.position[1]])


@dataclass(frozen=True)
class Block:
    """A box over a rectangle that furniture occupies or that must stay free, between two heights in metres."""

    area: Rectangle
    low: float = 0.0
    high: float = 2.0
    solid: bool = True

    def meets(self, other: "Block", margin: float = 0.0) -> bool:
        """Whether two boxes come closer than the margin on the floor and overlap in height."""
        (a, b, c, d), (x0, z0, x1, z1) = self.area, other.area
        close = a < x1 + margin and x0 < c + margin and b < z1 + margin and z0 < d + margin
        return close and self.low < other.high and other.low < self.high

    @property
    def flat(self) -> "Block":
        """The same rectangle from the floor to 2 m."""
        return Block(self.area)


class FloorPlan:
    """A room that fills with furniture."""

    def __init__(self, shell: Shell) -> None:
        """Start with the empty room, where the door, windows and curtains claim their places."""
        self.shell = shell
        self.placed: list[Placed] = []
        self.blocks: list[Block] = []
        self.rugs: list[Block] = []
        for hole in shell.openings:
            wall = shell.walls[hole.wall]
            if hole.kind != "window":
                self.blocks.append(_before(wall, (hole.left - 0.1, 0.0, hole.right + 0.1, 1.0), 0.03, 2.1))
                continue
            self.blocks.append(_before(wall, (hole.left, 0.0, hole.right, 0.4), hole.bottom, hole.top))
            for left, right in ((hole.left - CURTAIN_M, hole.left + 0.05), (hole.right - 0.05, hole.right + CURTAIN_M)):
                low, high = curtain_bottom(shell, hole), hole.top + 0.2
                self.blocks.append(_before(wall, (left, 0.0, right, 0.16), low, high, solid=True))

    def try_group(self, group: Group, wall: Wall, right: float, inwards: float = 0.0, *, least_share: float) -> bool:
        """Place a group with the middle of its back at a point, if everything fits and the room stays walkable."""
        stands = [stand_at(member, wall, right, inwards) for member in group.members]
        if not all(self._holds(stand) for stand in stands):
            return False
        solids, rugs = [], []
        for stand in stands:
            (rugs if stand.piece.height <= FLAT_M else solids).append(Block(stand.footprint, 0.03, stand.piece.height))
        areas = [
            _before(wall, (right + a, inwards + b, right + c, inwards + d), 0.03, 1.9) for a, b, c, d in group.clear
        ]
        if not all(self.shell.contains(*block.area) for block in areas) or self._are_in_the_way(solids, rugs, areas):
            return False
        if self.walkable_share(solids) < least_share:
            return False
        self.placed += stands
        self.blocks += solids + areas
        self.rugs += rugs
        return True

    def walkable_share(self, more: list[Block] | None = None) -> float:
        """Share of the floor that stays walkable, with more furniture perhaps."""
        standing = [block.area for block in [*self.blocks, *(more or [])] if block.solid]
        return _walkable_share(self.shell, standing)

    def _are_in_the_way(self, solids: list[Block], rugs: list[Block], areas: list[Block]) -> bool:
        """Whether new furniture, rugs, or the floor in front of them, meet what is there.

        New furniture may not stand on a rug of others, nor a new rug lie under others or on another rug.
        """
        standing = [block for block in self.blocks if block.solid]
        return (
            any(block.meets(solid, 0.02 if block.solid else 0.0) for block in self.blocks for solid in solids)
            or any(block.meets(area) for block in standing for area in areas)
            or any(rug.flat.meets(other, 0.05) for rug in self.rugs for other in solids + rugs)
            or any(rug.meets(other.flat, 0.02) for rug in rugs for other in standing)
        )

    def _holds(self, stand: Placed) -> bool:
        """Whether a piece is inside the room; a partition may reach into its wall."""
        x0, z0, x1, z1 = stand.footprint
        slack = 0.02 if stand.piece.kind == "partition" else 0.0
        dx, dz = (slack, 0.0) if x1 - x0 > z1 - z0 else (0.0, slack)
        return self.shell.contains(x0 + dx, z0 + dz, x1 - dx, z1 - dz)

    def is_free(self, stand: Placed, low: float, high: float, margin: float) -> bool:
        """Whether nothing comes closer than a margin to where a piece would hang between two heights, metres."""
        block = Block(stand.footprint, low, high)
        return self.shell.contains(*stand.footprint) and not any(block.meets(other, margin) for other in self.blocks)

    def hang(self, stand: Placed, low: float, high: float) -> None:
        """Put something on a wall or ceiling, where it takes no floor."""
        self.placed.append(stand)
        self.blocks.append(Block(stand.footprint, low, high, False))


def places(start: float, end: float, pitch: float) -> list[float]:
    """Positions from start up to but without end, metres, rounded to centimetres."""
    return [round(start + index * pitch, 2) for index in range(max(0, int((end - start) / pitch - 1e-9) + 1))]


def _before(wall: Wall, rectangle: Rectangle, low: float, high: float, *, solid: bool = False) -> Block:
    """A block before a wall: left, inwards, right, inwards in metres, between two heights."""
    (xa, za), (xb, zb) = wall.point(*rectangle[:2]), wall.point(*rectangle[2:])
    return Block((min(xa, xb), min(za, zb), max(xa, xb), max(za, zb)), low, high, solid)


def stand_at(member: Member, wall: Wall, right: float, inwards: float) -> Placed:
    """A member of a group in the world."""
    cosine, sine = _QUARTERS[member.quarter]
    if member.twist:
        c, s = float(np.cos(member.twist)), float(np.sin(member.twist))
        cosine, sine = cosine * c - sine * s, sine * c + cosine * s
    turn = np.array([[cosine, 0.0, sine], [0.0, 1.0, 0.0], [-sine, 0.0, cosine]])
    axes = wall.axes() @ turn
    x, z = wall.point(right + member.x, inwards + member.z)
    half = np.abs(axes[:, [0, 2]]) @ np.array([member.piece.width / 2, member.piece.depth / 2])
    wide, deep = float(half[0]), float(half[2])
    footprint = (round(x - wide, 6), round(z - deep, 6), round(x + wide, 6), round(z + deep, 6))
    return Placed(member.piece, axes, (x, z), footprint)


def _hang_one(floor: FloorPlan, rng: Random, kit: Kit, wall: Wall, right: float, *, clock: bool) -> bool:
    """Hang a picture or clock at a place on a wall if nothing is in its way."""
    width, height = (0.34, 0.34) if clock else rng.choice(_PICTURES)
    low, high = _MIDDLE_M - height / 2, _MIDDLE_M + height / 2
    stand = stand_at(Member(Piece("", [], width, 0.06, high), 0.0, 0.03), wall, right, 0.0)
    if not floor.is_free(stand, low, high, 0.1):
        return False
    surfaces = decor.clock(kit) if clock else decor.picture(kit, rng, width, height)
    kind = "clock" if clock else "picture"
    piece = Piece(kind, shifted(surfaces, 0.0, _MIDDLE_M, -0.03), width, 0.06, high)
    floor.hang(replace(stand, piece=piece), low, high)
    return True


def hang_pictures(floor: FloorPlan, rng: Random, kit: Kit, most: int = 100) -> None:
    """Pictures on every wall that has room for them, up to a number, one clock in some rooms."""
    clock = rng.chance(0.6)
    for wall in rng.shuffled(floor.shell.walls):
        wanted = 3 if wall.length > 3 else 1
        for right in rng.shuffled(places(0.5, wall.length - 0.4, 0.2)):
            if wanted and most and _hang_one(floor, rng, kit, wall, right, clock=clock):
                wanted, most, clock = wanted - 1, most - 1, False


def hang_lamp(floor: FloorPlan, rng: Random, kit: Kit) -> None:
    """A pendant above the dining table, or where the room is open."""
    ceiling, (x0, z0, x1, z1) = floor.shell.ceiling, floor.shell.bounds
    tables = [stand.position for stand in floor.placed if stand.piece.kind == "dining table"]
    bottom = min(2.1, round(ceiling - 0.62, 2))
    piece = decor.pendant(kit, rng, ceiling, bottom)
    half = piece.width / 2
    for x, z in tables or [((x0 + x1) / 2 + 0.1, (z0 + z1) / 2), (x0 + 1.2, z0 + 1.2), (x1 - 1.2, z1 - 1.2)]:
        stand = Placed(piece, np.eye(3), (x, z), (x - half, z - half, x + half, z + half))
        if floor.is_free(stand, bottom - 0.05, ceiling, 0.03):
            floor.hang(stand, bottom - 0.05, ceiling)
            return


def put(floor: FloorPlan, rng: Random, arrange: Arrange, spots: Spots, least_share: float) -> bool:
    """Place a group at the first spot, in random order, where it fits and leaves enough of the floor walkable."""
    for wall in rng.shuffled([wall for wall in floor.shell.walls if spots(wall)]):
        for right, inwards in rng.shuffled(spots(wall))[:_MOST_SPOTS]:
            group = arrange(floor.shell.depth_at(wall, right) - inwards)
            if group is not None and floor.try_group(group, wall, right, inwards, least_share=least_share):
                return True
    return False


def at_wall(wall: Wall) -> list[Point]:
    """Along the whole wall."""
    return [(right, 0.0) for right in places(0.3, wall.length - 0.3, 0.2)]


def in_corners(wall: Wall) -> list[Point]:
    """Beside both ends."""
    return [(0.42, 0.0), (wall.length - 0.42, 0.0)]


def anywhere(wall: Wall) -> list[Point]:
    """Up to 4 m in front of the wall."""
    return [(r, i) for r in places(0.6, wall.length - 0.5, 0.3) for i in places(0.1, 4.0, 0.3)]


def _across(wall: Wall) -> list[Point]:
    """Away from the ends of a long wall."""
    shares = (0.3, 0.36, 0.43, 0.5, 0.57, 0.64, 0.7)
    return [(round(wall.length * share, 2), 0.0) for share in shares] if wall.length >= 3.0 else []


def _storage(kit: Kit, rng: Random) -> list[Arrange]:
    """Tall and low furniture for walls, the second shelf and chest last."""
    kinds = ((decor.bookshelf, 0.55), (decor.wardrobe, 0.6), (decor.drawers, 0.5))
    first = [groups.against_wall(make(kit, rng), clear) for make, clear in kinds]
    second = [groups.against_wall(make(kit, rng), clear) for make, clear in kinds[::2]]
    return rng.shuffled(first) + second


def _put_living(floor: FloorPlan, rng: Random, kit: Kit) -> bool:
    """Sofa, television and what belongs to them, as much as fits."""
    return any(put(floor, rng, arrange, at_wall, _MAIN) for arrange in groups.living(kit, rng))


def _put_main_groups(floor: FloorPlan, rng: Random, kit: Kit) -> None:
    """What the room is for, by its size, and what parts it."""
    area = floor.shell.floor_area
    sleeps = rng.chance(0.6 if area > 22 else 0.4)
    sits = area > 20 or not sleeps
    sits = sits and _put_living(floor, rng, kit)
    sleeps = (sleeps or not sits) and put(floor, rng, groups.sleeping(kit, rng), at_wall, _MAIN)
    if not sits and not sleeps:
        sits = _put_living(floor, rng, kit)
    if not (sits and sleeps) or area > 30:
        put(floor, rng, groups.dining(kit, rng), anywhere, _MAIN)
    any(put(floor, rng, arrange, _across, _MAIN) for arrange in groups.divider(kit, rng, floor.shell.ceiling))


def _put_the_rest(floor: FloorPlan, rng: Random, kit: Kit) -> None:
    """Desk, storage, a place to read, and what fills corners, as long as the floor stays walkable."""
    first, *rest = _storage(kit, rng)
    for arrange in (groups.working(kit, rng), first):
        put(floor, rng, arrange, at_wall, _EXTRA)
    any(put(floor, rng, arrange, at_wall, _EXTRA) for arrange in groups.reading(kit, rng))
    for arrange in rest:
        put(floor, rng, arrange, at_wall, _EXTRA)
    for _ in range(2):
        put(floor, rng, groups.against_wall(decor.plant(kit, rng), 0.0), in_corners, _SMALL)
    if sum(stand.piece.kind == "side table" for stand in floor.placed) < 2:
        put(floor, rng, groups.against_wall(seating.side_table(kit, rng), 0.3), at_wall, _SMALL)


def furnish(shell: Shell, rng: Random, kit: Kit) -> list[Placed]:
    """Furniture of a room, none of it in another's place, the door free, the floor walkable and in one part."""
    floor = FloorPlan(shell)
    _put_main_groups(floor, rng, kit)
    _put_the_rest(floor, rng, kit)
    hang_lamp(floor, rng, kit)
    hang_pictures(floor, rng, kit)
    return floor.placed
