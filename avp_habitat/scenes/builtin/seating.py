"""Furniture to sit and lie on: sofa, armchair, chairs, pouf, bed."""

from avp_habitat.scenes.builtin.dice import Dice
from avp_habitat.scenes.builtin.kit import Kit
from avp_habitat.scenes.builtin.piece import Piece, shifted
from avp_habitat.scenes.builtin.shapes import Material, Surface, box, cushion, cylinder, leaned, yawed

SEAT_M = 0.46
"""Seats are higher than an agent with quantised steps of 0.2 m can climb."""


def _legs(width: float, depth: float, height: float, side: float, material: Material) -> list[Surface]:
    x, z = width / 2 - side / 2, depth / 2 - side / 2
    made = []
    for sx, sz in ((-x, -z), (x, -z), (-x, z), (x, z)):
        made += box((side, height, side), (sx, height / 2, sz), material, pitch=1.0)
    return made


def _pillow(kit: Kit, dice: Dice, x: float, y: float, z: float, lean: float = -0.3) -> list[Surface]:
    """A loose pillow that leans back; (x, y, z) is where its lower edge rests."""
    side = dice.number(0.36, 0.46)
    made = shifted(cushion((side, side, 0.1), (0, 0, 0), 0.05, dice.pick(kit.cushions), puff=0.03), 0, side / 2, 0)
    return yawed(leaned(made, lean), dice.number(-0.25, 0.25), (x, y, z))


def _padded(kit: Kit, dice: Dice, width: float, seats: int, cloth: Material, kind: str) -> Piece:
    """A sofa or armchair with the given number of seats."""
    depth, arm, back = 0.9, dice.number(0.14, 0.2), 0.2
    high, arm_high = dice.number(0.8, 0.92), dice.number(0.56, 0.66)
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
        made += _pillow(kit, dice, x, 0.47, -depth / 2 + back + 0.3)
    return Piece(kind, made, width, depth, max(high, 0.95))


def sofa(kit: Kit, dice: Dice) -> Piece:
    """Two or three seats with loose pillows."""
    seats = dice.pick((2, 3, 3))
    return _padded(
        kit, dice, dice.number(1.65, 1.85) if seats == 2 else dice.number(2.0, 2.3), seats, kit.upholstery, "sofa"
    )


def armchair(kit: Kit, dice: Dice) -> Piece:
    """One padded seat."""
    return _padded(kit, dice, dice.number(0.82, 0.92), 1, kit.second_cloth, "armchair")


def chair(kit: Kit, dice: Dice, material: Material) -> Piece:
    """A dining chair with a slatted or padded back."""
    width, depth, high = 0.44, 0.46, 0.9
    made = _legs(width, depth, SEAT_M - 0.04, 0.04, material)
    made += cushion((width, 0.06, depth), (0, SEAT_M - 0.01, 0), 0.02, kit.second_cloth)
    for side in (-1, 1):
        made += box(
            (0.04, high - SEAT_M, 0.04), (side * 0.2, (high + SEAT_M) / 2, -depth / 2 + 0.02), material, pitch=1
        )
    if dice.chance(0.5):
        made += cushion((0.36, 0.3, 0.04), (0, 0.72, -depth / 2 + 0.025), 0.018, kit.second_cloth)
    else:
        for place in (0.62, 0.73, 0.84):
            made += box((0.36, 0.06, 0.025), (0, place, -depth / 2 + 0.02), material, pitch=1)
    return Piece("chair", made, width, depth, high)


def office_chair(kit: Kit, dice: Dice) -> Piece:
    """A swivel chair on a star foot."""
    made: list[Surface] = []
    for turn in range(5):
        made += yawed(box((0.05, 0.05, 0.27), (0, 0.06, 0.135), kit.black, pitch=1), turn * 1.2566)
    made += cylinder(0.035, 0.06, 0.42, (0, 0, 0), kit.metal, 8)
    made += cushion((0.48, 0.09, 0.46), (0, 0.47, 0), 0.04, kit.second_cloth, puff=0.01)
    made += cushion((0.44, 0.52, 0.08), (0, 0.83, -0.22), 0.035, kit.second_cloth, puff=0.01)
    made += box((0.06, 0.3, 0.03), (0, 0.58, -0.275), kit.black, pitch=1)
    return Piece("office chair", made, 0.58, 0.58, 1.1)


def pouf(kit: Kit, dice: Dice) -> Piece:
    """An upholstered stool."""
    side = dice.number(0.42, 0.5)
    made = cushion((side, SEAT_M, side), (0, SEAT_M / 2, 0), 0.09, dice.pick(kit.cushions), puff=0.0)
    return Piece("pouf", made, side, side, SEAT_M)


def bed(kit: Kit, dice: Dice) -> Piece:
    """A bed with headboard, quilt and pillows; the headboard is at the back."""
    width, depth, high = dice.pick((1.0, 1.5, 1.7)), 2.1, dice.number(0.95, 1.2)
    made = box((width, 0.22, depth), (0, 0.19, 0), kit.wood, pitch=0.5)
    made += _legs(width - 0.04, depth - 0.04, 0.08, 0.08, kit.dark_wood)
    board = kit.upholstery if dice.chance(0.4) else kit.wood
    made += cushion((width, high - 0.3, 0.07), (0, 0.3 + (high - 0.3) / 2, -depth / 2 + 0.035), 0.03, board)
    made += cushion((width - 0.1, 0.22, depth - 0.14), (0, 0.41, 0.0), 0.06, kit.linen)
    made += cushion((width, 0.2, depth - 0.75), (0, 0.455, 0.345), 0.07, kit.bedding, puff=0.02)
    count = 1 if width < 1.2 else 2
    for index in range(count):
        x = 0.0 if count == 1 else (index - 0.5) * width * 0.48
        made += cushion((0.62, 0.13, 0.4), (x, 0.57, -depth / 2 + 0.34), 0.06, kit.linen, puff=0.03)
    made += _pillow(kit, dice, 0.0, 0.62, -depth / 2 + 0.62, -0.95)
    return Piece("bed", made, width, depth, high)
