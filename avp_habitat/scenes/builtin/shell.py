"""Surfaces of the empty room: floor, ceiling, walls, windows, door, curtains."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from avp_habitat.scenes.builtin.kit import Kit
from avp_habitat.scenes.builtin.noise import Random
from avp_habitat.scenes.builtin.shapes import Material, MeshSurface, Rectangle, box, moved, panel, sheet

Point = tuple[float, float]
"""x, z on the floor in metres, or a direction there."""
CURTAIN_M = 0.3
"""Width of a drawn curtain beside its window."""
WALL_M = 0.12
"""Thickness of a wall between two rooms."""
_RECESS_M = 0.14
_SLACK_M = 1e-6


@dataclass(frozen=True)
class Wall:
    """A straight wall; seen from inside it runs from `start` to the right."""

    start: Point
    along: Point
    """Unit vector to the right."""
    length: float

    @property
    def inward(self) -> Point:
        """Unit vector into the room."""
        return (-self.along[1], self.along[0])

    def axes(self) -> NDArray[np.float64]:
        """`(3, 3)`: columns are along, up and inward."""
        (ax, az), (nx, nz) = self.along, self.inward
        return np.array([[ax, 0.0, nx], [0.0, 1.0, 0.0], [az, 0.0, nz]])

    def point(self, right: float, inwards: float) -> Point:
        """A point that far along the wall and in front of it, metres."""
        (ax, az), (nx, nz) = self.along, self.inward
        return self.start[0] + ax * right + nx * inwards, self.start[1] + az * right + nz * inwards


@dataclass(frozen=True)
class Opening:
    """A `window`, a closed `door` or an open `passage` (its kind) in the wall of an index.

    Metres from the wall's left end, and above the floor.
    """

    wall: int
    left: float
    right: float
    bottom: float
    top: float
    kind: str


@dataclass(frozen=True)
class Shell:
    """The empty room; lengths are in metres."""

    corners: tuple[Point, ...]
    """Outline on the floor in the order of the walls."""
    notch: Rectangle | None
    """x0, z0, x1, z1 of the rectangle that an L-shaped room lacks."""
    ceiling: float
    openings: tuple[Opening, ...]

    @cached_property
    def walls(self) -> tuple[Wall, ...]:
        """One wall from each corner to the next."""
        made = []
        for (x0, z0), (x1, z1) in zip(self.corners, self.corners[1:] + self.corners[:1], strict=True):
            length = abs(x1 - x0) + abs(z1 - z0)
            made.append(Wall((x0, z0), ((x1 - x0) / length, (z1 - z0) / length), length))
        return tuple(made)

    @cached_property
    def bounds(self) -> Rectangle:
        """x0, z0, x1, z1 of the outline."""
        xs, zs = [x for x, _ in self.corners], [z for _, z in self.corners]
        return min(xs), min(zs), max(xs), max(zs)

    @property
    def floor_area(self) -> float:
        """Square metres."""
        x0, z0, x1, z1 = self.bounds
        missing = 0.0 if self.notch is None else (self.notch[2] - self.notch[0]) * (self.notch[3] - self.notch[1])
        return (x1 - x0) * (z1 - z0) - missing

    def contains(self, x0: float, z0: float, x1: float, z1: float) -> bool:
        """Whether a rectangle on the floor lies inside the outline."""
        left, near, right, far = self.bounds
        if x0 < left - _SLACK_M or z0 < near - _SLACK_M or x1 > right + _SLACK_M or z1 > far + _SLACK_M:
            return False
        if self.notch is None:
            return True
        a, b, c, d = self.notch
        return x1 <= a + _SLACK_M or x0 >= c - _SLACK_M or z1 <= b + _SLACK_M or z0 >= d - _SLACK_M

    def depth_at(self, wall: Wall, right: float) -> float:
        """Metres from a point of a wall straight to what stands opposite."""
        point, inward = wall.point(right, 0.0), wall.inward
        ahead = 0 if inward[0] else 1
        sign, aside = (1 if inward[ahead] > 0 else -1), 1 - ahead
        depth = (self.bounds[ahead + 2 if sign > 0 else ahead] - point[ahead]) * sign
        if self.notch is not None and self.notch[aside] < point[aside] < self.notch[aside + 2]:
            gap = (self.notch[ahead if sign > 0 else ahead + 2] - point[ahead]) * sign
            depth = min(depth, gap) if gap > _SLACK_M else depth
        return round(depth, 2)


def _outline(rng: Random) -> tuple[tuple[Point, ...], Rectangle | None]:
    """Corners and, of an L-shaped room, what it lacks."""
    width, depth = rng.uniform(4.0, 8.0), rng.uniform(3.5, 6.5)
    x0, z0 = -round(width / 2, 2), -round(depth / 2, 2)
    x1, z1 = round(x0 + width, 2), round(z0 + depth, 2)
    corners = [(x0, z0), (x1, z0), (x1, z1), (x0, z1)]
    if width < 5.2 or depth < 4.6 or rng.chance(0.4):
        return tuple(corners), None
    wide = min(round(width * rng.uniform(0.32, 0.5), 2), width - 2.6)
    deep = min(round(depth * rng.uniform(0.32, 0.5), 2), depth - 2.4)
    missing = rng.integer(0, 3)
    a, b = corners[missing]
    c, d = round(x0 + wide if a == x0 else x1 - wide, 2), round(z0 + deep if b == z0 else z1 - deep, 2)
    inner = [(a, d), (c, d), (c, b)]
    corners[missing : missing + 1] = inner[::-1] if missing % 2 else inner
    if missing == 0:
        corners = corners[2:] + corners[:2]
    return tuple(corners), (min(a, c), min(b, d), max(a, c), max(b, d))


def plan_window(rng: Random, wall: int, length: float, ceiling: float) -> Opening:
    """A window somewhere in the middle of a stretch of wall, metres; at least 2.4 long."""
    width = min(rng.uniform(1.1, 2.0), length - 1.4)
    left = round((length - width) * rng.uniform(0.35, 0.65), 2)
    bottom = rng.choice((0.85, 0.9, 0.95, 0.55))
    return Opening(wall, left, round(left + width, 2), bottom, round(min(ceiling - 0.35, 2.25), 2), "window")


def plan_shell(rng: Random) -> Shell:
    """A rectangular or L-shaped room with one door and one to three windows on other walls."""
    corners, notch = _outline(rng)
    ceiling = rng.uniform(2.5, 3.2)
    shell = Shell(corners, notch, ceiling, ())
    first, *others = rng.shuffled([index for index, wall in enumerate(shell.walls) if wall.length >= 2.4])
    left = 0.3 if rng.chance(0.5) else round(shell.walls[first].length - 1.2, 2)
    openings = [Opening(first, left, round(left + 0.9, 2), 0.0, 2.05, "door")]
    windows = rng.integer(1, 2) if shell.floor_area < 24 else rng.integer(2, 3)
    openings += [plan_window(rng, index, shell.walls[index].length, ceiling) for index in others[:windows]]
    return replace(shell, openings=tuple(openings))


def _floor_and_ceiling(kit: Kit, shell: Shell) -> list[MeshSurface]:
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


def _reveal(left: float, right: float, bottom: float, top: float, deep: float, material: Material) -> list[MeshSurface]:
    """The four inner sides of a hole in a wall, in the wall's frame."""
    fall, across = (0.0, bottom - top, 0.0), (right - left, 0.0, 0.0)
    return [
        panel((left, top, 0.0), (0.0, 0.0, -deep), fall, material),
        panel((right, top, -deep), (0.0, 0.0, deep), fall, material),
        panel((left, top, 0.0), across, (0.0, 0.0, -deep), material),
        panel((left, bottom, -deep), across, (0.0, 0.0, deep), material),
    ]


def _window_surfaces(kit: Kit, hole: Opening) -> list[MeshSurface]:
    left, right, bottom, top = hole.left, hole.right, hole.bottom, hole.top
    width, height = right - left, top - bottom
    made = _reveal(left, right, bottom, top, _RECESS_M, kit.trim)
    back = (left, top, -_RECESS_M)
    made.append(panel(back, (width, 0.0, 0.0), (0.0, -height, 0.0), kit.view(), fit=(0, 0, 1, 1), pitch=1.0))
    bar, z = 0.05, -_RECESS_M + 0.03
    for x in np.linspace(left + bar / 2, right - bar / 2, 3 if width < 1.5 else 4):
        made += box((bar, height, 0.05), (float(x), (top + bottom) / 2, z), kit.trim, pitch=0.6)
    for y in (bottom + bar / 2 + 0.013, bottom + height * 0.7, top - bar / 2):
        made += box((width, bar, 0.044), ((left + right) / 2, y, z), kit.trim, pitch=0.6)
    sill = (width + 0.12, 0.032, _RECESS_M + 0.05)
    return made + box(sill, ((left + right) / 2, bottom - 0.004, 0.025 - _RECESS_M / 2 + 0.02), kit.trim)


def _door(kit: Kit, hole: Opening) -> list[MeshSurface]:
    left, right, top, deep = hole.left, hole.right, hole.top, 0.06
    width = right - left
    made = _reveal(left, right, 0.0, top, deep, kit.trim)
    made.append(panel((left, top, -deep), (width, 0.0, 0.0), (0.0, -top, 0.0), kit.wood, turned=True))
    made += leaf_front(kit, left, right, -deep)
    return made + _architrave(kit, hole)


def leaf_front(kit: Kit, left: float, right: float, z: float) -> list[MeshSurface]:
    """Panels and handle of a door's leaf whose front is at z, hinged on the left; metres in the wall's frame."""
    made: list[MeshSurface] = []
    width = right - left
    for y, tall in ((0.55, 0.7), (1.45, 0.85)):
        for x in (left + width * 0.28, left + width * 0.72):
            made += box((width * 0.32, tall, 0.016), (x, y, 0.01 + z), kit.wood, pitch=0.5)
            made += box((width * 0.24, tall - 0.1, 0.016), (x, y, 0.02 + z), kit.dark_wood, pitch=0.5)
    made += box((0.12, 0.02, 0.03), (right - 0.13, 1.02, 0.03 + z), kit.metal, pitch=1)
    return made + box((0.03, 0.16, 0.012), (right - 0.08, 1.0, 0.008 + z), kit.metal, pitch=1)


def _architrave(kit: Kit, hole: Opening) -> list[MeshSurface]:
    """The boards around a door or passage."""
    left, right, top = hole.left, hole.right, hole.top
    made: list[MeshSurface] = []
    for x in (left - 0.04, right + 0.04):
        made += box((0.08, top + 0.08, 0.022), (x, (top + 0.08) / 2, 0.011), kit.trim, pitch=0.6)
    return made + box((right - left, 0.08, 0.021), ((left + right) / 2, top + 0.04, 0.0105), kit.trim, pitch=0.6)


def _passage(kit: Kit, hole: Opening) -> list[MeshSurface]:
    """This room's half of an open doorway through a wall, with a sill of wood."""
    left, right = hole.left, hole.right
    made = _reveal(left, right, 0.0, hole.top, WALL_M / 2, kit.trim)[:3]
    made.append(panel((left, 0.0, -WALL_M / 2), (right - left, 0.0, 0.0), (0.0, 0.0, WALL_M / 2), kit.wood))
    return made + _architrave(kit, hole)


def _drape(kit: Kit, left: float, right: float, bottom: float, top: float) -> list[MeshSurface]:
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


def _curtains(kit: Kit, hole: Opening, bottom: float) -> list[MeshSurface]:
    top = hole.top + 0.14
    made = _drape(kit, hole.left - CURTAIN_M + 0.02, hole.left + 0.04, bottom, top)
    made += _drape(kit, hole.right - 0.04, hole.right + CURTAIN_M - 0.02, bottom, top)
    length = hole.right - hole.left + 2 * CURTAIN_M
    return made + box((length, 0.024, 0.024), ((hole.left + hole.right) / 2, top + 0.014, 0.095), kit.metal, pitch=1)


def curtain_bottom(shell: Shell, hole: Opening) -> float:
    """Height in metres at which the curtains of a window end."""
    return 0.03 if round(shell.ceiling * 100) % 2 else hole.bottom - 0.15


def _skirting(kit: Kit, wall: Wall, holes: list[Opening]) -> list[MeshSurface]:
    beside = [edge for hole in holes if hole.kind != "window" for edge in (hole.left - 0.08, hole.right + 0.08)]
    edges = [0.0, *sorted(beside), wall.length]
    made = []
    for left, right in zip(edges[::2], edges[1::2], strict=True):
        if right - left > 0.02:
            centre = ((left + right) / 2, 0.045, 0.0075)
            made += box((right - left, 0.09, 0.015), centre, kit.trim, faces=("front", "top", "left", "right"))
    return made


def _wall(kit: Kit, shell: Shell, index: int, material: Material) -> list[MeshSurface]:
    wall, high = shell.walls[index], shell.ceiling
    holes = [hole for hole in shell.openings if hole.wall == index]
    cut = tuple((hole.left, high - hole.top, hole.right, high - hole.bottom) for hole in holes)
    made = [panel((0.0, high, 0.0), (wall.length, 0.0, 0.0), (0.0, -high, 0.0), material, pitch=0.25, holes=cut)]
    for hole in holes:
        if hole.kind == "window":
            made += _window_surfaces(kit, hole) + _curtains(kit, hole, curtain_bottom(shell, hole))
        else:
            made += _door(kit, hole) if hole.kind == "door" else _passage(kit, hole)
    made += _skirting(kit, wall, holes)
    return moved(made, wall.axes(), np.array([wall.start[0], 0.0, wall.start[1]]))


def build_shell(kit: Kit, rng: Random, shell: Shell) -> list[MeshSurface]:
    """All surfaces of the empty room in the world frame; their fronts look inwards."""
    made = _floor_and_ceiling(kit, shell)
    order = rng.shuffled(list(range(len(shell.walls))))
    special = dict(zip(order, (kit.feature_wall, kit.papered_wall), strict=False))
    if rng.chance(0.4):
        special[order[2]] = kit.feature_wall
    for index in range(len(shell.walls)):
        made += _wall(kit, shell, index, special.get(index, kit.wall))
    return made
