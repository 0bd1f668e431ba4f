"""What a planner may know about one agent: its state, and the floor cells that it has observed."""

from dataclasses import dataclass, fields
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from avp_habitat.errors import SimulatorError
from avp_habitat.navigation.area import NavigableArea
from avp_habitat.scenes.location import Frame
from avp_habitat.simulators.base import Simulator
from avp_habitat.task.motion import sensor_poses
from avp_habitat.task.settings import TaskSettings


@dataclass(frozen=True)
class SimulatorElsewhere:
    """A `Simulator` that cannot look: the one it stands for is in another process."""

    name: str
    version: str
    scene: str
    scene_digest: str
    scene_frame: Frame
    area: NavigableArea

    @classmethod
    def of(cls, simulator: Simulator) -> "SimulatorElsewhere":
        """What another process may know."""
        return cls(**{field.name: getattr(simulator, field.name) for field in fields(cls)})

    def render(self, *_: Any, **__: Any) -> NoReturn:
        """Refused by a `SimulatorError`."""
        raise SimulatorError(
            f"{self.scene}: its simulator is in another process and cannot be asked for views here; run a "
            "planner that asks for views (nbv, oracle, survey) without SubprocVecEnv"
        )

    visible = render

    def close(self) -> None:
        """Nothing to free here."""


@dataclass(frozen=True)
class AgentView:
    """One agent of the task at this moment; arrays are copies."""

    settings: TaskSettings
    """Of the task: amounts of the actions, camera, range, budget."""
    simulator: Simulator
    """The whole scene. Only a planner with full knowledge (the oracle) may ask it for more than the newest view, or
    read cells not yet observed."""
    position: NDArray[np.float64]
    """`(3,)` the feet, metres."""
    yaw: float
    """Radians, left positive."""
    pitch: float
    """Radians, up positive."""
    steps: int
    """t: views taken so far in the episode."""
    observed: NDArray[np.bool_]
    """`(m,)` which of `area.centres` were observed."""
    centre_depth: float
    """Planar depth in metres in the middle of the newest view, the whole range where nothing was hit."""
    collided: bool
    """Whether the newest step was a blocked forward move."""

    @property
    def camera_to_world(self) -> NDArray[np.float64]:
        """`(4, 4)` pose of the newest view, habitat axes."""
        angles = np.array([self.yaw]), np.array([self.pitch])
        return sensor_poses(self.settings, self.position[None], *angles)[0]

    @property
    def area(self) -> NavigableArea:
        """The scene's navigable area; unobserved parts of its mask are not known to the agent."""
        return self.simulator.area

    def __getstate__(self) -> dict[str, Any]:
        """For other processes, where the simulator itself cannot follow."""
        return self.__dict__ | {"simulator": SimulatorElsewhere.of(self.simulator)}


def agent_views(env: Any) -> list[AgentView]:
    """The agents of an `AVPEnv` (also a wrapped one) or of a vector environment of them, in order."""
    if hasattr(env, "get_attr"):
        return env.get_attr("agent_view")
    return [env.get_wrapper_attr("agent_view")]
