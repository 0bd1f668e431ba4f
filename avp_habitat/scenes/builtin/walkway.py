"""How much of a floor plan can still be walked on, in one connected part."""

import numpy as np
from numpy.typing import NDArray

from avp_habitat.scenes.builtin.shell import Shell

CELL_M = 0.1
RADIUS_M = 0.15
"""The agent's radius and half a cell, so that the answer errs on the safe side."""


def free_cells(shell: Shell, blocks: list[tuple[float, float, float, float]]) -> NDArray[np.bool_]:
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
    rest, best = free.copy(), np.zeros_like(free)
    while rest.sum() > best.sum():
        part = np.zeros_like(free)
        part.flat[int(np.argmax(rest))] = True
        size = 0
        while size != (size := int(part.sum())):
            for _ in range(4):
                grown = part.copy()
                grown[1:] |= part[:-1]
                grown[:-1] |= part[1:]
                grown[:, 1:] |= part[:, :-1]
                grown[:, :-1] |= part[:, 1:]
                part = grown & free
        rest &= ~part
        if part.sum() > best.sum():
            best = part
    return best


def walkable_share(shell: Shell, blocks: list[tuple[float, float, float, float]]) -> float:
    """Share of the floor in the largest walkable part; 0 where other parts come to more than 0.3 m²."""
    free = free_cells(shell, blocks)
    part = largest_part(free)
    if (int(free.sum()) - int(part.sum())) * CELL_M**2 > 0.3:
        return 0.0
    return int(part.sum()) * CELL_M**2 / shell.floor_area
