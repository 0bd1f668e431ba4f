"""The baseline that takes the next best views within a few moves, on what is known so far."""

import numpy as np
from numpy.typing import NDArray

from avp_habitat.agent_view import AgentView
from avp_habitat.baselines.approach import Approach
from avp_habitat.baselines.frontiers import TRIES, find_frontiers
from avp_habitat.baselines.known_map import FREE, UNKNOWN, KnownMap
from avp_habitat.baselines.memory import Memory
from avp_habitat.baselines.move_search import Start, search
from avp_habitat.baselines.planning import PlanningPolicy
from avp_habitat.baselines.sight import make_lens, should_look_down
from avp_habitat.settings import LOOK_DOWN, TURN_LEFT

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


def expected_cells(known: KnownMap, misses: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Cells that are probably navigable and not observed yet: free ones, and unknown ones a little beyond them.

    Args:
        known: the map.
        misses: `(rows, columns)` views that should have observed a cell which is still not observed.

    Returns:
        `(rows, columns)`; unknown cells that known obstacles cut off do not count.
    """
    from scipy.ndimage import binary_dilation

    free = (known.state == FREE) & (misses < TRIES)
    unknown = (known.state == UNKNOWN) & (misses < UNKNOWN_TRIES)
    if not free.any():
        return free
    return np.asarray(
        binary_dilation(free, mask=free | unknown, iterations=round(BEYOND_M / known.cell_m)), dtype=np.bool_
    )


class GreedyPlanner:
    """Looks down at the floor, then makes the moves whose views should observe most."""

    def __init__(self) -> None:
        """Know nothing, plan nothing."""
        self._memory = Memory()
        self._approach = Approach()
        self._moves: list[int] = []

    def act(self, view: AgentView) -> int:
        """The next action."""
        known, misses = self._memory.update(view)
        if should_look_down(view):
            return LOOK_DOWN
        if view.collided or not self._moves:
            self._moves = self._best_moves(view, known, misses)
        if self._moves:
            return self._moves.pop(0)
        action = self._approach.next_action(view, known, find_frontiers(known, misses))
        return TURN_LEFT if action is None else action

    def _best_moves(self, view: AgentView, known: KnownMap, misses: NDArray[np.uint8]) -> list[int]:
        settings = view.settings
        row, column = known.at(view.position)
        turn, forward = np.radians(settings.turn_deg), settings.forward_m / known.cell_m
        moves, _ = search(
            known.state,
            np.argwhere(expected_cells(known, misses)),
            Start(row, column, view.yaw, view.pitch, turn, forward),
            make_lens(settings, known.cell_m),
            horizon=min(HORIZON, settings.budget - view.steps),
            discount=DISCOUNT,
        )
        return moves[:COMMITTED]


class GreedyPolicy(PlanningPolicy):
    """`greedy`: the next best views."""

    def make_planner(self, rng: np.random.Generator) -> GreedyPlanner:
        """For one episode; nothing is drawn at random."""
        return GreedyPlanner()
