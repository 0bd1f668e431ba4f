"""A floor that fills with furniture, none of it in another's place, the door free, the rest walkable."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import label

from avp_habitat.scenes.builtin.groups import Group, Member
from avp_habitat.scenes.builtin.kit import FLAT_M, Lamp, Piece
from avp_habitat.scenes.builtin.shapes import Float, Rectangle, Surface, moved
from avp_habitat.scenes.builtin.shell import CURTAIN_M, Point, Shell, Wall, curtain_bottom

CELL_M = 0.1
RADIUS_M = 0.15
"""The agent's radius and half a cell, so that the answer errs on the safe side."""
_QUARTERS = ((1, 0), (0, 1), (-1, 0), (0, -1))
"""Cosine and sine of quarter turns."""


def free_cells(shell: Shell, blocks: list[Rectangle]) -> NDArray[np.bool_]:
    """`(rows, columns)` cells of 0.1 m, rows along z, where an agent can stand.

    Args:
        shell: the empty room.
        blocks: x0, z0, x1, z1 in metres of what stands on the floor.
    """
    x0, z0, x1, z1 = shell.bounds
    x = np.arange(x0 + CELL_M / 2, x1, CELL_M)
    z = np.arange(z0 + CELL_M / 2, z1, CELL_M)
    free = ((z > z0 + RADIUS_M) & (z < z1 - RADIUS_M))[:, None] & ((x > x0 + RADIUS_M) & (x < x1 - RADIUS_M))[None]
    notch = [shell.notch] if shell.notch is not None else []
    for a, b, c, d in [*blocks, *notch]:
        rows = slice(*np.searchsorted(z, (b - RADIUS_M, d + RADIUS_M)))
        columns = slice(*np.searchsorted(x, (a - RADIUS_M, c + RADIUS_M)))
        free[rows, columns] = False
    return free


def largest_part(free: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The largest 4-connected part of a mask."""
    parts, _ = label(free)  # pyright: ignore[reportGeneralTypeIssues]
    sizes = np.bincount(parts.ravel())
    sizes[0] = 0
    return free & (parts == sizes.argmax())


def walkable_share(shell: Shell, blocks: list[Rectangle]) -> float:
    """Share of the floor in the largest walkable part; 0 where other parts come to more than 0.3 m²."""
    free = free_cells(shell, blocks)
    part = largest_part(free)
    if (int(free.sum()) - int(part.sum())) * CELL_M**2 > 0.3:
        return 0.0
    return int(part.sum()) * CELL_M**2 / shell.floor_area


@dataclass(frozen=True, eq=False)
class Placed:
    """A piece and where it stands."""

    piece: Piece
    axes: Float
    """`(3, 3)` columns are the piece's x, y and z in the world."""
    position: Point
    """x, z of its foot in metres."""
    footprint: Rectangle
    """x0, z0, x1, z1 of the axis-aligned rectangle that it keeps to."""

    def surfaces(self) -> list[Surface]:
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
    """An axis-aligned box that furniture occupies or that must stay free."""

    x0: float
    z0: float
    x1: float
    z1: float
    low: float = 0.0
    high: float = 2.0
    solid: bool = True

    def meets(self, other: "Block", margin: float = 0.0) -> bool:
        """Whether two boxes come closer than the margin on the floor and overlap in height."""
        along_x = self.x0 < other.x1 + margin and other.x0 < self.x1 + margin
        along_z = self.z0 < other.z1 + margin and other.z0 < self.z1 + margin
        return along_x and along_z and self.low < other.high and other.low < self.high

    @property
    def flat(self) -> "Block":
        """The same rectangle from the floor to 2 m."""
        return Block(self.x0, self.z0, self.x1, self.z1)


class Floor:
    """A room that fills with furniture."""

    def __init__(self, shell: Shell) -> None:
        """Start with the empty room, where the door, windows and curtains claim their places."""
        self.shell = shell
        self.placed: list[Placed] = []
        self.blocks: list[Block] = []
        self.rugs: list[Block] = []
        for hole in shell.openings:
            wall = shell.walls[hole.wall]
            if hole.kind == "door":
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
            (rugs if stand.piece.height <= FLAT_M else solids).append(Block(*stand.footprint, 0.03, stand.piece.height))
        areas = [
            _before(wall, (right + a, inwards + b, right + c, inwards + d), 0.03, 1.9) for a, b, c, d in group.clear
        ]
        if not all(self.shell.contains(area.x0, area.z0, area.x1, area.z1) for area in areas):
            return False
        if self._are_in_the_way(solids, rugs, areas):
            return False
        rectangles = [(b.x0, b.z0, b.x1, b.z1) for b in [*self.blocks, *solids] if b.solid]
        if walkable_share(self.shell, rectangles) < least_share:
            return False
        self.placed += stands
        self.blocks += solids + areas
        self.rugs += rugs
        return True

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
        block = Block(*stand.footprint, low, high)
        return self.shell.contains(*stand.footprint) and not any(block.meets(other, margin) for other in self.blocks)

    def hang(self, stand: Placed, low: float, high: float) -> None:
        """Put something on a wall or ceiling, where it takes no floor."""
        self.placed.append(stand)
        self.blocks.append(Block(*stand.footprint, low, high, False))


def places(start: float, end: float, pitch: float) -> list[float]:
    """Positions from start up to but without end, metres, rounded to centimetres."""
    return [round(start + index * pitch, 2) for index in range(max(0, int((end - start) / pitch - 1e-9) + 1))]


def _before(wall: Wall, rectangle: Rectangle, low: float, high: float, *, solid: bool = False) -> Block:
    """A block before a wall: left, inwards, right, inwards in metres, between two heights."""
    (xa, za), (xb, zb) = wall.point(*rectangle[:2]), wall.point(*rectangle[2:])
    return Block(min(xa, xb), min(za, zb), max(xa, xb), max(za, zb), low, high, solid)


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
