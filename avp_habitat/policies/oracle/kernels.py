"""The compiled loops of the oracle over bit sets of floor cells (64 cells to a word)."""

import numpy as np

from avp_habitat.compiled import njit

_ONE = np.uint64(1)
_STRAIGHT, _DIAGONAL = 5, 7
"""Lengths of a step to a neighbour of a grid, in fifths of the grid's spacing (7 / 5 is the root of 2 within 1 %)."""
LENGTHS_PER_SPACING = 5
NEVER = 255
"""In `reach_tables`: no walk on the lattice leads to a place that sees the cell."""
_FAR = 1 << 30


@njit(cache=True)
def _trailing(word):
    """Index of the lowest set bit of a word that is not 0."""
    low = word & (~word + _ONE)
    index = 0
    for shift in (32, 16, 8, 4, 2, 1):
        if low >> np.uint64(shift):
            low >>= np.uint64(shift)
            index += shift
    return index


@njit(cache=True)
def _count(word):
    """Number of set bits."""
    word = word - ((word >> _ONE) & np.uint64(0x5555555555555555))
    word = (word & np.uint64(0x3333333333333333)) + ((word >> np.uint64(2)) & np.uint64(0x3333333333333333))
    word = (word + (word >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return int((word * np.uint64(0x0101010101010101)) >> np.uint64(56))


@njit(cache=True)
def count_rows(sets):
    """`(n,)` sizes of `(n, words)` sets."""
    sizes = np.zeros(len(sets), np.int64)
    for i in range(len(sets)):
        for word in sets[i]:
            sizes[i] += _count(word)
    return sizes


@njit(cache=True)
def gains(sets, missing):
    """`(n,)` how many members of `missing` `(words,)` each of `(n, words)` sets holds."""
    result = np.zeros(len(sets), np.int64)
    for i in range(len(sets)):
        for k in range(len(missing)):
            result[i] += _count(sets[i, k] & missing[k])
    return result


@njit(cache=True)
def inside_frustum(cells, camera, normals, points):
    """Members of `cells` `(words,)` that lie inside a view.

    `camera` `(3,)` is its centre, `normals` `(4, 3)` point inwards from the image's left, top, right and bottom
    (the last two borders do not belong to the image), `points` `(m, 3)` are the cells' floor points.
    """
    result = np.zeros_like(cells)
    for k in range(len(cells)):
        left = cells[k]
        while left:
            bit = _trailing(left)
            left &= left - _ONE
            c = 64 * k + bit
            x, y, z = points[c, 0] - camera[0], points[c, 1] - camera[1], points[c, 2] - camera[2]
            if (
                normals[0, 0] * x + normals[0, 1] * y + normals[0, 2] * z >= 0
                and normals[1, 0] * x + normals[1, 1] * y + normals[1, 2] * z >= 0
                and normals[2, 0] * x + normals[2, 1] * y + normals[2, 2] * z > 0
                and normals[3, 0] * x + normals[3, 1] * y + normals[3, 2] * z > 0
            ):
                result[k] |= _ONE << np.uint64(bit)
    return result


@njit(cache=True)
def _neighbours(grid, at):
    """Grid indices and lengths of up to 8 neighbours; a diagonal needs both cells beside it."""
    found, lengths, count = np.empty(8, np.int64), np.empty(8, np.int64), 0
    rows, columns = grid.shape
    row, column = at // columns, at % columns
    for down in range(-1, 2):
        for right in range(-1, 2):
            r, c = row + down, column + right
            if (down == 0 and right == 0) or r < 0 or c < 0 or r >= rows or c >= columns or grid[r, c] < 0:
                continue
            if down != 0 and right != 0 and (grid[row, c] < 0 or grid[r, column] < 0):
                continue
            found[count] = r * columns + c
            lengths[count] = _DIAGONAL if down != 0 and right != 0 else _STRAIGHT
            count += 1
    return found[:count], lengths[:count]


@njit(cache=True)
def neighbour_table(grid, count):
    """`(count, 8)` numbers and lengths of the neighbours of the places of a grid of numbers (-1: no place)."""
    columns = grid.shape[1]
    other, length = np.full((count, 8), -1, np.int64), np.zeros((count, 8), np.int64)
    for row in range(grid.shape[0]):
        for column in range(columns):
            if grid[row, column] >= 0:
                found, lengths = _neighbours(grid, row * columns + column)
                for j in range(len(found)):
                    other[grid[row, column], j] = grid[found[j] // columns, found[j] % columns]
                    length[grid[row, column], j] = lengths[j]
    return other, length


@njit(cache=True)
def _flood(sources, other, length, distance, towards, buckets, fill):
    """Shortest walks from every place to the nearest source, by Dial's buckets; `towards` is the next place."""
    distance[:] = _FAR
    towards[:] = -1
    fill[:] = 0
    for place in sources:
        distance[place] = 0
        buckets[0, fill[0]] = place
        fill[0] += 1
    level, waiting = 0, len(sources)
    while waiting > 0:
        at = level % len(fill)
        for i in range(fill[at]):
            place = buckets[at, i]
            if distance[place] == level:
                for j in range(8):
                    to = other[place, j]
                    if to < 0:
                        break
                    if level + length[place, j] < distance[to]:
                        distance[to] = level + length[place, j]
                        towards[to] = place
                        into = distance[to] % len(fill)
                        buckets[into, fill[into]] = to
                        fill[into] += 1
                        waiting += 1
        waiting -= fill[at]
        fill[at] = 0
        level += 1


@njit(cache=True)
def reach_tables(sees, points, places, other, length, steps_per_length, ahead, near_m):
    """How far every place is from seeing every cell, and in which direction to set out.

    Args:
        sees: `(p, words)` cells that are not hidden from each place.
        points: `(m, 3)` floor points of the cells, metres.
        places: `(p, 3)` metres.
        other: `(p, 8)` neighbours.
        length: `(p, 8)` lengths of the way to them.
        steps_per_length: forward moves per unit of `length`.
        ahead: the direction is that of the place so many places ahead on the way.
        near_m: cells nearer than this on the floor need a look down; places farther off are preferred.

    Returns:
        `(p, m)` uint8 half steps to the nearest place that sees the cell (`NEVER` when there is none), and `(p, m)`
        uint8 heading in 256ths of a turn, of the walk, or of the cell where it is seen.
    """
    p, m = len(places), len(points)
    reach, heading = np.full((p, m), NEVER, np.uint8), np.zeros((p, m), np.uint8)
    distance, towards, sources = np.empty(p, np.int64), np.empty(p, np.int64), np.empty(p, np.int64)
    buckets, fill = np.empty((_DIAGONAL + 1, 8 * p + 8), np.int64), np.zeros(_DIAGONAL + 1, np.int64)
    for c in range(m):
        count = _watchers(sees, points, places, c, near_m, sources)
        if count == 0:
            count = _watchers(sees, points, places, c, 0.0, sources)
        _flood(sources[:count], other, length, distance, towards, buckets, fill)
        for i in range(p):
            if distance[i] < _FAR:
                reach[i, c] = min(int(2 * distance[i] * steps_per_length + 0.5), NEVER - 1)
                goal = points[c] if distance[i] == 0 else places[_further(towards, i, ahead)]
                turn = np.arctan2(places[i, 0] - goal[0], places[i, 2] - goal[2]) / (2 * np.pi)
                heading[i, c] = int(np.floor(turn * 256 + 0.5)) & 255
    return reach, heading


@njit(cache=True)
def _watchers(sees, points, places, cell, least_m, found):
    """Collect the places that see a cell from at least so far on the floor; returns how many."""
    count = 0
    for i in range(len(places)):
        seen = (sees[i, cell // 64] >> np.uint64(cell % 64)) & _ONE
        if seen and np.hypot(points[cell, 0] - places[i, 0], points[cell, 2] - places[i, 2]) >= least_m:
            found[count] = i
            count += 1
    return count


@njit(cache=True)
def _further(towards, place, count):
    """The place so many places ahead on the way, or its end."""
    for _ in range(count):
        if towards[place] < 0:
            break
        place = towards[place]
    return place


@njit(cache=True)
def look(parent, place, camera, normals, sees, points, seen, fresh, gain):
    """What n candidate views add: `fresh` `(n, words)` and `gain` `(n,)` are filled.

    `parent` `(n,)` is the row of `seen` that each candidate continues, `place` `(n,)` its place of the lattice.
    """
    for i in range(len(parent)):
        missing = sees[place[i]] & ~seen[parent[i]]
        fresh[i] = inside_frustum(missing, camera[i], normals[i], points)
        total = 0
        for word in fresh[i]:
            total += _count(word)
        gain[i] = total


@njit(cache=True)
def outlook(parent, place, yaw, seen, fresh, wanted, reach, heading, near_turn, far_turn, left, pace):
    """`(n,)` what the cells not yet seen can still bring: for each, the views left once it could be in sight.

    Args:
        parent: `(n,)` row of `seen`.
        place: `(n,)` place of the lattice.
        yaw: `(n,)` uint8, 256ths of a turn.
        seen: `(k, words)` cells seen before.
        fresh: `(n, words)` cells seen by the candidate view.
        wanted: `(words,)` cells that can be seen at all.
        reach: `(p, m)` of `reach_tables`.
        heading: `(p, m)` of `reach_tables`.
        near_turn: `(256,)` steps of turning until a cell at this difference of heading is in the image.
        far_turn: `(256,)` steps of turning until the agent faces it.
        left: views left after the candidate's.
        pace: steps counted for each step of the shortest way, because one walk cannot serve all cells.
    """
    result = np.zeros(len(parent), np.float64)
    for i in range(len(parent)):
        at, total = place[i], 0.0
        for k in range(len(wanted)):
            word = wanted[k] & ~seen[parent[i], k] & ~fresh[i, k]
            while word:
                bit = _trailing(word)
                word &= word - _ONE
                half = reach[at, 64 * k + bit]
                if half == NEVER:
                    continue
                turn = (int(heading[at, 64 * k + bit]) - int(yaw[i])) & 255
                steps = 1.0 + 0.5 * half + (near_turn[turn] if half == 0 else far_turn[turn])
                value = left - pace * steps
                if value > 0:
                    total += value
        result[i] = total
    return result


@njit(cache=True)
def choose(order, key, parent, seen, fresh, width, per_key):
    """Rows of the best candidates: at most `per_key` of one key, never two of one key that have seen the same.

    Args:
        order: `(n,)` rows, the best first.
        key: `(n,)` where a candidate stands and looks.
        parent: `(n,)` row of `seen`.
        seen: `(k, words)` cells seen before.
        fresh: `(n, words)` cells seen by the candidate view.
        width: largest number to keep.
        per_key: largest number to keep of one key.
    """
    kept, count = np.empty(width, np.int64), 0
    used, states = {np.int64(0): 0}, {np.uint64(0)}
    for i in order:
        if used.get(key[i], 0) >= per_key:
            continue
        digest = np.uint64(key[i])
        for k in range(fresh.shape[1]):
            digest = (digest ^ (seen[parent[i], k] | fresh[i, k])) * np.uint64(0x9E3779B97F4A7C15)
            digest ^= digest >> np.uint64(29)
        if digest in states:
            continue
        states.add(digest)
        used[key[i]] = used.get(key[i], 0) + 1
        kept[count] = i
        count += 1
        if count == width:
            break
    return kept[:count]
