"""Furniture to keep things in: shelves with books, wardrobe, drawers, television unit."""

from avp_habitat.scenes.builtin.kit import Kit, Piece, shifted
from avp_habitat.scenes.builtin.noise import Random
from avp_habitat.scenes.builtin.pictures import SPINES, spine_cell
from avp_habitat.scenes.builtin.seating import book_stack, bowl, vase
from avp_habitat.scenes.builtin.shapes import Surface, box, yawed


def _row_of_books(kit: Kit, rng: Random, width: float, clear: float, depth: float) -> list[Surface]:
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


def _filled_board(kit: Kit, rng: Random, width: float, clear: float, depth: float) -> list[Surface]:
    """What stands on one board of a shelf."""
    if rng.chance(0.78):
        return _row_of_books(kit, rng, width, clear, depth)
    if rng.chance(0.5):
        basket = box((min(width * 0.8, 0.5), clear * 0.7, depth * 0.8), (0, clear * 0.35, 0), kit.wicker, pitch=1)
        return basket
    made = shifted(book_stack(kit, rng), -width * 0.2, 0, depth / 2 - 0.12)
    return made + shifted(vase(kit, rng, clear * 0.75), width * 0.25, 0, depth / 2 - 0.12)


def _shelf_half(kit: Kit, rng: Random, width: float, depth: float, high: float, columns: int) -> list[Surface]:
    """Boards and their contents of a shelf whose back is at z = 0 and whose front is at z = depth."""
    made: list[Surface] = []
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
    made = shifted(
        _shelf_half(kit, rng, width, depth - 0.012, high, max(1, round(width / 0.7))), 0, 0, -depth / 2 + 0.012
    )
    made += box((width, high, 0.012), (0, high / 2, -depth / 2 + 0.006), kit.dark_wood)
    return Piece("bookshelf", made, width, depth, high)


def divider_shelf(kit: Kit, rng: Random, width: float) -> Piece:
    """A tall shelf with books on both sides and a panel in its middle, which parts a room."""
    depth, high, columns = 0.44, rng.uniform(1.75, 2.0), max(1, round(width / 0.7))
    front = shifted(_shelf_half(kit, rng, width, depth / 2 - 0.01, high, columns), 0, 0, 0.01)
    back = shifted(_shelf_half(kit, rng, width, depth / 2 - 0.01, high, columns), 0, 0, 0.01)
    made = front + yawed(back, 3.14159265)
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
        side = 1 if door % 2 == 0 else -1
        made += box(
            (0.018, 0.16, 0.02), (x + side * (each / 2 - 0.045), high * 0.5, depth / 2 - 0.012), kit.metal, pitch=1
        )
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
    rows, columns = 3, 2
    tall, wide = (high - 0.14) / rows, (width - 0.02) / columns
    for row in range(rows):
        for column in range(columns):
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
