"""Active viewpoint planning in indoor scenes: simulators, the task, `AVP-v0`, baselines and rollouts.

Importing the package registers `AVP-v0` with gymnasium and costs milliseconds: what it offers is imported when it is
first named.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

import gymnasium

if TYPE_CHECKING:
    from avp_habitat.collect import Collect
    from avp_habitat.metrics import Figure, metric
    from avp_habitat.navigation.area import NavigableArea
    from avp_habitat.policies.registry import make_policy
    from avp_habitat.poses import pixel_directions
    from avp_habitat.rollout.capture import RecordRollout
    from avp_habitat.rollout.format import Rollout, read_rollout
    from avp_habitat.scenes.location import Frame
    from avp_habitat.sight.rules import visible_in_depth
    from avp_habitat.simulators.base import Frames, Simulator, SingleRays
    from avp_habitat.simulators.registry import make_simulator
    from avp_habitat.task.agent_view import AgentView, agent_views
    from avp_habitat.task.env import AVPEnv
    from avp_habitat.task.observations import Agents, numbers
    from avp_habitat.task.rewards import RewardConstants, StepFacts, reward
    from avp_habitat.task.settings import TaskSettings
    from avp_habitat.task.trajectory import Trajectory

__all__ = [
    "AVPEnv",
    "AgentView",
    "Agents",
    "Collect",
    "Figure",
    "Frame",
    "Frames",
    "NavigableArea",
    "RecordRollout",
    "RewardConstants",
    "Rollout",
    "Simulator",
    "SingleRays",
    "StepFacts",
    "TaskSettings",
    "Trajectory",
    "agent_views",
    "make_policy",
    "make_simulator",
    "metric",
    "numbers",
    "pixel_directions",
    "read_rollout",
    "reward",
    "visible_in_depth",
]

_HOMES = {
    "collect": {"Collect"},
    "metrics": {"Figure", "metric"},
    "navigation.area": {"NavigableArea"},
    "policies.registry": {"make_policy"},
    "poses": {"pixel_directions"},
    "rollout.capture": {"RecordRollout"},
    "rollout.format": {"Rollout", "read_rollout"},
    "scenes.location": {"Frame"},
    "sight.rules": {"visible_in_depth"},
    "simulators.base": {"Frames", "Simulator", "SingleRays"},
    "simulators.registry": {"make_simulator"},
    "task.agent_view": {"AgentView", "agent_views"},
    "task.env": {"AVPEnv"},
    "task.observations": {"Agents", "numbers"},
    "task.rewards": {"RewardConstants", "StepFacts", "reward"},
    "task.settings": {"TaskSettings"},
    "task.trajectory": {"Trajectory"},
}
ENV_ID = "AVP-v0"

if ENV_ID not in gymnasium.registry:
    # The task counts its own budget, so gymnasium's TimeLimit is not used.
    gymnasium.register(ENV_ID, entry_point="avp_habitat.rollout.capture:make_env")


def __getattr__(name: str) -> Any:
    for home, names in _HOMES.items():
        if name in names:
            return getattr(import_module(f"{__name__}.{home}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
