"""The connected part of the standing places that a scene's agents live on, kept off the walls by their radius."""

import numpy as np
from numpy.typing import NDArray

from avp_habitat.compiled import njit
from avp_habitat.navigation.filters import SKY, StandingPlaces

_FAR = 255


def connected_parts(places: StandingPlaces, radius: int, smallest: int) -> NDArray[np.int64]:
    """Erode the standing places by the agent's radius and number the connected parts that remain.

    Args:
        places: all standing places.
        radius: in voxels.
        smallest: fewest places of a part that is kept.

    Returns:
        `(n,)` part of each place, 0 … in the order of their first place; -1 where no agent's centre may stand.
    """
    keep = _border_distance(places.neighbour) >= 2 * radius
    part = _flood(places.neighbour, keep)
    sizes = np.bincount(part[part >= 0], minlength=1)
    number = np.where(sizes >= smallest, np.cumsum(sizes >= smallest) - 1, -1)
    return np.where(part >= 0, number[part], -1)


def main_part(places: StandingPlaces, part: NDArray[np.int64]) -> int:
    """The largest part that is not a roof: one under the open sky that lies mostly over another part."""
    count = int(part.max()) + 1
    sizes = np.bincount(part[part >= 0], minlength=count)
    for candidate in np.argsort(-sizes, kind="stable"):
        if not _is_roof(places, part, int(candidate), count):
            return int(candidate)
    return int(np.argmax(sizes))


def _is_roof(places: StandingPlaces, part: NDArray[np.int64], candidate: int, count: int) -> bool:
    own = part == candidate
    if np.mean(places.ceiling[own] == SKY) < 0.5:
        return False
    height = np.full(int(places.column.max()) + 1, -1, np.int32)
    height[places.column[own]] = places.floor[own]
    others = (part >= 0) & ~own
    beneath = others & (places.floor < height[places.column])
    sizes = np.bincount(part[others], minlength=count)
    return bool((np.bincount(part[beneath], minlength=count) > 0.5 * np.maximum(sizes, 1)).any())


def place_near(places: StandingPlaces, part: NDArray[np.int64], columns: int, voxel: tuple[float, float, float]) -> int:
    """Index of the place of any part nearest to a voxel (row, column, level); height counts like distance."""
    candidates = np.flatnonzero(part >= 0)
    row, column, level = voxel
    off = (places.column[candidates] // columns - row) ** 2 + (places.column[candidates] % columns - column) ** 2
    return int(candidates[np.argmin(off + (places.floor[candidates] - level) ** 2)])


def common_place(places: StandingPlaces, part: NDArray[np.int64], chosen: int) -> int:
    """Index of the first place of a part on its most common level."""
    own = np.flatnonzero(part == chosen)
    return int(own[places.floor[own] == np.bincount(places.floor[own]).argmax()][0])


def lay_flat(
    places: StandingPlaces, part: NDArray[np.int64], seed: int, shape: tuple[int, int]
) -> tuple[NDArray[np.bool_], NDArray[np.int32]]:
    """The part that holds place `seed`, as a picture; of storeys that lie over each other the nearest one is kept.

    Storeys are peeled apart breadth-first along steps from the seed, so that the picture is one sheet on which
    neighbouring columns are a step apart.

    Returns:
        `(rows, columns)` columns that the agent's centre may stand in; `(rows, columns)` first voxel above the floor,
        meaningless elsewhere.
    """
    return _sheet(places.column, places.floor, places.neighbour, part == part[seed], seed, shape)


@njit(cache=True)
def _border_distance(neighbour):
    """Chamfer distance (2 along, 3 across) of each place to the nearest place that lacks a neighbour, at most 255."""
    count = len(neighbour)
    distance = np.full(count, _FAR, np.int64)
    for i in range(count):
        for direction in range(4):
            if neighbour[i, direction] < 0:
                distance[i] = 0
    for i in range(count):
        for direction in (0, 3):
            _relax(distance, neighbour, i, direction, (direction + 3) % 4)
    for i in range(count - 1, -1, -1):
        for direction in (2, 1):
            _relax(distance, neighbour, i, direction, (direction + 3) % 4)
    return distance


@njit(cache=True)
def _relax(distance, neighbour, i, direction, turn):
    beside = neighbour[i, direction]
    if beside >= 0:
        distance[i] = min(distance[i], distance[beside] + 2)
        across = neighbour[beside, turn]
        if across >= 0:
            distance[i] = min(distance[i], distance[across] + 3)


@njit(cache=True)
def _flood(neighbour, keep):
    part = np.full(len(keep), -1, np.int64)
    stack = np.empty(len(keep), np.int64)
    parts = 0
    for start in range(len(keep)):
        if not keep[start] or part[start] >= 0:
            continue
        part[start], stack[0], waiting = parts, start, 1
        while waiting:
            waiting -= 1
            for beside in neighbour[stack[waiting]]:
                if beside >= 0 and keep[beside] and part[beside] < 0:
                    part[beside], stack[waiting] = parts, beside
                    waiting += 1
        parts += 1
    return part


@njit(cache=True)
def _sheet(column, floor, neighbour, own, seed, shape):
    """Breadth-first from a place; a column is taken once, and only beside columns that it has a step to."""
    rows, columns = shape
    place = np.full(rows * columns, -1, np.int64)
    queue = np.empty(len(own), np.int64)
    place[column[seed]], queue[0] = seed, seed
    begin, end = 0, 1
    while begin < end:
        i = queue[begin]
        begin += 1
        for beside in neighbour[i]:
            free = beside >= 0 and own[beside] and place[column[beside]] < 0
            if free and _fits(place, column, neighbour, beside, columns):
                place[column[beside]], queue[end] = beside, beside
                end += 1
    inside, height = np.zeros((rows, columns), np.bool_), np.zeros((rows, columns), np.int32)
    for k in range(end):
        i = queue[k]
        inside[column[i] // columns, column[i] % columns] = True
        height[column[i] // columns, column[i] % columns] = floor[i]
    return inside, height


@njit(cache=True)
def _fits(place, column, neighbour, i, columns):
    """Whether the neighbouring columns that are taken are taken by places that a step from place i leads to."""
    for direction, offset in enumerate((-1, columns, 1, -columns)):
        at = column[i] + offset
        if 0 <= at < len(place) and place[at] >= 0 and neighbour[i, direction] != place[at]:
            return False
    return True
