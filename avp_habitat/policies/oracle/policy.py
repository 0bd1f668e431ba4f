"""Planners with Stable-Baselines3's `predict` interface: they plan when an episode starts, then play the plan."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from avp_habitat.errors import UsageError
from avp_habitat.policies.oracle.lattice import lattice_of, pack, start_state
from avp_habitat.policies.oracle.search import BeamSettings, beam_search
from avp_habitat.policies.oracle.tour import covering_tour
from avp_habitat.policies.planning import action_shape
from avp_habitat.sight.coverage import candidates
from avp_habitat.task.agent_view import AgentView, agent_views
from avp_habitat.task.motion import act, sensor_poses
from avp_habitat.task.settings import TaskSettings


@dataclass(frozen=True)
class Plan:
    """What to do in the rest of an episode; T views are left."""

    actions: NDArray[np.int64]
    """`(T,)` numbers of `settings.ACTION_NAMES`; never stop."""
    coverage: NDArray[np.float64]
    """`(T,)` coverage C after each view (Eq. 17)."""


def make_plan(view: AgentView, beam: BeamSettings | None = None) -> Plan:
    """Plan the rest of an agent's episode with full knowledge of the scene.

    Two plans are made: a tour of a greedy set cover, and a beam search over action sequences. The one with the larger
    mean coverage over its views is returned.

    Args:
        view: the agent now; at the start of an episode all views are left.
        beam: width of the search.

    Raises:
        UsageError: the task does not count visible cells.
    """
    settings, area = view.settings, view.simulator.area
    _check_mode("oracle", settings)
    views = settings.budget - view.steps
    lattice = lattice_of(view.simulator, settings)
    start = start_state(view.position, pack(view.observed[None])[0], yaw=view.yaw, pitch=view.pitch)
    tour = covering_tour(area, lattice, settings, start, views)
    found = beam_search(area, lattice, settings, start, views, beam or BeamSettings())
    plans = [Plan(actions, planned_coverage(view, actions)) for actions in (tour, found)]
    return max(plans, key=lambda plan: plan.coverage.sum())


def make_survey(view: AgentView, beam: BeamSettings | None = None) -> Plan:
    """Plan the rest of an agent's episode so that every surface is seen, not the floor alone.

    The beam search of the oracle, with points on walls, furniture and ceiling beside the floor's cells. An episode that
    is under way counts surfaces other than the floor as not yet seen.

    Args:
        view: the agent now.
        beam: width of the search.

    Raises:
        UsageError: the task does not count visible cells.
    """
    settings = view.settings
    _check_mode("survey", settings)
    lattice = lattice_of(view.simulator, settings, surfaces=True)
    seen = np.zeros(len(lattice.points), dtype=np.bool_)
    seen[: len(view.observed)] = view.observed
    start = start_state(view.position, pack(seen[None])[0], yaw=view.yaw, pitch=view.pitch)
    views = settings.budget - view.steps
    actions = beam_search(view.simulator.area, lattice, settings, start, views, beam or BeamSettings(width=300))
    return Plan(actions, planned_coverage(view, actions))


def _check_mode(policy: str, settings: TaskSettings) -> None:
    if settings.coverage_mode != "visible":
        raise UsageError(
            f"policy {policy}: plans for coverage_mode 'visible', got {settings.coverage_mode!r}; choose another policy"
        )


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


class OraclePolicy:
    """An offline planner with full knowledge of the scene: the ceiling to compare other policies with.

    It prepares each scene once and then plans for each episode; it never stops before the budget ends.
    """

    _make_plan = staticmethod(make_plan)

    def __init__(self, views: Callable[[], list[AgentView]], beam: BeamSettings | None = None) -> None:
        """Use a source of the agents' states.

        Args:
            views: gives the agents now, in order.
            beam: width of the search.
        """
        self._views = views
        self._beam = beam
        self._plans: dict[int, Plan] = {}
        self._begin: dict[int, int] = {}
        self._next: dict[int, int] = {}

    @classmethod
    def for_env(cls, env: Any, seed: int | None = None) -> Self:
        """The planner for an `AVPEnv` (also a wrapped one) or a vector environment of them; it draws nothing."""
        del seed
        return cls(lambda: agent_views(env))

    def plan(self, agent: int) -> Plan:
        """The plan that an agent follows now; made by `predict`."""
        return self._plans[agent]

    def predict(
        self, observation: NDArray, state: Any = None, episode_start: Any = None, deterministic: bool = False
    ) -> tuple[NDArray[np.int64], Any]:
        """Actions for `(n, k)` observations, `(n,)`, or for one `(k,)` observation, `()`; the state is None.

        Raises:
            UsageError: the task does not count visible cells.
        """
        actions = np.array([self._action(agent, view) for agent, view in enumerate(self._views())], dtype=np.int64)
        return actions.reshape(action_shape(observation, len(actions))), None

    def _action(self, agent: int, view: AgentView) -> int:
        if view.steps == 0 or self._next.get(agent) != view.steps:
            self._plans[agent], self._begin[agent] = self._make_plan(view, self._beam), view.steps
        self._next[agent] = view.steps + 1
        return int(self._plans[agent].actions[view.steps - self._begin[agent]])


class SurveyPolicy(OraclePolicy):
    """The oracle for reconstruction: it plans to see every surface of the scene, not the floor alone."""

    _make_plan = staticmethod(make_survey)
