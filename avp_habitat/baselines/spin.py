"""The baseline that turns in place, walks on a little and turns again."""

import numpy as np

from avp_habitat.agent_view import AgentView
from avp_habitat.baselines.planning import PlanningPolicy
from avp_habitat.baselines.reactive import CLEARANCE_M
from avp_habitat.settings import MOVE_FORWARD, TURN_LEFT, TURN_RIGHT

WALK_M = 2.0
"""Length of a walk between two full circles, metres."""


class SpinPlanner:
    """A full circle, then forward by the heuristic's rule for `WALK_M`, and again; it reads no more than a depth."""

    def __init__(self, rng: np.random.Generator) -> None:
        """Begin with a full circle."""
        self._rng = rng
        self._turns = 0
        self._walked = 0
        self._aside: int | None = None

    def act(self, view: AgentView) -> int:
        """A turn to the left until the circle is full, then forward, or a turn to where there is room."""
        if self._turns < int(np.ceil(360.0 / view.settings.turn_deg)):
            self._turns += 1
            return TURN_LEFT
        if self._walked and view.collided:
            return self._begin_circle()
        if view.centre_depth <= CLEARANCE_M:
            return self._begin_circle() if self._walked else self._turn_aside(view)
        if self._walked * view.settings.forward_m >= WALK_M:
            return self._begin_circle()
        self._walked += 1
        return MOVE_FORWARD

    def _begin_circle(self) -> int:
        self._turns, self._walked, self._aside = 1, 0, None
        return TURN_LEFT

    def _turn_aside(self, view: AgentView) -> int:
        """Keep to the side drawn first: turns back and forth would find no room."""
        if self._aside is None:
            self._aside = TURN_LEFT if self._rng.random() < 0.5 else TURN_RIGHT
        return self._aside


class SpinPolicy(PlanningPolicy):
    """`spin`: turn in place, then walk."""

    def make_planner(self, rng: np.random.Generator) -> SpinPlanner:
        """For one episode."""
        return SpinPlanner(rng)
