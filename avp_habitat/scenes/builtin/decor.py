"""Shelves and chests, and what makes a room lived in: books, vases, lamps, plants, rugs, pictures, a clock."""

import numpy as np

from avp_habitat.scenes.builtin.kit import Kit, Lamp, Piece, shifted
from avp_habitat.scenes.builtin.noise import Random
from avp_habitat.scenes.builtin.pictures import SPINES, spine_cell
from avp_habitat.scenes.builtin.shapes import HALF_TURN, MeshSurface, box, cylinder, lathe, sheet, yawed


def vase(kit: Kit, rng: Random, high: float) -> list[MeshSurface]:
    """A bellied vase, its foot at the origin, metres."""
    belly = high * rng.uniform(0.26, 0.36)
    shares = ((0.45, 1), (0.5, 0.92), (0.36, 0.8), (0.8, 0.6), (1, 0.36), (0.8, 0.12), (0.55, 0))
    profile = [(0.002, high * 0.94), *((belly * radius, high * y) for radius, y in shares)]
    return lathe(profile, (0, 0, 0), rng.choice(kit.ceramics), segments=12)


def bowl(kit: Kit, rng: Random) -> list[MeshSurface]:
    """A bowl with fruit, its foot at the origin."""
    profile = [(0.001, 0.03), (0.09, 0.05), (0.14, 0.09), (0.145, 0.09), (0.1, 0.03), (0.06, 0.0)]
    made = lathe(profile, (0, 0, 0), rng.choice(kit.ceramics), segments=14)
    fruit = [(0.001, 0.075), (0.03, 0.065), (0.04, 0.04), (0.03, 0.012), (0.001, 0.004)]
    for x, z in ((-0.04, 0.02), (0.045, 0.03), (0.0, -0.05)):
        made += lathe(fruit, (x, 0.045, z), rng.choice(kit.cushions), segments=8)
    return made


def book_stack(kit: Kit, rng: Random) -> list[MeshSurface]:
    """A few books lying on each other, foot at the origin."""
    made, y = [], 0.0
    for _ in range(rng.integer(2, 4)):
        thick = rng.uniform(0.02, 0.04)
        one = box((0.23, thick, 0.16), (0, 0, 0), kit.books, fit=spine_cell(rng.integer(0, SPINES - 1)), pitch=1)
        made += shifted(yawed(one, rng.uniform(-0.3, 0.3)), 0, y + thick / 2, 0)
        y += thick + 0.001
    return made


def table_lamp(kit: Kit, rng: Random) -> list[MeshSurface]:
    """A small lamp, its foot at the origin, 0.46 m high."""
    foot = [(0.012, 0.3), (0.02, 0.24), (0.06, 0.16), (0.075, 0.09), (0.05, 0.02), (0.06, 0.0)]
    made = lathe(foot, (0, 0, 0), rng.choice(kit.ceramics), segments=10)
    return made + lathe([(0.09, 0.46), (0.15, 0.26)], (0, 0, 0), kit.lampshade, segments=14, open_ended=True)


_SHADES = (
    ((0.03, 0.24), (0.12, 0.2), (0.2, 0.1), (0.23, 0.0)),
    ((0.16, 0.24), (0.25, 0.0)),
    ((0.05, 0.24), (0.06, 0.16), (0.26, 0.0)),
)
"""Radii and heights of lampshades in metres."""


def rug(kit: Kit, width: float, depth: float) -> Piece:
    """A knotted rug, 12 mm thick."""
    made = box((width, 0.012, depth), (0, 0.007, 0), kit.rug(width, depth), faces=("top",), fit=(0, 0, 1, 1), pitch=0.2)
    made += box((width, 0.012, depth), (0, 0.007, 0), kit.linen, faces=("front", "back", "right", "left"), pitch=0.5)
    return Piece("rug", made, width, depth, 0.014)


def floor_lamp(kit: Kit, rng: Random) -> Piece:
    """A standing lamp with a cloth shade."""
    high = rng.uniform(1.55, 1.75)
    made = cylinder(0.15, 0.0, 0.025, (0, 0, 0), kit.metal, 18)
    made += lathe([(0.014, high - 0.1), (0.014, 0.025)], (0, 0, 0), kit.metal, segments=8)
    made += lathe([(0.15, high), (0.2, high - 0.3)], (0, 0, 0), kit.lampshade, segments=18, open_ended=True)
    made += lathe([(0.001, high - 0.02), (0.148, high - 0.02)], (0, 0, 0), kit.lampshade, segments=18, open_ended=True)
    return Piece("floor lamp", made, 0.42, 0.42, high, (Lamp((0.0, high - 0.2, 0.0), 0.3),))


def pendant(kit: Kit, rng: Random, ceiling: float, bottom: float) -> Piece:
    """A lamp that hangs from the ceiling; all heights in metres above the floor."""
    shade_high = 0.24
    made = cylinder(0.05, ceiling - 0.03, ceiling - 0.002, (0, 0, 0), kit.metal, 12)
    made += lathe([(0.006, ceiling - 0.03), (0.006, bottom + shade_high)], (0, 0, 0), kit.metal, segments=6)
    profile = rng.choice(_SHADES)
    outline = [(radius, y + bottom) for radius, y in profile]
    made += lathe(outline, (0, 0, 0), kit.lampshade, segments=20, open_ended=True)
    made += lathe([(0.001, bottom + 0.23), (outline[0][0], bottom + 0.235)], (0, 0, 0), kit.metal, segments=12)
    return Piece("pendant", made, 0.52, 0.52, ceiling, (Lamp((0.0, bottom - 0.05, 0.0), 0.45),))


def _leaf(kit: Kit, root: np.ndarray, yaw: float, rise: float, length: float, width: float) -> list[MeshSurface]:
    """One bent leaf from its root outwards."""
    along = np.linspace(0.0, 1.0, 5)
    ahead = np.array([np.sin(yaw), 0.0, np.cos(yaw)])
    side = np.array([np.cos(yaw), 0.0, -np.sin(yaw)])
    up = np.array([0.0, 1.0, 0.0])
    spine = root + along[:, None] * length * ahead + (rise * along - 0.75 * length * along**2)[:, None] * up
    half = width * np.array([0.1, 0.42, 0.5, 0.34, 0.02])
    across = np.array([-1.0, 0.0, 1.0])
    points = spine[:, None] + across[None, :, None] * half[:, None, None] * side
    points[:, 1, 1] -= 0.12 * half
    uv = np.stack(np.broadcast_arrays((across / 2 + 0.5)[None], along[:, None]), axis=-1)
    return sheet(points, uv, kit.leaf, both_sides=True)


def plant(kit: Kit, rng: Random) -> Piece:
    """A pot with a bushy plant."""
    high, spread = rng.uniform(0.9, 1.5), 0.34
    pot = rng.choice([*kit.ceramics, kit.wicker])
    pot_high = 0.36
    made = lathe([(0.17, pot_high), (0.19, pot_high), (0.17, 0.1), (0.14, 0.0)], (0, 0, 0), pot, segments=16)
    made += lathe([(0.001, pot_high - 0.03), (0.17, pot_high - 0.03)], (0, 0, 0), kit.dark_wood, segments=12)
    made += lathe([(0.012, high - 0.25), (0.02, pot_high - 0.05)], (0, 0, 0), kit.dark_wood, segments=6)
    count = rng.integer(16, 22)
    for index in range(count):
        level = index / count
        root = np.array([0.0, pot_high + (high - 0.3 - pot_high) * level, 0.0])
        length = spread * rng.uniform(0.72, 0.98) * (1 - 0.25 * level)
        yaw, rise = index * 2.4 + rng.uniform(-0.2, 0.2), rng.uniform(0.28, 0.5)
        made += _leaf(kit, root, yaw, rise, length, rng.uniform(0.11, 0.17))
    return Piece("plant", made, 0.72, 0.72, high + 0.05)


def picture(kit: Kit, rng: Random, width: float, height: float) -> list[MeshSurface]:
    """A framed painting whose back touches z = 0, centred at the origin."""
    frame = rng.choice((kit.dark_wood, kit.wood, kit.black, kit.trim, kit.metal))
    bar, deep = 0.035, 0.03
    made: list[MeshSurface] = []
    for side in (-1, 1):
        made += box((width, bar, deep), (0, side * (height - bar) / 2, deep / 2 + 0.002), frame, pitch=1)
        made += box((bar, height - 2 * bar, deep), (side * (width - bar) / 2, 0, deep / 2 + 0.002), frame, pitch=1)
    canvas = kit.painting(wide=width > height)
    inner = (width - 2 * bar, height - 2 * bar, 0.012)
    made += box(inner, (0, 0, 0.008), canvas, faces=("front",), fit=(0, 0, 1, 1), pitch=0.4)
    return made


def clock(kit: Kit) -> list[MeshSurface]:
    """A round wall clock of 0.3 m whose back touches z = 0, centred at the origin."""
    angle = np.linspace(0, 2 * np.pi, 25)
    sine, cosine = np.sin(angle), np.cos(angle)
    made: list[MeshSurface] = []
    for radius, z, material in ((0.16, 0.03, kit.dark_wood), (0.14, 0.033, kit.linen)):
        rings = ((radius, 0.002), (radius, z), (0.001, z))
        points = np.stack([np.stack([r * sine, r * cosine, np.full(25, depth)], axis=-1) for r, depth in rings])
        made += sheet(points[1:], points[1:, :, :2] / material.width_m, material)
        made += sheet(points[:2], points[:2, :, 1:] / material.width_m, material)
    for hour in range(12):
        x, y = 0.115 * np.sin(hour * np.pi / 6), 0.115 * np.cos(hour * np.pi / 6)
        made += box((0.014, 0.014, 0.006), (float(x), float(y), 0.037), kit.black, pitch=1)
    made += box((0.012, 0.1, 0.004), (0.0, 0.045, 0.04), kit.black, pitch=1)
    made += box((0.07, 0.012, 0.004), (0.03, 0.0, 0.04), kit.black, pitch=1)
    return made


def _row_of_books(kit: Kit, rng: Random, width: float, clear: float, depth: float) -> list[MeshSurface]:
    """Books from the left until the board is nearly full; foot of the row at the origin, spines to +z."""
    made, x = [], -width / 2 + 0.01
    end = width / 2 - rng.uniform(0.05, 0.4) * min(width, 0.8)
    while x < end:
        thick, high = rng.uniform(0.025, 0.06), min(rng.uniform(0.18, 0.32), clear - 0.02)
        deep = min(rng.uniform(0.14, 0.2), depth)
        cell = spine_cell(rng.integer(0, SPINES - 1))
        centre = (x + thick / 2, high / 2, depth / 2 - deep / 2)
        made += box((thick, high, deep), centre, kit.books, faces=("front", "right", "left"), fit=cell, pitch=1)
        made += box((thick, high, deep), centre, kit.books, faces=("top",), fit=spine_cell(SPINES), pitch=1)
        x += thick + 0.002
    if end < width / 2 - 0.24:
        made += shifted(vase(kit, rng, min(clear * 0.7, 0.26)), width / 2 - 0.13, 0, depth / 2 - 0.1)
    return made


def _filled_board(kit: Kit, rng: Random, width: float, clear: float, depth: float) -> list[MeshSurface]:
    """What stands on one board of a shelf."""
    if rng.chance(0.78):
        return _row_of_books(kit, rng, width, clear, depth)
    if rng.chance(0.5):
        return box((min(width * 0.8, 0.5), clear * 0.7, depth * 0.8), (0, clear * 0.35, 0), kit.wicker, pitch=1)
    made = shifted(book_stack(kit, rng), -width * 0.2, 0, depth / 2 - 0.12)
    return made + shifted(vase(kit, rng, clear * 0.75), width * 0.25, 0, depth / 2 - 0.12)


def _shelf_half(kit: Kit, rng: Random, width: float, depth: float, high: float, columns: int) -> list[MeshSurface]:
    """Boards and their contents of a shelf whose back is at z = 0 and whose front is at z = depth."""
    made: list[MeshSurface] = []
    boards = max(3, round(high / 0.38))
    pitch = (high - 0.1) / boards
    column = (width - 0.03) / columns
    for edge in range(columns + 1):
        x = -width / 2 + 0.015 + edge * column
        made += box((0.03, high, depth), (x, high / 2, depth / 2), kit.wood, pitch=0.5)
    for level in range(boards + 1):
        y = 0.08 + level * pitch
        for index in range(columns):
            x = -width / 2 + 0.015 + (index + 0.5) * column
            made += box((column - 0.03, 0.024, depth - 0.004), (x, y, depth / 2), kit.wood, pitch=0.5)
            if level < boards:
                inside = _filled_board(kit, rng, column - 0.04, pitch - 0.03, depth - 0.06)
                made += shifted(inside, x, y + 0.013, depth / 2)
    return made


def bookshelf(kit: Kit, rng: Random) -> Piece:
    """A shelf with a back, full of books."""
    width, depth, high = rng.uniform(0.9, 1.6), 0.32, rng.uniform(1.75, 2.1)
    half = _shelf_half(kit, rng, width, depth - 0.012, high, max(1, round(width / 0.7)))
    made = shifted(half, 0, 0, -depth / 2 + 0.012)
    made += box((width, high, 0.012), (0, high / 2, -depth / 2 + 0.006), kit.dark_wood)
    return Piece("bookshelf", made, width, depth, high)


def divider_shelf(kit: Kit, rng: Random, width: float) -> Piece:
    """A tall shelf with books on both sides and a panel in its middle, which parts a room."""
    depth, high, columns = 0.44, rng.uniform(1.75, 2.0), max(1, round(width / 0.7))
    front, back = (shifted(_shelf_half(kit, rng, width, depth / 2 - 0.01, high, columns), 0, 0, 0.01) for _ in range(2))
    made = front + yawed(back, HALF_TURN)
    made += box((width, high, 0.02), (0, high / 2, 0), kit.dark_wood)
    return Piece("divider shelf", made, width, depth, high)


def wardrobe(kit: Kit, rng: Random) -> Piece:
    """A wardrobe with panelled doors, handles and a box on top."""
    doors = rng.integer(2, 4)
    width, depth, high = doors * rng.uniform(0.46, 0.54), 0.6, rng.uniform(1.95, 2.15)
    body, front = (kit.wood, kit.trim) if rng.chance(0.4) else (kit.dark_wood, kit.wood)
    made = box((width, high, depth - 0.04), (0, high / 2, -0.02), body)
    each = width / doors
    for door in range(doors):
        x = -width / 2 + each * (door + 0.5)
        made += box((each - 0.012, high - 0.14, 0.022), (x, high / 2 + 0.03, depth / 2 - 0.029), front)
        for y, tall in ((high * 0.3, high * 0.34), (high * 0.72, high * 0.38)):
            made += box((each - 0.16, tall, 0.01), (x, y, depth / 2 - 0.013), body, pitch=0.5)
        x += (each / 2 - 0.045) * (1 if door % 2 == 0 else -1)
        made += box((0.018, 0.16, 0.02), (x, high * 0.5, depth / 2 - 0.012), kit.metal, pitch=1)
    if rng.chance(0.6):
        made += box((0.5, 0.22, 0.36), (-width * 0.2, high + 0.11, -0.05), kit.wicker)
        high += 0.22
    return Piece("wardrobe", made, width, depth, high)


def drawers(kit: Kit, rng: Random) -> Piece:
    """A chest of drawers with things on top."""
    width, depth, high = rng.uniform(0.9, 1.3), 0.46, rng.uniform(0.75, 0.9)
    front = kit.trim if rng.chance(0.3) else kit.wood
    made = box((width, high - 0.1, depth - 0.03), (0, 0.1 + (high - 0.1) / 2, -0.015), kit.dark_wood)
    made += box((width, 0.1, depth - 0.1), (0, 0.05, -0.04), kit.dark_wood, pitch=0.5)
    tall, wide = (high - 0.14) / 3, (width - 0.02) / 2
    for row in range(3):
        for column in range(2):
            x, y = -width / 2 + 0.01 + wide * (column + 0.5), 0.12 + tall * (row + 0.5)
            made += box((wide - 0.015, tall - 0.015, 0.02), (x, y, depth / 2 - 0.022), front, pitch=0.6)
            made += box((0.12, 0.015, 0.018), (x, y, depth / 2 - 0.009), kit.metal, pitch=1)
    made += shifted(vase(kit, rng, rng.uniform(0.28, 0.4)), -width * 0.3, high + 0.001, 0)
    made += shifted(book_stack(kit, rng), width * 0.05, high + 0.001, 0)
    made += shifted(bowl(kit, rng), width * 0.32, high + 0.001, 0)
    return Piece("drawers", made, width, depth, high + 0.41)


def television(kit: Kit, rng: Random) -> Piece:
    """A low unit with a television, books and a vase on it."""
    width, depth, high = rng.uniform(1.4, 1.8), 0.42, 0.48
    made = box((width, high - 0.1, depth - 0.02), (0, 0.1 + (high - 0.1) / 2, -0.01), kit.wood)
    made += box((width - 0.1, 0.1, depth - 0.1), (0, 0.05, -0.02), kit.dark_wood, pitch=0.5)
    each = width / 3
    for index in range(3):
        x = -width / 2 + each * (index + 0.5)
        front = kit.wicker if index == 1 else kit.dark_wood
        made += box((each - 0.03, high - 0.16, 0.016), (x, high / 2 + 0.05, depth / 2 - 0.012), front, pitch=0.6)
    wide = rng.uniform(1.0, 1.2)
    tall = wide * 0.58
    made += box((0.3, 0.012, 0.2), (0, high + 0.007, -0.05), kit.black, pitch=1)
    made += box((0.06, 0.1, 0.03), (0, high + 0.06, -0.08), kit.black, pitch=1)
    made += box((wide, tall, 0.04), (0, high + 0.09 + tall / 2, -0.06), kit.black)
    frame = ((wide - 0.03), (tall - 0.03), 0.004)
    made += box(frame, (0, high + 0.09 + tall / 2, -0.036), kit.television, faces=("front",), fit=(0, 0, 1, 1), pitch=1)
    made += shifted(vase(kit, rng, 0.24), width / 2 - 0.13, high + 0.001, 0)
    return Piece("television", made, width, depth, high + 0.1 + tall)
