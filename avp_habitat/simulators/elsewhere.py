"""What is known of a simulator in another process: its names and its navigable area."""

from dataclasses import dataclass
from typing import Any, NoReturn

from avp_habitat.errors import SimulatorError
from avp_habitat.navigation.area import NavigableArea
from avp_habitat.scenes.location import Frame
from avp_habitat.simulators.base import Simulator


@dataclass(frozen=True)
class SimulatorElsewhere:
    """A `Simulator` that cannot look: the one it stands for is in another process."""

    name: str
    """As of the simulator."""
    version: str
    """As of the simulator."""
    scene: str
    """As of the simulator."""
    scene_digest: str
    """As of the simulator."""
    scene_frame: Frame
    """As of the simulator."""
    area: NavigableArea
    """As of the simulator."""

    @classmethod
    def of(cls, simulator: Simulator) -> "SimulatorElsewhere":
        """What another process may know."""
        about = (simulator.scene, simulator.scene_digest, simulator.scene_frame)
        return cls(simulator.name, simulator.version, *about, simulator.area)

    def render(self, *_: Any, **__: Any) -> NoReturn:
        """Refused.

        Raises:
            SimulatorError: always.
        """
        raise SimulatorError(
            f"{self.scene}: its simulator is in another process and cannot be asked for views here; run a planner that "
            "looks at the whole scene (oracle, survey) without SubprocVecEnv"
        )

    visible = render

    def close(self) -> None:
        """Nothing to free here."""
