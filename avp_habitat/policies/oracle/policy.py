"""`oracle`, `survey` and `survey-multiview`: they plan a whole episode when it starts, then play the plan."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from avp_habitat.errors import UsageError
from avp_habitat.policies.oracle.multiview import plan_second_looks
from avp_habitat.policies.oracle.places import scene_places
from avp_habitat.policies.oracle.search import beam_search, covering_tour, start_state
from avp_habitat.policies.planning import PlanningPolicy
from avp_habitat.sight.rules import candidates
from avp_habitat.task.agent_view import AgentView
from avp_habitat.task.motion import act, sensor_poses

Objective = Literal["floor", "surface", "multiview"]
"""What a plan is for: seeing all floor, all surfaces, or all surfaces twice, from directions 10° apart."""
_NAMES = {"floor": "oracle", "surface": "survey", "multiview": "survey-multiview"}


@dataclass(frozen=True)
class Plan:
    """What to do in the rest of an episode; T views are left."""

    actions: NDArray[np.int64]
    """`(T,)` numbers of `settings.ACTION_NAMES`; never stop."""
    coverage: NDArray[np.float64]
    """`(T,)` coverage C after each view (Eq. 17)."""


def make_plan(view: AgentView, *, objective: Objective = "floor", width: int | None = None) -> Plan:
    """Plan the rest of an agent's episode with full knowledge of the scene.

    Two plans are made, by the tour of a greedy set cover and by a beam search over action sequences, and the one with
    the larger mean coverage over its views is returned. For the objective `surface` the search alone plans to see every
    surface, not the floor alone; surfaces other than the floor count as not yet seen. For `multiview` it plans to see
    each twice, along rays 10° apart (`multiview.plan_second_looks`), and all count as not yet seen.

    Raises:
        UsageError: the task does not count visible cells.
    """
    settings = view.settings
    if settings.coverage_mode != "visible":
        raise UsageError(
            f"policy {_NAMES[objective]}: plans for coverage_mode 'visible', got {settings.coverage_mode!r}; choose "
            "another policy"
        )
    views, sparse = settings.budget - view.steps, objective == "multiview"
    places = scene_places(view.simulator, settings, surfaces=objective != "floor", sparse=sparse)
    if objective == "multiview":
        found = [plan_second_looks(places, view, views, width or 300)]
    else:
        start = start_state(view, len(places.points))
        found = [covering_tour(places, settings, start, views)] if objective == "floor" else []
        found.append(beam_search(places, settings, start, views, width or (1000 if objective == "floor" else 300)))
    plans = [Plan(actions, planned_coverage(view, actions)) for actions in found]
    return max(plans, key=lambda plan: plan.coverage.sum())


def planned_coverage(view: AgentView, actions: NDArray[np.int64]) -> NDArray[np.float64]:
    """`(T,)` coverage after each of `(T,)` actions of an agent, by the task's own rule and true camera rays."""
    settings, simulator = view.settings, view.simulator
    state = view.position[None], np.array([view.yaw]), np.array([view.pitch])
    states = []
    for action in actions:
        state = act(simulator.area, settings, np.array([action]), *state)
        states.append(state)
    position, yaw, pitch = (np.concatenate(parts) for parts in zip(*states, strict=True))
    sensor, points = sensor_poses(settings, position, yaw, pitch), simulator.area.centres
    camera = settings.intrinsics
    unseen = np.broadcast_to(~view.observed, (len(actions), len(points)))
    pairs = candidates(sensor, camera, points, unseen, max_range_m=settings.max_range_m)
    reached = simulator.visible(sensor, camera, points, pairs, tolerance_m=settings.tolerance_m)
    first = np.full(len(points), len(actions))
    np.minimum.at(first, pairs[reached, 1], pairs[reached, 0])
    new = np.bincount(first, minlength=len(actions) + 1)[: len(actions)]
    return (view.observed.sum() + np.cumsum(new)) / len(points)


class OraclePlanner:
    """Plans when it is first asked, or after steps that were not its own, then plays the plan."""

    def __init__(self, make: Callable[[AgentView], Plan]) -> None:
        """Plan nothing yet."""
        self.plan: Plan | None = None
        self._make = make
        self._begin = self._next = 0

    def act(self, view: AgentView) -> int:
        """The next action."""
        if self.plan is None or view.steps != self._next:
            self.plan, self._begin = self._make(view), view.steps
        self._next = view.steps + 1
        return int(self.plan.actions[view.steps - self._begin])


class OraclePolicy(PlanningPolicy):
    """`oracle`: full knowledge of the scene, the ceiling to compare other policies with.

    It prepares each scene once and then plans for each episode; it never stops before the budget ends.
    """

    objective: Objective = "floor"

    def __init__(
        self, views: Callable[[], list[AgentView]], seed: int | None = None, *, width: int | None = None
    ) -> None:
        """As `PlanningPolicy`, and with the number of states that the beam search keeps."""
        super().__init__(views, seed)
        self.width = width

    def make_planner(self, rng: np.random.Generator) -> OraclePlanner:
        """For one episode; nothing is drawn at random."""
        return OraclePlanner(partial(make_plan, objective=self.objective, width=self.width))


class SurveyPolicy(OraclePolicy):
    """`survey`: the oracle for reconstruction, which plans to see every surface of the scene, not the floor alone."""

    objective = "surface"


class MultiviewSurveyPolicy(OraclePolicy):
    """`survey-multiview`: the survey that also plans a second look at every surface, from another direction."""

    objective = "multiview"
