"""The baseline that goes to the nearest frontier of the observed floor (Yamauchi 1997)."""

import heapq
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from avp_habitat.compiled import njit
from avp_habitat.policies.planning import PlanningPolicy
from avp_habitat.policies.predicted_views import (
    FREE,
    OBSERVED,
    UNKNOWN,
    KnownMap,
    Memory,
    in_view,
    make_lens,
    should_look_down,
)
from avp_habitat.poses import wrap_angle
from avp_habitat.task.agent_view import AgentView
from avp_habitat.task.settings import LOOK_DOWN, MOVE_FORWARD, TURN_LEFT, TURN_RIGHT

LEAST_CELLS = 3
"""Smaller frontiers are ignored."""
TRIES = 8
"""After this many views that should have observed a navigable cell, planners take it for hidden."""

LOYALTY_MOVES = 3.0
"""Another frontier must be this many moves nearer than the one approached before."""
SAME_M = 0.5
"""A frontier this close to the one approached before is what is left of it, metres."""
LOOK_M = 1.0
"""The agent does not turn to look at frontiers nearer than this: it sees them from elsewhere, metres."""

Float = NDArray[np.float64]

_EIGHT = np.ones((3, 3), dtype=np.bool_)


@dataclass(frozen=True)
class Frontier:
    """A connected group of observed cells that have an unobserved navigable neighbour."""

    cells: NDArray[np.int64]
    """`(k, 2)` rows and columns of the known map."""
    edge: NDArray[np.int64]
    """`(j, 2)` the unobserved neighbours."""


def find_frontiers(known: KnownMap, misses: NDArray[np.uint8]) -> list[Frontier]:
    """The frontiers of a map, in the order of their first cells; `misses` as `Memory.update` gives it."""
    from scipy.ndimage import binary_dilation, label

    unobserved = (known.state == FREE) & (misses < TRIES)
    beside = binary_dilation(unobserved, _EIGHT) & (known.state == OBSERVED)
    groups, _ = label(beside, _EIGHT)  # type: ignore[misc]
    found = []
    for number in range(1, int(groups.max(initial=0)) + 1):
        group = groups == number
        if np.count_nonzero(group) >= LEAST_CELLS:
            edge = unobserved & binary_dilation(group, _EIGHT)
            found.append(Frontier(np.argwhere(group), np.argwhere(edge)))
    return found


def route_to(before: NDArray[np.int64], goal: NDArray[np.int64]) -> NDArray[np.int64]:
    """`(k, 2)` cells from the start, which is left out, to a reachable goal `(2,)`."""
    columns = before.shape[1]
    at = int(goal[0]) * columns + int(goal[1])
    cells = []
    while before.flat[at] >= 0:
        cells.append(divmod(at, columns))
        at = int(before.flat[at])
    return np.array(cells[::-1], dtype=np.int64).reshape(-1, 2)


def farthest_straight(navigable: NDArray[np.bool_], at: Float, route: NDArray[np.int64]) -> Float:
    """`(2,)` centre of the last cell of a route `(k, 2)`, k > 0, to which a straight walk stays in navigable cells."""
    for cell in route[::-1]:
        if walkable(navigable, at[0], at[1], cell[0] + 0.5, cell[1] + 0.5):
            return cell + 0.5
    return route[0] + 0.5


@njit(cache=True)
def walkable(cells, row, column, to_row, to_column):
    """Whether a straight walk between two points of the grid stays in the true cells `(rows, columns)`.

    The cell in which it begins is not asked; the walk is sampled twice per cell of the longer axis.
    """
    steps = int(np.ceil(2.0 * max(abs(to_row - row), abs(to_column - column))))
    for i in range(1, steps + 1):
        r, c = int(row + (to_row - row) * i / steps), int(column + (to_column - column) * i / steps)
        if (r != int(row) or c != int(column)) and not cells[r, c]:
            return False
    return True


@njit(cache=True)
def shortest_walks(navigable, start_row, start_column):
    """Dijkstra over 8-connected cells `(rows, columns)`, without cutting corners; the start need not be navigable.

    Returns:
        `(rows, columns)` lengths in cells, inf where unreachable, and the flat index of the cell before, -1 for none.
    """
    rows, columns = navigable.shape
    length = np.full((rows, columns), np.inf)
    before = np.full((rows, columns), -1, np.int64)
    length[start_row, start_column] = 0.0
    queue = [(0.0, start_row * columns + start_column)]
    while queue:
        so_far, at = heapq.heappop(queue)
        row, column = at // columns, at % columns
        if so_far > length[row, column]:
            continue
        for dr in range(-1, 2):
            for dc in range(-1, 2):
                r, c = row + dr, column + dc
                if r < 0 or c < 0 or r >= rows or c >= columns or not navigable[r, c]:
                    continue
                if dr != 0 and dc != 0 and not (navigable[row, c] and navigable[r, column]):
                    continue
                total = so_far + np.sqrt(float(dr * dr + dc * dc))
                if total < length[r, c] - 1e-9:
                    length[r, c] = total
                    before[r, c] = at
                    heapq.heappush(queue, (total, r * columns + c))
    return length, before


@dataclass(frozen=True)
class _Way:
    """How to bring one frontier into view."""

    moves: float  # an estimate of their number
    action: int  # the first one
    goal: NDArray[np.int64]  # (2,) the frontier's nearest cell, in the scene's grid


class _Here:
    """What can be seen and walked to from where the agent is; lengths in cells."""

    def __init__(self, view: AgentView, known: KnownMap) -> None:
        self._known, self._yaw, self._pitch = known, view.yaw, view.pitch
        self._at = known.at(view.position)
        self._turn = np.radians(view.settings.turn_deg)
        self._forward = view.settings.forward_m / known.cell_m
        self._lens = make_lens(view.settings, known.cell_m)
        self._half_view = np.radians(view.settings.hfov_deg) / 2
        self._navigable = known.navigable
        self._length, self._before = shortest_walks(self._navigable, *map(int, self._at))

    def way_to(self, frontier: Frontier) -> _Way | None:
        lengths = self._length[tuple(frontier.cells.T)]
        nearest = frontier.cells[lengths.argmin()]
        if not np.isfinite(lengths.min()):
            return None
        goal = nearest + self._known.first
        route = route_to(self._before, nearest)
        aim = farthest_straight(self._navigable, self._at, route) if len(route) else frontier.edge.mean(axis=0) + 0.5
        moves = float(lengths.min()) / self._forward + abs(self._angle(aim)) / self._turn
        look = self._look(frontier.edge)
        if look is not None:
            beyond_view = max(abs(self._angle(look)) - self._half_view, 0.0)
            moves = min(moves, 1.0 + beyond_view / self._turn)
            if self._turn_to(look) != MOVE_FORWARD:
                return _Way(moves, self._turn_to(look), goal)
        action = self._turn_to(aim)
        return None if action == MOVE_FORWARD and self._leaves_known_floor() else _Way(moves, action, goal)

    def _look(self, edge: NDArray[np.int64]) -> Float | None:
        """Centre `(2,)` of the nearest cell that is out of view now and would be in view after turning to it."""
        state, lens, (row, column) = self._known.state, self._lens, self._at
        edge = edge[np.hypot(*(edge + 0.5 - self._at).T) * self._known.cell_m >= LOOK_M]
        hidden = edge[~in_view(state, edge, row, column, self._yaw, self._pitch, lens)]
        for cell in hidden[np.argsort(np.hypot(*(hidden + 0.5 - self._at).T), kind="stable")]:
            yaw = self._yaw + self._angle(cell + 0.5)
            if in_view(state, cell[None], row, column, yaw, self._pitch, lens)[0]:
                return cell + 0.5
        return None

    def _angle(self, point: Float) -> float:
        """Radians by which to turn, left positive, to face a point `(2,)`, row and column."""
        row, column = point - self._at
        return float(wrap_angle(np.arctan2(-column, -row) - self._yaw))

    def _turn_to(self, point: Float) -> int:
        """A turn to the nearer side, or forward where no turn brings the heading closer to a point `(2,)`."""
        angle = self._angle(point)
        if abs(angle) <= self._turn / 2 + 1e-9:
            return MOVE_FORWARD
        return TURN_LEFT if angle > 0 else TURN_RIGHT

    def _leaves_known_floor(self) -> bool:
        """Whether a forward move would enter cells of which nothing is known; at blocked ones it slides along."""
        row, column = self._at - self._forward * np.array([np.cos(self._yaw), np.sin(self._yaw)])
        return not walkable(self._known.state != UNKNOWN, self._at[0], self._at[1], row, column)


class FrontierPlanner:
    """Looks down at the floor, then brings one frontier after the other into view.

    A frontier counts as reached once it has been observed, be it from afar. The nearest one is that which takes the
    fewest moves, turns included, along the shortest walk over known floor. Without any, the agent turns in place.
    """

    def __init__(self) -> None:
        """Know nothing, prefer no frontier yet."""
        self._memory = Memory()
        self._goal: NDArray[np.int64] | None = None

    def act(self, view: AgentView) -> int:
        """The next action."""
        known, misses = self._memory.update(view)
        return LOOK_DOWN if should_look_down(view) else self.explore(view, known, misses)

    def explore(self, view: AgentView, known: KnownMap, misses: NDArray[np.uint8]) -> int:
        """The first move towards the frontier that takes the fewest; `misses` as `Memory.update` gives it."""
        here = _Here(view, known)
        ways = [way for frontier in find_frontiers(known, misses) if (way := here.way_to(frontier)) is not None]
        if not ways:
            self._goal = None
            return TURN_LEFT
        way = min(ways, key=lambda way: way.moves - LOYALTY_MOVES * self._is_same(way, known.cell_m))
        self._goal = way.goal
        return way.action

    def _is_same(self, way: _Way, cell_m: float) -> bool:
        return self._goal is not None and float(np.hypot(*(way.goal - self._goal))) * cell_m < SAME_M


class FrontierPolicy(PlanningPolicy):
    """`frontier`: the nearest reachable frontier."""

    def make_planner(self, rng: np.random.Generator) -> FrontierPlanner:
        """For one episode; nothing is drawn at random."""
        return FrontierPlanner()
