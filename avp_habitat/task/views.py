"""The newest views of agents, what they show, and what computes it."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from avp_habitat.poses import Intrinsics
from avp_habitat.simulators.base import Simulator
from avp_habitat.task.settings import TaskSettings

Float = NDArray[np.floating]


@dataclass(frozen=True)
class Views:
    """Newest views of k agents of one scene; every array's first axis is k."""

    position: Float
    """`(k, 3)` the agents' feet, metres."""
    yaw: Float
    """`(k,)` radians."""
    pitch: Float
    """`(k,)` radians."""
    camera_to_world: Float
    """`(k, 4, 4)` habitat axes."""


@dataclass(frozen=True)
class Shown:
    """What k views show."""

    least: Float
    """`(k,)` least planar depth as a share of the range."""
    mean: Float
    """`(k,)` mean planar depth as a share of the range."""
    new_cells: NDArray[np.int64]
    """`(k,)` how many navigable cells they observe for the first time; 0 where nothing was captured."""


class Sensor(Protocol):
    """The depth cameras of the agents in one scene."""

    def look(self, views: Views) -> Shown:
        """Depth statistics alone, as at a start, which is no captured view."""
        ...

    def capture(
        self, views: Views, first_seen: NDArray[np.int16], rows: NDArray[np.integer], steps: NDArray[np.integer]
    ) -> Shown:
        """Depth statistics, and coverage: cells seen for the first time are marked in place.

        Args:
            views: of k agents.
            first_seen: `(n, >= m)` step at which each cell was first seen, 0 for never.
            rows: `(k,)` the agents' rows of it.
            steps: `(k,)` the agents' steps.
        """
        ...


def depth_statistics(depth: Float, max_range_m: float) -> tuple[Float, Float]:
    """Least and mean depth as shares of the range, `(n,)` each, clipped to [0, 1].

    Args:
        depth: `(n, h, w)` planar depth in metres, 0 where nothing was hit, which counts as the whole range.
        max_range_m: what the value 1 stands for.
    """
    shares = np.where(depth > 0, np.minimum(depth / max_range_m, 1.0), 1.0).reshape(len(depth), -1)
    return shares.min(axis=1), shares.mean(axis=1)


def centre_depth(simulator: Simulator, settings: TaskSettings, views: Views) -> Float:
    """`(k,)` planar depth in metres at the views' middle pixel, the whole range where nothing is hit."""
    whole = settings.intrinsics
    column, row = whole.width // 2, whole.height // 2
    pixel = Intrinsics(1, 1, whole.fx, whole.fy, whole.cx - column, whole.cy - row)
    depth = simulator.render(views.camera_to_world, pixel, rgb=False).depth[:, 0, 0]
    return np.where(depth > 0, depth, settings.max_range_m)
