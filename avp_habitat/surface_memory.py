"""How well agents have seen the surface of their scenes so far in their episodes."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from avp_habitat.senses import Views
from avp_habitat.settings import TaskSettings
from avp_habitat.simulators.base import Simulator
from avp_habitat.surface_map import SurfaceMapper
from avp_habitat.surface_senses import make_surface_senses
from avp_habitat.surfaces import scene_surface

Rows = NDArray[np.integer]


class RoomSurface:
    """The memory of the agents in one scene; n is the number of all agents, also those elsewhere."""

    def __init__(self, simulator: Simulator, settings: TaskSettings, agents: int, rows: Rows) -> None:
        """Make room.

        Args:
            simulator: of the scene.
            settings: of the task.
            agents: n.
            rows: `(k,)` which of them are in this scene.

        Raises:
            UsageError: the simulator cannot do what the settings ask for, or the scene shows no surface.
        """
        surface = scene_surface(simulator, settings)
        self._senses = make_surface_senses(simulator, settings)
        self._mapper = SurfaceMapper(surface, settings.sensor_height_m)
        self._row = np.zeros(agents, dtype=np.int64)
        self._row[rows] = np.arange(len(rows))
        self._quality = np.zeros((len(rows), len(surface.points)), dtype=np.float32)

    def reset(self, rows: Rows) -> None:
        """Forget what some agents saw."""
        self._quality[self._row[rows]] = 0.0

    def capture(self, views: Views, rows: Rows) -> NDArray[np.float64]:
        """`(k,)` ΔS of the newest views of k agents, which are remembered."""
        return self._senses.capture(views, self._quality, self._row[rows])

    def observe(self, rows: Rows, position: NDArray[np.floating], yaw: NDArray[np.floating]) -> NDArray[np.float32]:
        """`(k, surface_map.SIZE)` what k agents know of the surface; see `SurfaceMapper.observe`."""
        return self._mapper.observe(self._quality, self._row[rows], position, yaw)

    def quality(self, row: int) -> NDArray[np.float32]:
        """`(m,)` how well one agent has seen each point of its scene's surface, within [0, 1]."""
        return self._quality[self._row[row]]


def room_surfaces(
    simulators: Sequence[Simulator], settings: TaskSettings, room_of: NDArray[np.integer]
) -> list[RoomSurface | None]:
    """A memory for each scene; None where the settings need none.

    Args:
        simulators: one for each scene.
        settings: of the task.
        room_of: `(n,)` the scene of each agent.
    """
    if not settings.with_surface:
        return [None] * len(simulators)
    return [
        RoomSurface(scene, settings, len(room_of), np.flatnonzero(room_of == index))
        for index, scene in enumerate(simulators)
    ]
