"""Policies that react to the newest view: `random`, `heuristic` and `spin`."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avp_habitat.policies.planning import PlanningPolicy, action_shape
from avp_habitat.task.agent_view import AgentView
from avp_habitat.task.settings import ACTION_NAMES, MOVE_FORWARD, TURN_LEFT, TURN_RIGHT

CLEARANCE_M = 1.0
"""The heuristic walks on while the depth at the image centre is above this (Eq. 23), metres."""
WALK_M = 2.0
"""Length of a walk between two full circles, metres."""


class RandomPolicy:
    """Any of the six actions, with equal odds."""

    def __init__(self, seed: int | None = None, agents: int | None = None) -> None:
        """Start a random generator of its own; without `agents`, observations are arrays `(n, k)` or `(k,)`."""
        self._rng = np.random.default_rng(seed)
        self._agents = agents

    @classmethod
    def for_env(cls, env: Any, seed: int | None = None) -> "RandomPolicy":
        """The random policy for an `AVPEnv` or a vector environment of them."""
        return cls(seed, getattr(env, "num_envs", 1))

    def predict(
        self, observation: NDArray, state: Any = None, episode_start: Any = None, deterministic: bool = False
    ) -> tuple[NDArray[np.int64], Any]:
        """Actions for `(n, 12)` observations, `(n,)`, or for one `(12,)` observation, `()`; the state is None."""
        shape = np.shape(observation)[:-1] if self._agents is None else action_shape(observation, self._agents)
        return self._rng.integers(len(ACTION_NAMES), size=shape), None


class HeuristicPolicy:
    """Forward while there is room ahead, else left or right with equal odds (Eq. 23); it uses three actions."""

    def __init__(self, centre_depth: Callable[[], NDArray[np.floating]], seed: int | None = None) -> None:
        """Use a source of the `(n,)` planar depths in metres in the middle of the newest views."""
        self._centre_depth = centre_depth
        self._rng = np.random.default_rng(seed)

    @classmethod
    def for_env(cls, env: Any, seed: int | None = None) -> "HeuristicPolicy":
        """The heuristic for an `AVPEnv` (also a wrapped one) or a vector environment of them."""
        if hasattr(env, "get_attr"):
            return cls(lambda: np.array(env.get_attr("centre_depth")), seed)
        return cls(lambda: np.array([env.get_wrapper_attr("centre_depth")]), seed)

    def predict(
        self, observation: NDArray, state: Any = None, episode_start: Any = None, deterministic: bool = False
    ) -> tuple[NDArray[np.int64], Any]:
        """Actions for `(n, 12)` observations, `(n,)`, or for one `(12,)` observation, `()`; the state is None."""
        depth = self._centre_depth()
        turn = np.where(self._rng.random(len(depth)) < 0.5, TURN_LEFT, TURN_RIGHT)
        action = np.where(depth > CLEARANCE_M, MOVE_FORWARD, turn).astype(np.int64)
        return action.reshape(action_shape(observation, len(depth))), None


class SpinPlanner:
    """A full circle, then forward by the heuristic's rule for `WALK_M`, and again; it reads no more than a depth."""

    def __init__(self, rng: np.random.Generator) -> None:
        """Begin with a full circle."""
        self._rng = rng
        self._turns = self._walked = 0
        self._aside: int | None = None

    def act(self, view: AgentView) -> int:
        """A turn to the left until the circle is full, then forward, or a turn to where there is room."""
        if self._turns < int(np.ceil(360.0 / view.settings.turn_deg)):
            self._turns += 1
            return TURN_LEFT
        blocked = view.centre_depth <= CLEARANCE_M
        if self._walked and (blocked or view.collided or self._walked * view.settings.forward_m >= WALK_M):
            self._turns, self._walked, self._aside = 1, 0, None
            return TURN_LEFT
        if blocked:
            # Keep to the side drawn first: turns back and forth would find no room.
            if self._aside is None:
                self._aside = TURN_LEFT if self._rng.random() < 0.5 else TURN_RIGHT
            return self._aside
        self._walked += 1
        return MOVE_FORWARD


class SpinPolicy(PlanningPolicy):
    """`spin`: turn in place, then walk."""

    def make_planner(self, rng: np.random.Generator) -> SpinPlanner:
        """For one episode."""
        return SpinPlanner(rng)
