"""The compiled loops of the oracle over bit sets of floor cells."""

import numpy as np

from avp_habitat.compiled import njit
from avp_habitat.sight.bits import ONE, lowest
from avp_habitat.sight.rules import in_camera, in_image

_STRAIGHT, _DIAGONAL = 5, 7
"""Lengths of a step to a neighbour of a grid, in fifths of the grid's spacing (7 / 5 is the root of 2 within 1 %)."""
LENGTHS_PER_SPACING = 5
NEVER = 255
"""In `reach_tables`: no walk leads to a place that sees the cell."""
_FAR = 1 << 30


@njit(cache=True)
def neighbour_table(grid, count):
    """Up to 8 neighbours of the places of a grid of numbers (-1: no place); a diagonal needs both places beside it.

    Returns:
        `(count, 8)` their numbers, then -1, and `(count, 8)` the lengths of the ways to them.
    """
    rows, columns = grid.shape
    other, length = np.full((count, 8), -1, np.int64), np.zeros((count, 8), np.int64)
    for row in range(rows):
        for column in range(columns):
            place, found = grid[row, column], 0
            for down in range(-1, 2):
                for right in range(-1, 2):
                    r, c = row + down, column + right
                    if place < 0 or (down == 0 and right == 0) or r < 0 or c < 0 or r >= rows or c >= columns:
                        continue
                    diagonal = down != 0 and right != 0
                    if grid[r, c] < 0 or (diagonal and (grid[row, c] < 0 or grid[r, column] < 0)):
                        continue
                    other[place, found] = grid[r, c]
                    length[place, found] = _DIAGONAL if diagonal else _STRAIGHT
                    found += 1
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

    Arrays are those of `ScenePlaces`: `other` its neighbours, `length` `(p, 8)` how far they are, each unit of it
    `steps_per_length` forward moves. The direction is that of the place `ahead` places on; cells nearer than `near_m`
    on the floor need a look down, so that places farther off are preferred.

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
        seen = (sees[i, cell // 64] >> np.uint64(cell % 64)) & ONE
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
def look(parent, place, pose, camera, sees, points, seen):
    """`(n, words)` cells that n candidate views add to what was seen, and `(n,)` how many they are.

    Candidate i stands at place `place[i]`, continues row `parent[i]` of `seen` `(k, words)` and looks from `pose[i]`,
    `(4, 4)` camera_to_world, habitat axes, with `rules.camera_numbers`; `sees` and `points` are those of `ScenePlaces`.
    """
    fresh, gain = np.zeros((len(parent), sees.shape[1]), np.uint64), np.zeros(len(parent), np.int64)
    for i in range(len(parent)):
        for k in range(sees.shape[1]):
            left = sees[place[i], k] & ~seen[parent[i], k]
            while left:
                bit = lowest(left)
                left &= left - ONE
                if in_image(*in_camera(pose[i], points[64 * k + bit]), camera):
                    fresh[i, k] |= ONE << np.uint64(bit)
                    gain[i] += 1
    return fresh, gain


@njit(cache=True)
def outlook(place, yaw, unseen, reach, heading, near_turn, far_turn, left, pace):
    """`(n,)` what the cells not yet seen can still bring: for each, the views left once it could be in sight.

    Candidate i, after whose view `left` are left, stands at place `place[i]`, looks to `yaw[i]` (uint8, 256ths of a
    turn), and lacks the cells in row i of `unseen` `(n, words)`. `reach` and `heading` are those of `reach_tables`;
    `near_turn` and `far_turn` `(256,)` are the steps of turning until a cell at that difference of heading is in the
    image, and until the agent faces it; `pace` is `search.PACE`.
    """
    result = np.zeros(len(place), np.float64)
    for i in range(len(place)):
        at = place[i]
        for k in range(unseen.shape[1]):
            word = unseen[i, k]
            while word:
                cell = 64 * k + lowest(word)
                word &= word - ONE
                half = reach[at, cell]
                if half != NEVER:
                    turn = (int(heading[at, cell]) - int(yaw[i])) & 255
                    steps = 1.0 + 0.5 * half + (near_turn[turn] if half == 0 else far_turn[turn])
                    result[i] += max(left - pace * steps, 0.0)
    return result


@njit(cache=True)
def choose(order, key, seen, width, per_key):
    """Rows of the best candidates: at most `per_key` of one key, never two of one key that have seen the same.

    `order` has the rows, the best first; `key` `(n,)` says where a candidate stands and looks, `seen` `(n, words)` what
    it has seen; `width` is the largest number to keep.
    """
    kept, count = np.empty(width, np.int64), 0
    used, states = {np.int64(0): 0}, {np.uint64(0)}
    for i in order:
        if used.get(key[i], 0) >= per_key:
            continue
        digest = np.uint64(key[i])
        for word in seen[i]:
            digest = (digest ^ word) * np.uint64(0x9E3779B97F4A7C15)
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
