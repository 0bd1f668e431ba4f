"""Planners with Stable-Baselines3's `predict` interface: they plan when an episode starts, then play the plan."""

from collections.abc import Callable
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from avp_habitat.agent_view import AgentView, agent_views
from avp_habitat.oracle.plan import Plan, make_plan, make_survey
from avp_habitat.oracle.search import BeamSettings


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
        return actions.reshape(np.shape(observation)[:-1]), None

    def _action(self, agent: int, view: AgentView) -> int:
        if view.steps == 0 or self._next.get(agent) != view.steps:
            self._plans[agent], self._begin[agent] = self._make_plan(view, self._beam), view.steps
        self._next[agent] = view.steps + 1
        return int(self._plans[agent].actions[view.steps - self._begin[agent]])


class SurveyPolicy(OraclePolicy):
    """The oracle for reconstruction: it plans to see every surface of the scene, not the floor alone."""

    _make_plan = staticmethod(make_survey)
