"""The baseline that takes the next best views within a few moves, on what is known so far."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from avp_habitat.compiled import njit
from avp_habitat.policies.frontier import TRIES, FrontierPlanner, walkable
from avp_habitat.policies.planning import PlanningPolicy
from avp_habitat.policies.predicted_views import (
    FREE,
    OBSERVED,
    UNKNOWN,
    KnownMap,
    Lens,
    clear_line,
    in_frame,
    make_lens,
)
from avp_habitat.sight.bits import ONE, size
from avp_habitat.task.agent_view import AgentView
from avp_habitat.task.settings import MOVE_FORWARD, TURN_LEFT, TURN_RIGHT

HORIZON = 12
"""Moves that the search looks ahead."""
COMMITTED = 3
"""Moves that are made before the next search."""
DISCOUNT = 0.95
"""What a cell counts less for every move by which it is observed later."""
BEYOND_M = 0.5
"""Unknown floor within this distance of known floor is expected to be navigable, metres."""
UNKNOWN_TRIES = 3
"""After this many views that should have observed an unknown cell, it is taken for not navigable."""

_MOST_PLACES = 600
_MERGED = 2
"""Places in the same square of this many cells a side are one."""


class Start(NamedTuple):
    """Where a search begins; lengths in cells, angles in radians."""

    row: float
    column: float
    """Of the agent; a cell's centre lies at +0.5."""
    yaw: float
    pitch: float
    """Left and up are positive; the pitch stays as it is."""
    turn: float
    forward: float
    """What one move makes."""


class _Scene(NamedTuple):
    state: NDArray[np.uint8]
    navigable: NDArray[np.bool_]
    cells: NDArray[np.int64]
    start: Start
    lens: Lens
    horizon: int


class _Tree(NamedTuple):
    """A node is a place and a heading: `place * (2 horizon + 1) + heading`; heading `horizon` is the start's own."""

    places: NDArray[np.float64]  # (places, 2) rows and columns
    place_at: NDArray[np.int64]  # (rows, columns) of merged squares: the place there, -1 for none
    used: NDArray[np.int64]  # (1,) number of places
    views: NDArray[np.uint64]  # (places, headings, words) bits of the cells that a view from there should observe
    depth: NDArray[np.int64]  # (nodes,) fewest moves that lead there, -1 for none
    gain: NDArray[np.float64]  # (nodes,) of the way there
    before: NDArray[np.int64]  # (nodes,) on the way there
    move: NDArray[np.int64]  # (nodes,) from the node before
    seen: NDArray[np.uint64]  # (nodes, words) bits of the cells that the views on the way should observe


def search(
    state: NDArray[np.uint8], cells: NDArray[np.int64], start: Start, lens: Lens, *, horizon: int, discount: float
) -> tuple[list[int], float]:
    """The moves (forward and turns) whose views should newly observe most of the `(k, 2)` cells that count.

    The search walks through known navigable cells only. Of the ways that lead to the same place and heading with the
    fewest moves it keeps the one that gains most, so that its effort grows with the reachable poses, not with the
    sequences of moves.

    Returns:
        The moves, `horizon` at most and none when nothing is gained, and their gain: newly observed cells times
        `discount ** (moves before the view)`.
    """
    if not len(cells) or horizon < 1:
        return [], 0.0
    navigable = (state == FREE) | (state == OBSERVED)
    moves, gain = _search(_Scene(state, navigable, cells, start, lens, horizon), discount)
    return moves.tolist(), float(gain)


@njit(cache=True)
def _write_views(scene, row, column, views):
    """Set, for each heading at a place, the bits of the cells in view in `views` `(headings, words)`."""
    start, lens = scene.start, scene.lens
    yaws = start.yaw + (np.arange(len(views)) - scene.horizon) * start.turn
    forward_rows, forward_columns = -np.cos(yaws), -np.sin(yaws)
    cos_pitch, sin_pitch = np.cos(start.pitch), np.sin(start.pitch)
    for i in range(len(scene.cells)):
        to_row, to_column = scene.cells[i, 0] + 0.5, scene.cells[i, 1] + 0.5
        if not clear_line(scene.state, row, column, to_row, to_column):
            continue
        bit = ONE << np.uint64(i % 64)
        r, c = to_row - row, to_column - column
        for j in range(len(yaws)):
            if in_frame(lens, r, c, forward_rows[j], forward_columns[j], cos_pitch, sin_pitch):
                views[j, i // 64] |= bit


@njit(cache=True)
def _empty_tree(scene):
    headings, words = 2 * scene.horizon + 1, (len(scene.cells) + 63) // 64
    nodes = _MOST_PLACES * headings
    rows, columns = scene.state.shape
    return _Tree(
        np.empty((_MOST_PLACES, 2)),
        np.full((rows // _MERGED + 1, columns // _MERGED + 1), -1, np.int64),
        np.zeros(1, np.int64),
        np.zeros((_MOST_PLACES, headings, words), np.uint64),
        np.full(nodes, -1, np.int64),
        np.zeros(nodes),
        np.full(nodes, -1, np.int64),
        np.zeros(nodes, np.int64),
        np.zeros((nodes, words), np.uint64),
    )


@njit(cache=True)
def _place(tree, scene, row, column):
    """The place at a point of the grid, made when it is new; -1 when there is no room for it."""
    r, c = int(row) // _MERGED, int(column) // _MERGED
    if tree.place_at[r, c] < 0 and tree.used[0] < _MOST_PLACES:
        place = tree.used[0]
        tree.used[0] += 1
        tree.place_at[r, c] = place
        tree.places[place, 0], tree.places[place, 1] = row, column
        _write_views(scene, row, column, tree.views[place])
    return tree.place_at[r, c]


@njit(cache=True)
def _ahead(tree, scene, node):
    """The node one forward move away, -1 when it is not known to be navigable."""
    headings = 2 * scene.horizon + 1
    heading = node % headings
    row, column = tree.places[node // headings]
    yaw = scene.start.yaw + (heading - scene.horizon) * scene.start.turn
    to_row, to_column = row - np.cos(yaw) * scene.start.forward, column - np.sin(yaw) * scene.start.forward
    if not walkable(scene.navigable, row, column, to_row, to_column):
        return -1
    place = _place(tree, scene, to_row, to_column)
    return -1 if place < 0 else place * headings + heading


@njit(cache=True)
def _offer(tree, node, to, move, factor):
    """Take a move as the way to a node when it is the first of its length or gains more; whether it is the first."""
    headings = tree.views.shape[1]
    sight = tree.views[to // headings, to % headings]
    new = 0
    for w in range(len(sight)):
        new += size(sight[w] & ~tree.seen[node, w])
    gain = tree.gain[node] + factor * new
    first = tree.depth[to] < 0
    if first or gain > tree.gain[to]:
        tree.depth[to] = tree.depth[node] + 1
        tree.gain[to], tree.before[to], tree.move[to] = gain, node, move
        for w in range(len(sight)):
            tree.seen[to, w] = tree.seen[node, w] | sight[w]
    return first


@njit(cache=True)
def _expand(tree, scene, level, factor):
    """The nodes that one move leads to from a level, those of earlier levels left out."""
    headings = 2 * scene.horizon + 1
    following = np.empty(3 * len(level), np.int64)
    found = 0
    for node in level:
        # Headings never leave their range: there are as many turns to either side as there are moves.
        for move, to in ((MOVE_FORWARD, _ahead(tree, scene, node)), (TURN_LEFT, node + 1), (TURN_RIGHT, node - 1)):
            if to < 0 or to // headings >= tree.used[0] or 0 <= tree.depth[to] <= tree.depth[node]:
                continue
            if _offer(tree, node, to, move, factor):
                following[found] = to
                found += 1
    return following[:found]


@njit(cache=True)
def _search(scene, discount):
    tree = _empty_tree(scene)
    _place(tree, scene, scene.start.row, scene.start.column)
    tree.depth[scene.horizon] = 0
    level = np.array([scene.horizon], np.int64)
    best, factor = scene.horizon, 1.0
    for _ in range(scene.horizon):
        level = _expand(tree, scene, level, factor)
        factor *= discount
        for node in level:
            if tree.gain[node] > tree.gain[best]:
                best = node
    return _way(tree, best), tree.gain[best]


@njit(cache=True)
def _way(tree, node):
    """The moves from the start to a node."""
    moves = np.empty(tree.depth[node], np.int64)
    for i in range(len(moves) - 1, -1, -1):
        moves[i] = tree.move[node]
        node = tree.before[node]
    return moves


def expected_cells(known: KnownMap, misses: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """`(rows, columns)` whether cells are probably navigable and not observed yet.

    These are free ones, and unknown ones a little beyond them that no known obstacle cuts off, less those that as many
    views as `misses` allows, `(rows, columns)`, should have observed.
    """
    from scipy.ndimage import binary_dilation

    free = (known.state == FREE) & (misses < TRIES)
    unknown = (known.state == UNKNOWN) & (misses < UNKNOWN_TRIES)
    beyond = round(BEYOND_M / known.cell_m)
    return np.asarray(binary_dilation(free, mask=free | unknown, iterations=beyond), dtype=np.bool_)


class GreedyPlanner(FrontierPlanner):
    """Looks down at the floor, then makes the moves whose views should observe most, or goes to a frontier."""

    def __init__(self) -> None:
        """Know nothing, plan nothing."""
        super().__init__()
        self._moves: list[int] = []

    def explore(self, view: AgentView, known: KnownMap, misses: NDArray[np.uint8]) -> int:
        """The next of the best moves; where none gains anything, that towards a frontier."""
        if view.collided or not self._moves:
            self._moves = self._best_moves(view, known, misses)
        return self._moves.pop(0) if self._moves else super().explore(view, known, misses)

    def _best_moves(self, view: AgentView, known: KnownMap, misses: NDArray[np.uint8]) -> list[int]:
        settings = view.settings
        turn, forward = np.radians(settings.turn_deg), settings.forward_m / known.cell_m
        row, column = known.at(view.position)
        start = Start(row, column, view.yaw, view.pitch, turn, forward)
        cells, lens = np.argwhere(expected_cells(known, misses)), make_lens(settings, known.cell_m)
        horizon = min(HORIZON, settings.budget - view.steps)
        moves, _ = search(known.state, cells, start, lens, horizon=horizon, discount=DISCOUNT)
        return moves[:COMMITTED]


class GreedyPolicy(PlanningPolicy):
    """`greedy`: the next best views."""

    def make_planner(self, rng: np.random.Generator) -> GreedyPlanner:
        """For one episode; nothing is drawn at random."""
        return GreedyPlanner()
