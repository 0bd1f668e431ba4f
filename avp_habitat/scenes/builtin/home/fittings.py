"""What kitchens, baths and corridors are fitted with, and what stands about."""

from dataclasses import replace

from avp_habitat.scenes.builtin.decor import bowl, vase
from avp_habitat.scenes.builtin.kit import Kit, Lamp, Piece, shifted
from avp_habitat.scenes.builtin.noise import Random
from avp_habitat.scenes.builtin.shapes import MeshSurface, box, cushion, cylinder, lathe
from avp_habitat.scenes.builtin.shell import leaf_front


def _fronts(kit: Kit, width: float, low: float, high: float, z: float) -> list[MeshSurface]:
    """Doors with handles side by side, whose backs are at z; metres."""
    count = max(1, round(width / 0.5))
    each, made = width / count, []
    for index in range(count):
        x = -width / 2 + each * (index + 0.5)
        made += box((each - 0.012, high - low - 0.012, 0.02), (x, (low + high) / 2, z + 0.01), kit.wood)
        made += box((0.14, 0.016, 0.02), (x, high - 0.07, z + 0.03), kit.metal, pitch=1)
    return made


def kitchen_counter(kit: Kit, rng: Random, width: float) -> Piece:
    """Cupboards with a sink, a hob and things on top, and cupboards on the wall above."""
    depth, high = 0.62, 0.9
    made = box((width, high - 0.14, depth - 0.06), (0, 0.1 + (high - 0.14) / 2, -0.03), kit.dark_wood)
    made += box((width, 0.1, depth - 0.12), (0, 0.05, -0.05), kit.black, pitch=0.5)
    made += _fronts(kit, width, 0.12, high - 0.05, depth / 2 - 0.06)
    made += box((width, 0.04, depth), (0, high - 0.02, 0), kit.stone)
    side = rng.choice((-1, 1))
    made += box((0.5, 0.012, 0.4), (side * width * 0.28, high + 0.006, 0.02), kit.metal, pitch=1)
    made += box((0.42, 0.01, 0.32), (side * width * 0.28, high + 0.012, 0.02), kit.black, pitch=1)
    made += cylinder(0.016, 0.0, 0.24, (side * width * 0.28, high, -0.22), kit.metal, 8)
    made += box((0.02, 0.02, 0.18), (side * width * 0.28, high + 0.23, -0.14), kit.metal, pitch=1)
    made += box((0.56, 0.01, 0.48), (-side * width * 0.28, high + 0.005, 0.0), kit.black, pitch=1)
    pot = [(0.001, 0.15), (0.11, 0.15), (0.11, 0.0), (0.001, 0.0)]
    made += lathe(pot, (-side * width * 0.28 - 0.12, high + 0.01, -0.1), kit.metal, segments=14)
    made += shifted(bowl(kit, rng), 0.0, high + 0.001, 0.05)
    low, top, deep = 1.42, 2.08, 0.34
    middle = (0, (low + top) / 2, -depth / 2 + deep / 2 - 0.01)
    made += box((width, top - low, deep - 0.02), middle, kit.dark_wood)
    made += _fronts(kit, width, low + 0.01, top - 0.01, -depth / 2 + deep - 0.02)
    return Piece("kitchen counter", made, width, depth, top)


def fridge(kit: Kit, rng: Random) -> Piece:
    """A refrigerator with two doors."""
    width, depth, high = 0.62, 0.66, rng.uniform(1.7, 1.95)
    cut = high * 0.62
    made = box((width, high, depth - 0.05), (0, high / 2, -0.025), kit.trim)
    for low, top in ((0.06, cut - 0.006), (cut + 0.006, high - 0.01)):
        made += box((width, top - low, 0.04), (0, (low + top) / 2, depth / 2 - 0.03), kit.trim)
        made += box((0.03, 0.3, 0.02), (-width / 2 + 0.06, (low + top) / 2, depth / 2 - 0.005), kit.black, pitch=1)
    made += box((0.14, 0.2, 0.004), (0.1, cut - 0.3, depth / 2 - 0.008), kit.painting(wide=False), fit=(0, 0, 1, 1))
    return Piece("fridge", made, width, depth, high)


def bath_tub(kit: Kit, rng: Random) -> Piece:
    """A tub along the wall, with water in it and a towel over its rim."""
    width, depth, high, rim = rng.choice((1.5, 1.6, 1.7)), 0.74, 0.56, 0.07
    ceramic = kit.ceramics[2]
    made = box((width, 0.42, depth), (0, 0.21, 0), ceramic)
    for side in (-1, 1):
        made += box((width, high - 0.42, rim), (0, (high + 0.42) / 2, side * (depth - rim) / 2), ceramic, pitch=0.4)
        across = (rim, high - 0.42, depth - 2 * rim)
        made += box(across, (side * (width - rim) / 2, (high + 0.42) / 2, 0), ceramic, pitch=0.4)
    made += box((width - 2 * rim, 0.01, depth - 2 * rim), (0, 0.425, 0), kit.stone, faces=("top",))
    made += cushion((0.4, 0.3, 0.02), (width * 0.2, high - 0.12, depth / 2 + 0.012), 0.009, rng.choice(kit.cushions))
    made += box((0.3, 0.012, 0.14), (width * 0.2, high + 0.007, depth / 2 - 0.05), rng.choice(kit.cushions), pitch=1)
    return Piece("bath tub", made, width, depth + 0.05, high + 0.02)


def wash_stand(kit: Kit, rng: Random) -> Piece:
    """A basin on a cupboard under a mirror."""
    width, depth, high = rng.uniform(0.7, 1.0), 0.48, 0.84
    made = box((width, high - 0.14, depth - 0.04), (0, 0.1 + (high - 0.14) / 2, -0.02), kit.wood)
    made += box((width - 0.08, 0.1, depth - 0.12), (0, 0.05, -0.04), kit.dark_wood, pitch=0.5)
    made += _fronts(kit, width, 0.12, high - 0.05, depth / 2 - 0.05)
    made += box((width, 0.04, depth), (0, high - 0.02, 0), kit.stone, pitch=0.4)
    basin = [(0.001, 0.06), (0.14, 0.07), (0.19, 0.12), (0.2, 0.12), (0.15, 0.0)]
    made += lathe(basin, (0, high + 0.001, 0.0), kit.ceramics[2], segments=18)
    made += cylinder(0.014, 0.0, 0.2, (0, high, -0.19), kit.metal, 8)
    made += shifted(vase(kit, rng, 0.2), width / 2 - 0.1, high + 0.001, -0.08)
    made += box((width, 0.72, 0.03), (0, 1.5, -depth / 2 + 0.02), kit.dark_wood, pitch=0.5)
    made += box((width - 0.08, 0.64, 0.01), (0, 1.5, -depth / 2 + 0.038), kit.metal, pitch=0.4)
    return Piece("wash stand", made, width, depth, 1.86)


def toilet(kit: Kit, rng: Random) -> Piece:
    """A toilet with its cistern at the back."""
    white, depth = kit.ceramics[2], 0.68
    made = cushion((0.24, 0.36, 0.4), (0, 0.18, -0.02), 0.06, white)
    made += cushion((0.37, 0.1, 0.48), (0, 0.39, 0.09), 0.045, white)
    made += cushion((0.38, 0.035, 0.46), (0, 0.457, 0.1), 0.016, kit.wood if rng.chance(0.4) else kit.trim)
    made += cushion((0.4, 0.36, 0.18), (0, 0.62, -depth / 2 + 0.1), 0.03, white)
    made += cylinder(0.03, 0.0, 0.012, (0, 0.8, -depth / 2 + 0.1), kit.metal, 10)
    return Piece("toilet", made, 0.42, depth, 0.84)


def shoe_cabinet(kit: Kit, rng: Random) -> Piece:
    """A shallow cupboard with a vase and a bowl on top."""
    width, depth, high = rng.uniform(0.7, 1.1), 0.28, rng.uniform(0.8, 1.05)
    made = box((width, high, depth - 0.04), (0, high / 2, -0.02), kit.dark_wood)
    made += _fronts(kit, width, 0.06, high / 2, depth / 2 - 0.05)
    made += _fronts(kit, width, high / 2, high - 0.02, depth / 2 - 0.05)
    made += shifted(vase(kit, rng, 0.3), -width * 0.3, high + 0.001, 0)
    made += shifted(bowl(kit, rng), width * 0.2, high + 0.001, -0.01)
    return Piece("shoe cabinet", made, width, depth + 0.04, high + 0.31)


def basket(kit: Kit, rng: Random) -> Piece:
    """A wicker basket with cloth in it, too high to climb for an agent whose steps are of 0.2 m."""
    radius, high = rng.uniform(0.18, 0.24), rng.uniform(0.54, 0.64)
    made = lathe([(radius, high), (radius * 0.82, 0.0)], (0, 0, 0), kit.wicker, segments=14, open_ended=True)
    heap = [
        (0.001, high + 0.05),
        (radius * 0.6, high + 0.03),
        (radius * 0.96, high - 0.06),
        (radius * 0.96, high - 0.1),
    ]
    made += lathe(heap, (0, 0, 0), rng.choice(kit.cushions), segments=10)
    return Piece("basket", made, 2 * radius + 0.02, 2 * radius + 0.02, high + 0.06)


def boxes(kit: Kit, rng: Random) -> Piece:
    """Two or three boxes on each other, the lowest too high to climb."""
    made, y = [], 0.0
    width, depth = rng.uniform(0.4, 0.55), rng.uniform(0.34, 0.42)
    for index in range(rng.integer(2, 3)):
        high, shrink = rng.uniform(0.44, 0.52) if index == 0 else rng.uniform(0.18, 0.3), 0.04 * index
        material = rng.choice((kit.wicker, kit.linen, kit.wood, *kit.cushions))
        made += box((width - shrink, high, depth - shrink), (0, y + high / 2, 0), material)
        y += high + 0.001
    return Piece("boxes", made, width, depth, y)


def covered(kit: Kit, bed: Piece) -> Piece:
    """A bed whose quilt hangs over its sides, so that no agent climbs from the frame to the mattress."""
    size = (bed.width + 0.004, 0.22, bed.depth + 0.004)
    sides = ("top", "front", "left", "right")
    return replace(bed, surfaces=[*bed.surfaces, *box(size, (0, 0.41, 0), kit.bedding, faces=sides)])


def ceiling_lamp(kit: Kit, ceiling: float) -> Piece:
    """A flat round lamp under the ceiling; heights in metres above the floor."""
    radius = 0.2
    shade = [
        (radius * 0.9, ceiling - 0.002),
        (radius, ceiling - 0.03),
        (radius * 0.9, ceiling - 0.09),
        (0.001, ceiling - 0.1),
    ]
    made = lathe(shade, (0, 0, 0), kit.lampshade, segments=18)
    return Piece("ceiling lamp", made, 2 * radius, 2 * radius, ceiling, (Lamp((0.0, ceiling - 0.25, 0.0), 0.42),))


def open_leaf(kit: Kit, width: float) -> Piece:
    """A door's leaf that stands open, flat before the wall; its front looks into the room."""
    high, thick = 1.98, 0.036
    made = box((width, high, thick), (0, high / 2 + 0.01, -0.02), kit.wood)
    made += leaf_front(kit, -width / 2, width / 2, -0.02 + thick / 2)
    return Piece("door leaf", made, width, 0.1, high + 0.01)
