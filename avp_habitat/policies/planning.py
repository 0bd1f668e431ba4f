"""The `predict` of every policy that plans: one planner per agent, a new one for every episode."""

from collections.abc import Callable
from typing import Any, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from avp_habitat.task.agent_view import AgentView, agent_views


def action_shape(observation: Any, agents: int) -> tuple[int, ...]:
    """Of the actions for observations of any kind: `(n,)`, or `()` for one agent alone."""
    if agents > 1:
        return (agents,)
    return (1,) if np.ndim(observation) == 2 and len(observation) == 1 else ()


class Planner(Protocol):
    """Plans for one agent within one episode."""

    def act(self, view: AgentView) -> int:
        """The next action, a number of `settings.ACTION_NAMES`, from what the agent has seen."""
        ...


class PlanningPolicy:
    """Asks one planner per agent; a deriving class says which planner that is."""

    def __init__(self, views: Callable[[], list[AgentView]], seed: int | None = None) -> None:
        """Use a source of agents.

        Args:
            views: gives the `n` agents at this moment, in the order of the observations.
            seed: agent i's planners draw from a generator seeded with `seed + i`.
        """
        self._views, self._seed = views, seed
        self._generators: list[np.random.Generator] = []
        self._planners: list[Planner | None] = []
        self._steps: list[int] = []

    @classmethod
    def for_env(cls, env: Any, seed: int | None = None) -> Self:
        """The policy for an `AVPEnv` (also a wrapped one) or a vector environment of them."""
        return cls(lambda: agent_views(env), seed)

    def predict(
        self, observation: NDArray, state: Any = None, episode_start: Any = None, deterministic: bool = False
    ) -> tuple[NDArray[np.int64], Any]:
        """Actions for `(n, k)` observations, `(n,)`, or for one `(k,)` observation, `()`; the state is None."""
        views = self._views()
        if len(self._planners) != len(views):
            seeds = [None if self._seed is None else self._seed + index for index in range(len(views))]
            self._generators = [np.random.default_rng(seed) for seed in seeds]
            self._planners, self._steps = [None] * len(views), [0] * len(views)
        actions = np.array([self._act(index, view) for index, view in enumerate(views)], dtype=np.int64)
        return actions.reshape(action_shape(observation, len(views))), None

    def make_planner(self, rng: np.random.Generator) -> Planner:
        """A planner for one episode of one agent, which may draw from `rng`."""
        raise NotImplementedError

    def planner(self, agent: int) -> Planner | None:
        """The planner that an agent follows now; None before the first `predict`."""
        return self._planners[agent]

    def _act(self, index: int, view: AgentView) -> int:
        planner = self._planners[index]
        if planner is None or view.steps == 0 or view.steps < self._steps[index]:
            planner = self._planners[index] = self.make_planner(self._generators[index])
        self._steps[index] = view.steps
        return planner.act(view)
