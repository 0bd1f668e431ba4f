"""The baseline that goes to the nearest frontier of the observed floor (Yamauchi 1997)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from avp_habitat.policies.known_map import (
    FREE,
    OBSERVED,
    UNKNOWN,
    KnownMap,
    farthest_straight,
    route_to,
    shortest_walks,
    walkable,
)
from avp_habitat.policies.planning import PlanningPolicy
from avp_habitat.policies.predicted_views import Memory, in_view, make_lens, should_look_down
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


@dataclass(frozen=True)
class _Way:
    """How to bring one frontier into view."""

    moves: float
    """Estimated number of moves."""
    action: int
    """The first one."""
    goal: NDArray[np.int64]
    """`(2,)` the frontier's nearest cell, in the scene's grid."""


class Approach:
    """Follows the shortest walk over known floor to a frontier, or turns to it where that shows it."""

    def __init__(self) -> None:
        """Prefer no frontier yet."""
        self._goal: NDArray[np.int64] | None = None

    def next_action(self, view: AgentView, known: KnownMap, frontiers: list[Frontier]) -> int | None:
        """The first move towards the frontier that takes the fewest moves; None when none can be reached."""
        here = _Here(view, known)
        ways = [way for frontier in frontiers if (way := here.way_to(frontier)) is not None]
        if not ways:
            self._goal = None
            return None
        way = min(ways, key=lambda way: way.moves - LOYALTY_MOVES * self._is_same(way, known.cell_m))
        self._goal = way.goal
        return way.action

    def _is_same(self, way: _Way, cell_m: float) -> bool:
        return self._goal is not None and float(np.hypot(*(way.goal - self._goal))) * cell_m < SAME_M


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
        aim, moves = self._walk(frontier, nearest, float(lengths.min()))
        look = self._look(frontier.edge)
        if look is not None:
            beyond_view = max(abs(self._angle(look)) - self._half_view, 0.0)
            moves = min(moves, 1.0 + beyond_view / self._turn)
            if self._turn_to(look) != MOVE_FORWARD:
                return _Way(moves, self._turn_to(look), goal)
        action = self._turn_to(aim)
        return None if action == MOVE_FORWARD and self._leaves_known_floor() else _Way(moves, action, goal)

    def _walk(self, frontier: Frontier, nearest: NDArray[np.int64], length: float) -> tuple[Float, float]:
        """Point `(2,)` to walk to first, and the number of moves of the whole walk."""
        route = route_to(self._before, nearest)
        aim = farthest_straight(self._navigable, self._at, route) if len(route) else frontier.edge.mean(axis=0) + 0.5
        return aim, length / self._forward + abs(self._angle(aim)) / self._turn

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
        """Know nothing."""
        self._memory = Memory()
        self._approach = Approach()

    def act(self, view: AgentView) -> int:
        """The next action."""
        known, misses = self._memory.update(view)
        if should_look_down(view):
            return LOOK_DOWN
        action = self._approach.next_action(view, known, find_frontiers(known, misses))
        return TURN_LEFT if action is None else action


class FrontierPolicy(PlanningPolicy):
    """`frontier`: the nearest reachable frontier."""

    def make_planner(self, rng: np.random.Generator) -> FrontierPlanner:
        """For one episode; nothing is drawn at random."""
        return FrontierPlanner()
