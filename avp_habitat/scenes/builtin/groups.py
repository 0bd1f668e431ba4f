"""Furniture that belongs together, arranged relative to one another."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

from avp_habitat.scenes.builtin import decor, seating
from avp_habitat.scenes.builtin.kit import Kit, Piece, shifted
from avp_habitat.scenes.builtin.noise import Random
from avp_habitat.scenes.builtin.shapes import HALF_TURN, Material, Rectangle, box, yawed

GAP_M = 0.03
"""Between furniture and the wall behind it: the skirting board is 15 mm thick."""


@dataclass(frozen=True, eq=False)
class Member:
    """A piece in a group, whose frame has its back at z = 0 and its front towards +z; x is to the right, metres."""

    piece: Piece
    x: float
    z: float
    quarter: int = 0
    """Quarter turns about +Y, counter-clockwise from above."""
    twist: float = 0.0
    """Further turn in radians, small."""


@dataclass(frozen=True, eq=False)
class Group:
    """Pieces with fixed places relative to one another."""

    members: tuple[Member, ...]
    clear: tuple[Rectangle, ...] = ()
    """x0, z0, x1, z1 in front of furniture that people need to use it."""


Arrange = Callable[[float], Group | None]
"""From the free depth in metres in front of the group's back to the group, or None where it does not fit."""


def against_wall(piece: Piece, clear: float) -> Arrange:
    """One piece with its back to a wall and free floor in front of it, metres."""
    front = GAP_M + piece.depth
    area = (-piece.width / 2, front, piece.width / 2, front + clear)
    group = Group((Member(piece, 0.0, GAP_M + piece.depth / 2),), (area,))
    return lambda depth: group if depth > front + clear else None


def living(kit: Kit, rng: Random) -> list[Arrange]:
    """A television and a sofa that faces it over a coffee table on a rug; the fullest arrangement comes first."""
    unit, couch = decor.television(kit, rng), seating.sofa(kit, rng)
    table, carpet = seating.coffee_table(kit, rng), decor.rug(kit, 2.3, 1.6)
    seat, beside, lamp = seating.armchair(kit, rng), seating.side_table(kit, rng), decor.floor_lamp(kit, rng)
    side, twist = rng.choice((-1, 1)), rng.uniform(-0.2, 0.2)
    free = rng.uniform(3.3, 3.8)
    seat_x = side * max(couch.width / 2 + 0.15, table.width / 2 + 0.16 + seat.depth * 0.6)

    def members(back: float) -> list[Member]:
        sofa_z = back - couch.depth / 2
        table_z = sofa_z - couch.depth / 2 - 0.42 - table.depth / 2
        return [
            Member(unit, 0.0, GAP_M + unit.depth / 2),
            Member(couch, 0.0, sofa_z, 2),
            Member(table, 0.0, table_z),
            Member(carpet, 0.0, table_z + 0.1),
            Member(beside, -side * (couch.width / 2 + 0.26), sofa_z - 0.16, 2),
            Member(lamp, side * (couch.width / 2 + 0.25), sofa_z + 0.2),
            Member(seat, seat_x, table_z - 0.12, 3 if side > 0 else 1, twist),
        ]

    def arrange(depth: float, count: int) -> Group | None:
        if depth < (3.1 if count > 5 else 2.95):
            return None
        back = depth - GAP_M if depth < 4.4 else min(free, depth)
        chosen = members(back)[:count]
        return Group(tuple(chosen), ((-0.6, 0.5, 0.6, chosen[2].z - table.depth / 2),))

    return [lambda depth, count=count: arrange(depth, count) for count in (7, 6, 5, 4)]


def dining(kit: Kit, rng: Random) -> Arrange:
    """A table with chairs around it, sometimes on a rug; needs free floor on all sides."""
    wood: Material = rng.choice((kit.wood, kit.dark_wood))
    members: list[Member] = []
    if rng.chance(0.35):
        radius = rng.uniform(0.5, 0.6)
        table = seating.round_table(kit, rng, radius)
        half_x = half_z = radius + 0.32
        for quarter, (x, z) in enumerate(((0, -1), (-1, 0), (0, 1), (1, 0))):
            one = seating.chair(kit, rng, wood)
            members.append(Member(one, x * half_x, z * half_z, quarter, rng.uniform(-0.12, 0.12)))
    else:
        pairs = rng.choice((2, 2, 3))
        table = seating.dining_table(kit, rng, 0.62 * pairs + 0.2, 0.85)
        half_x, half_z = table.width / 2, table.depth / 2 + 0.3
        for index in range(pairs):
            x = (index - (pairs - 1) / 2) * 0.62
            for quarter, z in ((0, -half_z), (2, half_z)):
                one = seating.chair(kit, rng, wood)
                members.append(Member(one, x, z, quarter, rng.uniform(-0.1, 0.1)))
    reach = half_z + 0.4
    members = [replace(member, z=member.z + reach) for member in members]
    members.append(Member(table, 0.0, reach))
    if rng.chance(0.5):
        members.append(Member(decor.rug(kit, 2 * half_x + 0.7, 2 * half_z + 0.5), 0.0, reach))
    group = Group(tuple(members))
    return lambda depth: group if depth > 2 * reach else None


def sleeping(kit: Kit, rng: Random) -> Arrange:
    """A bed with its head to the wall, one or two night stands and a rug beside it."""
    couch = seating.bed(kit, rng)
    stands = [seating.side_table(kit, rng) for _ in range(2)]
    z = GAP_M + couch.depth / 2
    members = [Member(couch, 0.0, z)]
    sides = (-1, 1) if couch.width > 1.2 else (rng.choice((-1, 1)),)
    for stand, side in zip(stands, sides, strict=False):
        members.append(Member(stand, side * (couch.width / 2 + 0.26), GAP_M + stand.depth / 2))
    members.append(Member(decor.rug(kit, 1.0, 1.5), sides[0] * (couch.width / 2 + 0.55), 1.5))
    edge = couch.width / 2
    walk = (edge, 0.7, edge + 0.6, 1.9) if sides[0] > 0 else (-edge - 0.6, 0.7, -edge, 1.9)
    group = Group(tuple(members), (walk,))
    return lambda depth: group if depth > couch.depth + 0.7 else None


def working(kit: Kit, rng: Random) -> Arrange:
    """A desk against the wall and a swivel chair before it."""
    table, stool = seating.desk(kit, rng), seating.office_chair(kit, rng)
    z = GAP_M + table.depth / 2
    chair = Member(stool, -0.1, GAP_M + table.depth + 0.42, 2, rng.uniform(-0.4, 0.4))
    group = Group((Member(table, 0.0, z), chair), ((-0.5, 0.7, 0.5, 1.6),))
    return lambda depth: group if depth > 1.7 else None


def reading(kit: Kit, rng: Random) -> list[Arrange]:
    """An armchair with a floor lamp and, where there is room, a pouf."""
    seat, lamp, stool = seating.armchair(kit, rng), decor.floor_lamp(kit, rng), seating.pouf(kit, rng)
    side = rng.choice((-1, 1))
    members = (
        Member(seat, 0.0, 0.12 + seat.depth / 2, 0, rng.uniform(-0.25, 0.25)),
        Member(lamp, side * (seat.width / 2 + 0.34), 0.3),
        Member(stool, 0.0, 0.12 + seat.depth + 0.45),
    )
    return [lambda depth, count=count: Group(members[:count]) if depth > 1.8 else None for count in (3, 2)]


def divider(kit: Kit, rng: Random, ceiling: float) -> list[Arrange]:
    """A partition wall or double shelf that runs from a wall into the room to hide what is behind it, longest first."""
    masonry = rng.chance(0.5)
    wall = rng.choice((kit.feature_wall, kit.papered_wall))
    lengths = (2.3, 1.9, 1.5, 1.2)
    gap, rng = (-0.02, rng.spawn()) if masonry else (GAP_M, rng.spawn())

    @cache
    def piece(length: float) -> Piece:
        return partition(kit, rng, wall, length, ceiling) if masonry else decor.divider_shelf(kit, rng, length)

    def arrange(depth: float, length: float) -> Group | None:
        if depth - length < 1.1 or length > 0.62 * depth:
            return None
        return Group((Member(piece(length), 0.0, gap + length / 2, 1),))

    return [lambda depth, length=length: arrange(depth, length) for length in lengths]


def partition(kit: Kit, rng: Random, material: Material, length: float, ceiling: float) -> Piece:
    """A stub of wall along x with a skirting board and a picture on each side."""
    thick = 0.12
    size, middle = (length, ceiling, thick), (0, ceiling / 2, 0)
    made = box(size, middle, material, faces=("front", "back"), pitch=0.25)
    made += box(size, middle, kit.trim, faces=("left", "right"), pitch=0.25)
    sides = ("front", "back", "left", "right", "top")
    made += box((length - 0.008, 0.09, thick + 0.03), (0, 0.045, 0), kit.trim, faces=sides)
    wide = min(length - 0.5, rng.uniform(0.6, 0.9))
    front = shifted(decor.picture(kit, rng, wide, 0.62), 0, 1.55, thick / 2)
    back = yawed(shifted(decor.picture(kit, rng, wide * 0.8, 0.7), 0, 1.55, thick / 2), HALF_TURN)
    return Piece("partition", made + front + back, length, thick + 0.07, ceiling)
