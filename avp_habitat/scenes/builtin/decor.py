"""What makes a room lived in: rugs, lamps, plants, pictures on the walls, a clock."""

import numpy as np

from avp_habitat.scenes.builtin.kit import Kit, Lamp, Piece
from avp_habitat.scenes.builtin.noise import Random
from avp_habitat.scenes.builtin.shapes import Surface, box, cylinder, lathe, sheet


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
    profile = rng.choice(
        (
            [(0.03, 0.24), (0.12, 0.2), (0.2, 0.1), (0.23, 0.0)],
            [(0.16, 0.24), (0.25, 0.0)],
            [(0.05, 0.24), (0.06, 0.16), (0.26, 0.0)],
        )
    )
    outline = [(radius, y + bottom) for radius, y in profile]
    made += lathe(outline, (0, 0, 0), kit.lampshade, segments=20, open_ended=True)
    made += lathe([(0.001, bottom + 0.23), (outline[0][0], bottom + 0.235)], (0, 0, 0), kit.metal, segments=12)
    return Piece("pendant", made, 0.52, 0.52, ceiling, (Lamp((0.0, bottom - 0.05, 0.0), 0.45),))


def _leaf(kit: Kit, root: np.ndarray, yaw: float, rise: float, length: float, width: float) -> list[Surface]:
    """One bent leaf from its root outwards."""
    along = np.linspace(0.0, 1.0, 5)
    ahead = np.array([np.sin(yaw), 0.0, np.cos(yaw)])
    side = np.array([np.cos(yaw), 0.0, -np.sin(yaw)])
    spine = (
        root + along[:, None] * length * ahead + (rise * along - 0.75 * length * along**2)[:, None] * [0.0, 1.0, 0.0]
    )
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
        made += _leaf(
            kit, root, index * 2.4 + rng.uniform(-0.2, 0.2), rng.uniform(0.28, 0.5), length, rng.uniform(0.11, 0.17)
        )
    return Piece("plant", made, 0.72, 0.72, high + 0.05)


def picture(kit: Kit, rng: Random, width: float, height: float) -> list[Surface]:
    """A framed painting whose back touches z = 0, centred at the origin."""
    frame = rng.choice((kit.dark_wood, kit.wood, kit.black, kit.trim, kit.metal))
    bar, deep = 0.035, 0.03
    made: list[Surface] = []
    for side in (-1, 1):
        made += box((width, bar, deep), (0, side * (height - bar) / 2, deep / 2 + 0.002), frame, pitch=1)
        made += box((bar, height - 2 * bar, deep), (side * (width - bar) / 2, 0, deep / 2 + 0.002), frame, pitch=1)
    canvas = kit.painting(wide=width > height)
    inner = (width - 2 * bar, height - 2 * bar, 0.012)
    made += box(inner, (0, 0, 0.008), canvas, faces=("front",), fit=(0, 0, 1, 1), pitch=0.4)
    return made


def clock(kit: Kit) -> list[Surface]:
    """A round wall clock of 0.3 m whose back touches z = 0, centred at the origin."""
    angle = np.linspace(0, 2 * np.pi, 25)
    made: list[Surface] = []
    for radius, z, material in ((0.16, 0.03, kit.dark_wood), (0.14, 0.033, kit.linen)):
        rows = [
            np.stack([r * np.sin(angle), r * np.cos(angle), np.full_like(angle, depth)], axis=-1)
            for r, depth in ((radius, 0.002), (radius, z), (0.001, z))
        ]
        points = np.stack(rows)
        made += sheet(points[1:], points[1:, :, :2] / material.width_m, material)
        made += sheet(points[:2], points[:2, :, 1:] / material.width_m, material)
    for hour in range(12):
        x, y = 0.115 * np.sin(hour * np.pi / 6), 0.115 * np.cos(hour * np.pi / 6)
        made += box((0.014, 0.014, 0.006), (float(x), float(y), 0.037), kit.black, pitch=1)
    made += box((0.012, 0.1, 0.004), (0.0, 0.045, 0.04), kit.black, pitch=1)
    made += box((0.07, 0.012, 0.004), (0.03, 0.0, 0.04), kit.black, pitch=1)
    return made
