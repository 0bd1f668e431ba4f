"""Which tops of solid spans an agent can stand on and step between, by Recast's rules, however they are wound.

Directions are numbered 0: -X, 1: +Z, 2: +X, 3: -Z. Source: M. Mononen, Recast Navigation 1.6.0 (filters, compact
heightfield). Recast takes for a floor what faces upwards. The same holds here for what is wound the wrong way round,
seen from below: see `_walkable`.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from avp_habitat.compiled import njit
from avp_habitat.navigation.heightfield import DOWNWARDS, UPWARDS, Heightfield
from avp_habitat.navigation.settings import NavigationSettings

SKY = 0xFFFF
"""Ceiling of a place that has none."""
STEP_X = np.array([-1, 0, 1, 0])
STEP_Z = np.array([0, 1, 0, -1])


@dataclass(frozen=True)
class StandingPlaces:
    """Voxel columns' floors on which an agent can stand, with those that it can step to."""

    column: NDArray[np.int64]
    """`(n,)` row-major index of each place's column, ascending."""
    floor: NDArray[np.int32]
    """`(n,)` first voxel above the floor."""
    ceiling: NDArray[np.int32]
    """`(n,)` first solid voxel above it; 65535 under the open sky."""
    neighbour: NDArray[np.int64]
    """`(n, 4)` index of the place that a step leads to in each direction, -1 for none."""


def standing_places(field: Heightfield, settings: NavigationSettings) -> StandingPlaces:
    """Apply the rules for low-hanging obstacles, ledges and low ceilings, and link the places that remain."""
    height, climb = settings.height_voxels, settings.climb_voxels
    ceiling = _ceilings(field.first, field.bottom)
    walkable = _walkable(field, ceiling, height, climb)
    walkable = _step_onto_low_obstacles(field.first, field.top, walkable, climb)
    ledge = _ledges(field.first, field.bottom, field.top, ceiling, walkable, field.shape, height, climb)
    return _linked(field, walkable & ~ledge & (ceiling - field.top >= height), ceiling, height, climb)


def _linked(field: Heightfield, kept: NDArray, ceiling: NDArray, height: int, climb: int) -> StandingPlaces:
    """The spans' tops that are kept, each with those that a step leads to."""
    column = np.repeat(np.arange(len(field.first) - 1), np.diff(field.first))[kept]
    floor, ceiling = field.top[kept], ceiling[kept]
    first = np.searchsorted(column, np.arange(len(field.first)))
    return StandingPlaces(column, floor, ceiling, _neighbours(first, floor, ceiling, field.shape, height, climb))


def _walkable(field: Heightfield, ceiling: NDArray, height: int, climb: int) -> NDArray[np.bool_]:
    """`(n,)` whether an agent may step on the spans' tops, whichever way round their triangles are wound.

    What tells floors from ceilings is the ground: the lowest level top of a column that has room for an agent. Where
    more of the ground faces downwards than upwards, the whole scene is wound the wrong way round: what faces downwards
    counts as facing upwards, and the other way about. Of the rest, as where one part of a scene is wound otherwise than
    the others, what faces downwards is a floor where most of it is ground; a ceiling is not, for the floor is below it.
    """
    up, down = field.facing & UPWARDS > 0, field.facing & DOWNWARDS > 0
    roomy = ceiling - field.top >= height
    # The height of a sheet; in a wall, floor and ceiling are one span.
    sheet = field.top - field.bottom <= climb + 1
    ground = _ground(field.first, field.facing, roomy, sheet)
    if (field.highest[ground] == DOWNWARDS).sum() > (field.highest[ground] == UPWARDS).sum():
        up, down = down, up
    doubtful = down & ~up & roomy
    if not (ground & doubtful).any():
        return up
    return up | _mostly(field, doubtful, ground, ceiling, height, climb)


def _mostly(
    field: Heightfield, doubtful: NDArray, ground: NDArray, ceiling: NDArray, height: int, climb: int
) -> NDArray[np.bool_]:
    """`(n,)` the doubtful tops of connected pieces that are ground for the greater part."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    neighbour = _linked(field, doubtful, ceiling, height, climb).neighbour
    begin, direction = np.nonzero(neighbour >= 0)
    links = coo_matrix((np.ones(len(begin), bool), (begin, neighbour[begin, direction])), shape=(len(neighbour),) * 2)
    piece = connected_components(links, directed=False)[1]
    share = np.bincount(piece, ground[doubtful]) / np.bincount(piece)
    result = np.zeros_like(doubtful)
    result[doubtful] = share[piece] > 0.5
    return result


@njit(cache=True)
def _ceilings(first, bottom):
    ceiling = np.full(len(bottom), SKY, np.int32)
    for column in range(len(first) - 1):
        for i in range(first[column], first[column + 1] - 1):
            ceiling[i] = bottom[i + 1]
    return ceiling


@njit(cache=True)
def _ground(first, facing, roomy, sheet):
    """The lowest level top of each column that has room above; none that may be a ceiling over what faces upwards."""
    result = np.zeros(len(roomy), np.bool_)
    for column in range(len(first) - 1):
        covers = False
        for i in range(first[column], first[column + 1]):
            if facing[i] and roomy[i]:
                result[i] = facing[i] & UPWARDS or (sheet[i] and not covers)
                break
            covers |= facing[i] & UPWARDS > 0
    return result


@njit(cache=True)
def _step_onto_low_obstacles(first, top, walkable, climb):
    """A top that is not walkable becomes so when the next one below is, not lower than a step."""
    result = walkable.copy()
    for column in range(len(first) - 1):
        for i in range(first[column] + 1, first[column + 1]):
            if walkable[i - 1] and top[i] - top[i - 1] <= climb:
                result[i] = True
    return result


@njit(cache=True)
def _column_beside(column, direction, shape):
    """The neighbouring column's index, or -1 beyond the border."""
    rows, columns = shape
    z, x = column // columns + STEP_Z[direction], column % columns + STEP_X[direction]
    return z * columns + x if 0 <= z < rows and 0 <= x < columns else -1


@njit(cache=True)
def _drop_beside(first, bottom, top, ceiling, i, beside, height, climb):
    """Lowest and highest floor of a neighbouring column that an agent fits through to, relative to span i.

    Only floors within the climb count for the highest; a fall into the void counts as one voxel more than the climb.
    A passage of exactly the agent's height does not count here, though one may stand in it (Recast 1.6.0, which is
    the version in Habitat-Sim).
    """
    start, end = first[beside], first[beside + 1]
    above = bottom[start] if end > start else SKY
    if min(ceiling[i], above) - top[i] > height:
        return -climb - 1, 0
    lowest = highest = 0
    for k in range(start, end):
        if min(ceiling[i], ceiling[k]) - max(top[i], top[k]) > height:
            step = top[k] - top[i]
            lowest = min(lowest, step)
            if step <= climb:
                highest = max(highest, step)
    return lowest, highest


@njit(cache=True)
def _is_ledge(first, bottom, top, ceiling, shape, column, i, height, climb):
    """Whether a span is beside a drop of more than the climb, or on a slope whose neighbours differ by more."""
    lowest = highest = 0
    for direction in range(4):
        beside = _column_beside(column, direction, shape)
        if beside < 0:
            return True
        down, up = _drop_beside(first, bottom, top, ceiling, i, beside, height, climb)
        lowest, highest = min(lowest, down), max(highest, up)
    return lowest < -climb or highest - lowest > climb


@njit(cache=True)
def _ledges(first, bottom, top, ceiling, walkable, shape, height, climb):
    ledge = np.zeros(len(top), np.bool_)
    for column in range(len(first) - 1):
        for i in range(first[column], first[column + 1]):
            if walkable[i]:
                ledge[i] = _is_ledge(first, bottom, top, ceiling, shape, column, i, height, climb)
    return ledge


@njit(cache=True)
def _neighbours(first, floor, ceiling, shape, height, climb):
    neighbour = np.full((len(floor), 4), -1, np.int64)
    for column in range(len(first) - 1):
        for i in range(first[column], first[column + 1]):
            for direction in range(4):
                beside = _column_beside(column, direction, shape)
                if beside < 0:
                    continue
                for k in range(first[beside], first[beside + 1]):
                    gap = min(ceiling[i], ceiling[k]) - max(floor[i], floor[k])
                    if gap >= height and abs(floor[k] - floor[i]) <= climb:
                        neighbour[i, direction] = k
                        break
    return neighbour
