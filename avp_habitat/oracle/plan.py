"""The best action sequence that the oracle finds for one agent, with the coverage that it will reach."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from avp_habitat.agent_view import AgentView
from avp_habitat.coverage import candidates
from avp_habitat.errors import UsageError
from avp_habitat.motion import act, sensor_poses
from avp_habitat.oracle.lattice import lattice_of, pack
from avp_habitat.oracle.search import BeamSettings, beam_search
from avp_habitat.oracle.states import start_state
from avp_habitat.oracle.tour import covering_tour
from avp_habitat.settings import TaskSettings


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
