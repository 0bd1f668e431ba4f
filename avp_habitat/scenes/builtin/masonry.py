"""Surfaces of the empty room: floor, ceiling, walls, windows, door, curtains."""

import numpy as np

from avp_habitat.scenes.builtin.dice import Dice
from avp_habitat.scenes.builtin.kit import Kit
from avp_habitat.scenes.builtin.shapes import Material, Surface, box, moved, panel, sheet
from avp_habitat.scenes.builtin.shell import Opening, Shell, Wall

RECESS_M = 0.14
CURTAIN_M = 0.3
"""Width of a drawn curtain beside its window."""


def _floor_and_ceiling(kit: Kit, shell: Shell) -> list[Surface]:
    x0, z0, x1, z1 = shell.bounds
    floor_hole, ceiling_hole = (), ()
    if shell.notch is not None:
        a, b, c, d = shell.notch
        floor_hole = ((a - x0, b - z0, c - x0, d - z0),)
        ceiling_hole = ((a - x0, z1 - d, c - x0, z1 - b),)
    high, across = shell.ceiling, (x1 - x0, 0.0, 0.0)
    return [
        panel((x0, 0.0, z0), across, (0.0, 0.0, z1 - z0), kit.floor, pitch=0.2, holes=floor_hole),
        panel((x0, high, z1), across, (0.0, 0.0, z0 - z1), kit.ceiling, pitch=0.3, holes=ceiling_hole),
    ]


def _reveal(left: float, right: float, bottom: float, top: float, deep: float, material: Material) -> list[Surface]:
    """The four inner sides of a hole in a wall, in the wall's frame."""
    fall, across = (0.0, bottom - top, 0.0), (right - left, 0.0, 0.0)
    return [
        panel((left, top, 0.0), (0.0, 0.0, -deep), fall, material),
        panel((right, top, -deep), (0.0, 0.0, deep), fall, material),
        panel((left, top, 0.0), across, (0.0, 0.0, -deep), material),
        panel((left, bottom, -deep), across, (0.0, 0.0, deep), material),
    ]


def _window(kit: Kit, hole: Opening) -> list[Surface]:
    left, right, bottom, top = hole.left, hole.right, hole.bottom, hole.top
    width, height = right - left, top - bottom
    made = _reveal(left, right, bottom, top, RECESS_M, kit.trim)
    back = (left, top, -RECESS_M)
    made.append(panel(back, (width, 0.0, 0.0), (0.0, -height, 0.0), kit.view(), fit=(0, 0, 1, 1), pitch=1.0))
    bar, z = 0.05, -RECESS_M + 0.03
    for x in np.linspace(left + bar / 2, right - bar / 2, 3 if width < 1.5 else 4):
        made += box((bar, height, 0.05), (float(x), (top + bottom) / 2, z), kit.trim, pitch=0.6)
    for y in (bottom + bar / 2 + 0.013, bottom + height * 0.7, top - bar / 2):
        made += box((width, bar, 0.044), ((left + right) / 2, y, z), kit.trim, pitch=0.6)
    sill = (width + 0.12, 0.032, RECESS_M + 0.05)
    return made + box(sill, ((left + right) / 2, bottom - 0.004, 0.025 - RECESS_M / 2 + 0.02), kit.trim)


def _door(kit: Kit, hole: Opening) -> list[Surface]:
    left, right, top, deep = hole.left, hole.right, hole.top, 0.06
    width, middle = right - left, (left + right) / 2
    made = _reveal(left, right, 0.0, top, deep, kit.trim)
    made.append(panel((left, top, -deep), (width, 0.0, 0.0), (0.0, -top, 0.0), kit.wood, turned=True))
    for y, tall in ((0.55, 0.7), (1.45, 0.85)):
        for x in (left + width * 0.28, left + width * 0.72):
            made += box((width * 0.32, tall, 0.016), (x, y, 0.01 - deep), kit.wood, pitch=0.5)
            made += box((width * 0.24, tall - 0.1, 0.016), (x, y, 0.02 - deep), kit.dark_wood, pitch=0.5)
    made += box((0.12, 0.02, 0.03), (right - 0.13, 1.02, 0.03 - deep), kit.metal, pitch=1)
    made += box((0.03, 0.16, 0.012), (right - 0.08, 1.0, 0.008 - deep), kit.metal, pitch=1)
    for x in (left - 0.04, right + 0.04):
        made += box((0.08, top + 0.08, 0.022), (x, (top + 0.08) / 2, 0.011), kit.trim, pitch=0.6)
    return made + box((width, 0.08, 0.021), (middle, top + 0.04, 0.0105), kit.trim, pitch=0.6)


def _drape(kit: Kit, left: float, right: float, bottom: float, top: float) -> list[Surface]:
    """A curtain in folds, in the wall's frame."""
    folds = np.linspace(0.0, 1.0, 25)
    rows = np.linspace(0.0, 1.0, 8)
    wide = 0.8 + 0.2 * rows
    x = (left + right) / 2 + (folds[None] - 0.5) * (right - left) * wide[:, None]
    z = 0.095 + 0.028 * np.sin(folds * 2 * np.pi * 4.5)[None] * (0.6 + 0.4 * rows[:, None])
    points = np.stack([x, np.broadcast_to((top + (bottom - top) * rows)[:, None], x.shape), z], axis=-1)
    cloth = kit.curtain
    u = folds * (right - left) * 1.7 / cloth.width_m
    uv = np.stack(np.broadcast_arrays(u[None], (rows * (top - bottom) / cloth.height_m)[:, None]), axis=-1)
    return sheet(points, uv, cloth, both_sides=True)


def _curtains(kit: Kit, hole: Opening, bottom: float) -> list[Surface]:
    top = hole.top + 0.14
    made = _drape(kit, hole.left - CURTAIN_M + 0.02, hole.left + 0.04, bottom, top)
    made += _drape(kit, hole.right - 0.04, hole.right + CURTAIN_M - 0.02, bottom, top)
    length = hole.right - hole.left + 2 * CURTAIN_M
    return made + box((length, 0.024, 0.024), ((hole.left + hole.right) / 2, top + 0.014, 0.095), kit.metal, pitch=1)


def curtain_bottom(shell: Shell, hole: Opening) -> float:
    """Height in metres at which the curtains of a window end."""
    return 0.03 if round(shell.ceiling * 100) % 2 else hole.bottom - 0.15


def _skirting(kit: Kit, wall: Wall, holes: list[Opening]) -> list[Surface]:
    edges = [0.0]
    for hole in holes:
        if hole.kind == "door":
            edges += [hole.left - 0.08, hole.right + 0.08]
    edges.append(wall.length)
    made = []
    for left, right in zip(edges[::2], edges[1::2], strict=True):
        if right - left > 0.02:
            centre = ((left + right) / 2, 0.045, 0.0075)
            made += box((right - left, 0.09, 0.015), centre, kit.trim, faces=("front", "top", "left", "right"))
    return made


def _wall(kit: Kit, shell: Shell, index: int, material: Material) -> list[Surface]:
    wall, high = shell.walls[index], shell.ceiling
    holes = [hole for hole in shell.openings if hole.wall == index]
    cut = tuple((hole.left, high - hole.top, hole.right, high - hole.bottom) for hole in holes)
    made = [panel((0.0, high, 0.0), (wall.length, 0.0, 0.0), (0.0, -high, 0.0), material, pitch=0.25, holes=cut)]
    for hole in holes:
        if hole.kind == "door":
            made += _door(kit, hole)
        else:
            made += _window(kit, hole) + _curtains(kit, hole, curtain_bottom(shell, hole))
    made += _skirting(kit, wall, holes)
    return moved(made, wall.axes(), np.array([wall.start[0], 0.0, wall.start[1]]))


def build_shell(kit: Kit, dice: Dice, shell: Shell) -> list[Surface]:
    """All surfaces of the empty room in the world frame; their fronts look inwards."""
    made = _floor_and_ceiling(kit, shell)
    order = dice.shuffled(list(range(len(shell.walls))))
    special = dict(zip(order, (kit.feature_wall, kit.papered_wall), strict=False))
    if dice.chance(0.4):
        special[order[2]] = kit.feature_wall
    for index in range(len(shell.walls)):
        made += _wall(kit, shell, index, special.get(index, kit.wall))
    return made
