"""How agents move: along a displacement until a wall, then along the wall.

An agent is a disc of `SKIN_M` radius that may not touch the walls, which makes corners round and the test exact: a line
against the offset of every wall and against the circle around every corner. Nothing is sampled, so no displacement is
too long.
"""

import numpy as np
from numpy.typing import NDArray

from avp_habitat.compiled import njit
from avp_habitat.navigation.walls import SKIN_M, Walls, near_line

_MOST_CONTACTS = 32
_PARALLEL = 1e-12
_STILL_M = 1e-12
"""Less than this is no move. In a corner each contact leaves some 1e-17 of a displacement, whose square soon is 0."""


def slide(walls: Walls, positions: NDArray[np.float64], displacements: NDArray[np.float64]) -> NDArray[np.float64]:
    """Move agents on the floor plane.

    Args:
        walls: outline of the navigable area.
        positions: `(n, 2)` x and z inside the outline, metres.
        displacements: `(n, 2)` metres.

    Returns:
        `(n, 2)` end points inside the outline.
    """
    return _slide_all(walls, np.ascontiguousarray(positions), np.ascontiguousarray(displacements))


@njit(cache=True)
def _slide_all(walls, positions, displacements):
    ends = np.empty_like(positions)
    seen = np.zeros(len(walls.ends), np.int64)
    found = np.empty(len(walls.ends), np.int64)
    ticket = 0
    for i in range(len(positions)):
        x, z = positions[i]
        dx, dz = displacements[i]
        for _ in range(_MOST_CONTACTS):
            if abs(dx) + abs(dz) < _STILL_M:
                break
            ticket += 1
            count = near_line(walls, x, z, x + dx, z + dz, seen, ticket, found)
            share, normal_x, normal_z = _first_contact(walls.ends, found[:count], x, z, dx, dz)
            x, z = x + share * dx, z + share * dz
            inward = dx * normal_x + dz * normal_z
            dx, dz = (1 - share) * (dx - inward * normal_x), (1 - share) * (dz - inward * normal_z)
            forward = dx * displacements[i, 0] + dz * displacements[i, 1]
            if share >= 1 or forward <= 0:
                break
        ends[i, 0], ends[i, 1] = x, z
    return ends


@njit(cache=True)
def _first_contact(ends, walls, x, z, dx, dz):
    """Share of the displacement up to the first contact (1 for none) and the contact's normal."""
    first, normal_x, normal_z = 1.0, 0.0, 0.0
    for k in walls:
        ax, az, bx, bz = ends[k]
        share, nx, nz = _wall_contact(ax, az, bx, bz, x, z, dx, dz)
        if share < first:
            first, normal_x, normal_z = share, nx, nz
        share, nx, nz = _corner_contact(ax, az, x, z, dx, dz)
        if share < first:
            first, normal_x, normal_z = share, nx, nz
        share, nx, nz = _corner_contact(bx, bz, x, z, dx, dz)
        if share < first:
            first, normal_x, normal_z = share, nx, nz
    return first, normal_x, normal_z


@njit(cache=True)
def _wall_contact(ax, az, bx, bz, x, z, dx, dz):
    """Contact with the straight of a wall: only from its inner side, only when moving towards it."""
    length = np.hypot(bx - ax, bz - az)
    ux, uz = (bx - ax) / length, (bz - az) / length
    nx, nz = -uz, ux
    approach = -(dx * nx + dz * nz)
    off = (x - ax) * nx + (z - az) * nz
    if approach <= _PARALLEL * np.hypot(dx, dz) or off < -SKIN_M:
        return 2.0, nx, nz
    share = max((off - SKIN_M) / approach, 0.0)
    along = (x + share * dx - ax) * ux + (z + share * dz - az) * uz
    return (share if 0 <= along <= length else 2.0), nx, nz


@njit(cache=True)
def _corner_contact(cx, cz, x, z, dx, dz):
    """Contact with the circle of the skin's radius around a corner: only when moving towards it."""
    off_x, off_z = x - cx, z - cz
    towards = off_x * dx + off_z * dz
    squared = dx * dx + dz * dz
    if towards >= -_PARALLEL * np.sqrt(squared * (off_x * off_x + off_z * off_z)):
        return 2.0, 0.0, 0.0
    clearance = off_x * off_x + off_z * off_z - SKIN_M * SKIN_M
    share = 0.0
    if clearance > 0:
        root = towards * towards - squared * clearance
        if root < 0:
            return 2.0, 0.0, 0.0
        share = (-towards - np.sqrt(root)) / squared
    hit_x, hit_z = off_x + share * dx, off_z + share * dz
    distance = np.hypot(hit_x, hit_z)
    return share, hit_x / distance, hit_z / distance
