"""Seats, beds and tables with what stands on them."""

from avp_habitat.scenes.builtin.decor import book_stack, bowl, table_lamp, vase
from avp_habitat.scenes.builtin.kit import Kit, Lamp, Piece, shifted
from avp_habitat.scenes.builtin.noise import Random
from avp_habitat.scenes.builtin.shapes import Material, MeshSurface, box, cushion, cylinder, lathe, leaned, yawed

SEAT_M = 0.46
"""Seats are higher than an agent with quantised steps of 0.2 m can climb."""


def _legs(width: float, depth: float, height: float, side: float, material: Material) -> list[MeshSurface]:
    x, z = width / 2 - side / 2, depth / 2 - side / 2
    made = []
    for sx, sz in ((-x, -z), (x, -z), (-x, z), (x, z)):
        made += box((side, height, side), (sx, height / 2, sz), material, pitch=1.0)
    return made


def _pillow(kit: Kit, rng: Random, x: float, y: float, z: float, lean: float = -0.3) -> list[MeshSurface]:
    """A loose pillow that leans back; (x, y, z) is where its lower edge rests."""
    side = rng.uniform(0.36, 0.46)
    made = shifted(cushion((side, side, 0.1), (0, 0, 0), 0.05, rng.choice(kit.cushions), puff=0.03), 0, side / 2, 0)
    return yawed(leaned(made, lean), rng.uniform(-0.25, 0.25), (x, y, z))


def _padded(kit: Kit, rng: Random, width: float, seats: int, cloth: Material, kind: str) -> Piece:
    """A sofa or armchair with the given number of seats."""
    depth, arm, back = 0.9, rng.uniform(0.14, 0.2), 0.2
    high, arm_high = rng.uniform(0.8, 0.92), rng.uniform(0.56, 0.66)
    made = _legs(width - 0.1, depth - 0.1, 0.1, 0.06, kit.dark_wood)
    made += cushion((width - 2 * arm, 0.2, depth - 0.04), (0, 0.2, 0), 0.03, cloth)
    made += cushion((width - 0.02, high - 0.1, back), (0, 0.1 + (high - 0.1) / 2, -depth / 2 + back / 2), 0.07, cloth)
    for side in (-1, 1):
        x = side * (width / 2 - arm / 2)
        made += cushion((arm, arm_high - 0.1, depth), (x, 0.1 + (arm_high - 0.1) / 2, 0), 0.06, cloth)
    inner = (width - 2 * arm) / seats
    for seat in range(seats):
        x = -width / 2 + arm + inner * (seat + 0.5)
        made += cushion((inner - 0.008, 0.17, depth - back - 0.02), (x, 0.375, back / 2), 0.05, cloth, puff=0.015)
        made += cushion((inner - 0.02, 0.42, 0.16), (x, 0.65, -depth / 2 + back + 0.07), 0.07, cloth, puff=0.03)
    places = [-1, 1] if seats > 1 else [0]
    for side in places:
        x = side * (width / 2 - arm - 0.26)
        made += _pillow(kit, rng, x, 0.47, -depth / 2 + back + 0.3)
    return Piece(kind, made, width, depth, max(high, 0.95))


def sofa(kit: Kit, rng: Random) -> Piece:
    """Two or three seats with loose pillows."""
    seats = rng.choice((2, 3, 3))
    width = rng.uniform(1.65, 1.85) if seats == 2 else rng.uniform(2.0, 2.3)
    return _padded(kit, rng, width, seats, kit.upholstery, "sofa")


def armchair(kit: Kit, rng: Random) -> Piece:
    """One padded seat."""
    return _padded(kit, rng, rng.uniform(0.82, 0.92), 1, kit.second_cloth, "armchair")


def chair(kit: Kit, rng: Random, material: Material) -> Piece:
    """A dining chair with a slatted or padded back."""
    width, depth, high = 0.44, 0.46, 0.9
    made = _legs(width, depth, SEAT_M - 0.04, 0.04, material)
    made += cushion((width, 0.06, depth), (0, SEAT_M - 0.01, 0), 0.02, kit.second_cloth)
    for x in (-0.2, 0.2):
        made += box((0.04, high - SEAT_M, 0.04), (x, (high + SEAT_M) / 2, -depth / 2 + 0.02), material, pitch=1)
    if rng.chance(0.5):
        made += cushion((0.36, 0.3, 0.04), (0, 0.72, -depth / 2 + 0.025), 0.018, kit.second_cloth)
    else:
        for place in (0.62, 0.73, 0.84):
            made += box((0.36, 0.06, 0.025), (0, place, -depth / 2 + 0.02), material, pitch=1)
    return Piece("chair", made, width, depth, high)


def office_chair(kit: Kit, rng: Random) -> Piece:
    """A swivel chair on a star foot."""
    made: list[MeshSurface] = []
    for turn in range(5):
        made += yawed(box((0.05, 0.05, 0.27), (0, 0.06, 0.135), kit.black, pitch=1), turn * 1.2566)
    made += cylinder(0.035, 0.06, 0.42, (0, 0, 0), kit.metal, 8)
    made += cushion((0.48, 0.09, 0.46), (0, 0.47, 0), 0.04, kit.second_cloth, puff=0.01)
    made += cushion((0.44, 0.52, 0.08), (0, 0.83, -0.22), 0.035, kit.second_cloth, puff=0.01)
    made += box((0.06, 0.3, 0.03), (0, 0.58, -0.275), kit.black, pitch=1)
    return Piece("office chair", made, 0.58, 0.58, 1.1)


def pouf(kit: Kit, rng: Random) -> Piece:
    """An upholstered stool."""
    side = rng.uniform(0.42, 0.5)
    made = cushion((side, SEAT_M, side), (0, SEAT_M / 2, 0), 0.09, rng.choice(kit.cushions), puff=0.0)
    return Piece("pouf", made, side, side, SEAT_M)


def bed(kit: Kit, rng: Random) -> Piece:
    """A bed with headboard, quilt and pillows; the headboard is at the back."""
    width, depth, high = rng.choice((1.0, 1.5, 1.7)), 2.1, rng.uniform(0.95, 1.2)
    made = box((width, 0.22, depth), (0, 0.19, 0), kit.wood, pitch=0.5)
    made += _legs(width - 0.04, depth - 0.04, 0.08, 0.08, kit.dark_wood)
    board = kit.upholstery if rng.chance(0.4) else kit.wood
    made += cushion((width, high - 0.3, 0.07), (0, 0.3 + (high - 0.3) / 2, -depth / 2 + 0.035), 0.03, board)
    made += cushion((width - 0.1, 0.22, depth - 0.14), (0, 0.41, 0.0), 0.06, kit.linen)
    made += cushion((width, 0.2, depth - 0.75), (0, 0.455, 0.345), 0.07, kit.bedding, puff=0.02)
    count = 1 if width < 1.2 else 2
    for index in range(count):
        x = 0.0 if count == 1 else (index - 0.5) * width * 0.48
        made += cushion((0.62, 0.13, 0.4), (x, 0.57, -depth / 2 + 0.34), 0.06, kit.linen, puff=0.03)
    made += _pillow(kit, rng, 0.0, 0.62, -depth / 2 + 0.62, -0.95)
    return Piece("bed", made, width, depth, high)


def coffee_table(kit: Kit, rng: Random) -> Piece:
    """A low table, round or rectangular, with books and a bowl."""
    high = 0.45
    if rng.chance(0.35):
        radius = rng.uniform(0.38, 0.46)
        top = kit.stone if rng.chance(0.5) else kit.wood
        made = cylinder(radius, high - 0.04, high, (0, 0, 0), top, 24)
        made += cylinder(0.05, 0.03, high - 0.04, (0, 0, 0), kit.metal, 10)
        made += cylinder(radius * 0.6, 0.0, 0.03, (0, 0, 0), kit.metal, 18)
        width = depth = 2 * radius
    else:
        width, depth = rng.uniform(0.9, 1.15), rng.uniform(0.5, 0.6)
        made = box((width, 0.04, depth), (0, high - 0.02, 0), kit.wood)
        made += shifted(_legs(width - 0.06, depth - 0.06, high - 0.04, 0.05, kit.dark_wood), 0, 0, 0)
        made += box((width - 0.1, 0.02, depth - 0.1), (0, 0.16, 0), kit.wood, pitch=0.5)
        made += shifted(book_stack(kit, rng), -width * 0.2, 0.171, 0)
    made += shifted(book_stack(kit, rng), -width * 0.22, high + 0.001, 0.02)
    made += shifted(bowl(kit, rng) if rng.chance(0.6) else vase(kit, rng, 0.26), width * 0.2, high + 0.001, -0.03)
    return Piece("coffee table", made, width, depth, high + 0.27)


def dining_table(kit: Kit, rng: Random, width: float, depth: float) -> Piece:
    """A table to eat at, with a runner, plates and a vase."""
    high = 0.75
    made = box((width, 0.04, depth), (0, high - 0.02, 0), kit.wood, pitch=0.3)
    made += box((width - 0.14, 0.08, depth - 0.14), (0, high - 0.08, 0), kit.wood, pitch=0.5)
    made += _legs(width - 0.08, depth - 0.08, high - 0.04, 0.07, kit.dark_wood)
    made += box((width * 0.7, 0.006, 0.32), (0, high + 0.003, 0), rng.choice(kit.cushions), pitch=0.3)
    made += shifted(vase(kit, rng, rng.uniform(0.24, 0.36)), 0.05, high + 0.007, 0.0)
    made += shifted(bowl(kit, rng), -width * 0.22, high + 0.007, 0.0)
    plate = [(0.001, 0.012), (0.08, 0.012), (0.125, 0.024), (0.12, 0.016), (0.07, 0.0)]
    for x in (-width * 0.25, width * 0.25):
        for z in (-depth * 0.33, depth * 0.33):
            made += lathe(plate, (x, high + 0.001, z), kit.ceramics[2], segments=16)
    return Piece("dining table", made, width, depth, high + 0.37)


def round_table(kit: Kit, rng: Random, radius: float) -> Piece:
    """A round dining table on one foot."""
    high = 0.75
    made = cylinder(radius, high - 0.035, high, (0, 0, 0), kit.stone if rng.chance(0.4) else kit.wood, 28)
    foot = [(0.06, high - 0.035), (0.05, 0.5), (0.07, 0.25), (0.05, 0.1), (0.24, 0.03), (0.25, 0.0)]
    made += lathe(foot, (0, 0, 0), kit.dark_wood, segments=14)
    made += shifted(vase(kit, rng, 0.3), 0, high + 0.001, 0)
    made += shifted(book_stack(kit, rng), radius * 0.5, high + 0.001, radius * 0.3)
    return Piece("dining table", made, 2 * radius, 2 * radius, high + 0.3)


def desk(kit: Kit, rng: Random) -> Piece:
    """A desk with drawers, a screen, a keyboard, a lamp and books; the user sits at the front."""
    width, depth, high = rng.uniform(1.2, 1.5), 0.65, 0.74
    made = box((width, 0.035, depth), (0, high - 0.0175, 0), kit.wood)
    made += box((0.4, 0.5, depth - 0.06), (width / 2 - 0.22, high - 0.29, 0), kit.trim)
    for place in (0.27, 0.43, 0.59):
        made += box((0.36, 0.145, 0.012), (width / 2 - 0.22, place + 0.04, depth / 2 - 0.024), kit.wood, pitch=1)
        made += box((0.12, 0.012, 0.02), (width / 2 - 0.22, place + 0.07, depth / 2 - 0.012), kit.metal, pitch=1)
    for x in (-width / 2 + 0.05, width / 2 - 0.05):
        for z in (-0.28, 0.28):
            made += box((0.05, high - 0.035, 0.05), (x, (high - 0.035) / 2, z), kit.dark_wood, pitch=1)
    made += box((0.24, 0.012, 0.18), (-0.08, high + 0.007, -0.14), kit.black, pitch=1)
    made += box((0.05, 0.2, 0.03), (-0.08, high + 0.1, -0.17), kit.black, pitch=1)
    made += box((0.62, 0.37, 0.03), (-0.08, high + 0.31, -0.15), kit.black, pitch=1)
    shown = (0.59, 0.34, 0.004)
    made += box(shown, (-0.08, high + 0.31, -0.131), kit.screen, faces=("front",), fit=(0, 0, 1, 1), pitch=1)
    made += box((0.42, 0.02, 0.14), (-0.08, high + 0.011, 0.14), kit.keys, fit=(0, 0, 1, 1), pitch=1)
    made += shifted(table_lamp(kit, rng), width / 2 - 0.2, high + 0.001, -0.12)
    made += shifted(book_stack(kit, rng), -width / 2 + 0.17, high + 0.001, 0.05)
    return Piece("desk", made, width, depth, 1.25, (Lamp((width / 2 - 0.2, 1.05, 0.0), 0.12),))


def side_table(kit: Kit, rng: Random) -> Piece:
    """A small table or night stand with a lamp or a vase."""
    side, high = 0.44, rng.uniform(0.5, 0.58)
    if rng.chance(0.5):
        made = cylinder(side / 2, high - 0.03, high, (0, 0, 0), kit.wood, 20)
        made += shifted(_legs(0.3, 0.3, high - 0.03, 0.03, kit.dark_wood), 0, 0, 0)
    else:
        middle = 0.12 + (high - 0.12) / 2
        made = box((side, high - 0.12, side), (0, middle, 0), kit.wood)
        made += _legs(side - 0.04, side - 0.04, 0.12, 0.04, kit.dark_wood)
        made += box((side - 0.06, high - 0.2, 0.012), (0, middle, side / 2 + 0.006), kit.dark_wood, pitch=1)
        made += box((0.03, 0.03, 0.02), (0, high - 0.14, side / 2 + 0.02), kit.metal, pitch=1)
    if rng.chance(0.65):
        made += shifted(table_lamp(kit, rng), -0.04, high + 0.001, -0.05)
        return Piece("side table", made, side, side + 0.06, high + 0.47, (Lamp((0.0, high + 0.4, 0.1), 0.16),))
    made += shifted(vase(kit, rng, 0.3), -0.06, high + 0.001, -0.05)
    made += shifted(book_stack(kit, rng), 0.06, high + 0.001, 0.1)
    return Piece("side table", made, side, side + 0.06, high + 0.31)
