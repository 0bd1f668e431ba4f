"""The baseline that goes to the nearest frontier of the observed floor (Yamauchi 1997)."""

import numpy as np

from avp_habitat.agent_view import AgentView
from avp_habitat.baselines.approach import Approach
from avp_habitat.baselines.frontiers import find_frontiers
from avp_habitat.baselines.memory import Memory
from avp_habitat.baselines.planning import PlanningPolicy
from avp_habitat.baselines.sight import should_look_down
from avp_habitat.settings import LOOK_DOWN, TURN_LEFT


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
