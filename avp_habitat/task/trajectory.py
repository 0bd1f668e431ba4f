"""What one agent did in one episode, as arrays over its steps and as figures."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avp_habitat import metrics


@dataclass(frozen=True)
class Trajectory:
    """t steps of one agent; every step captured one view."""

    start: NDArray[np.float64]
    """`(3,)` the agent's feet before the first step, metres, world frame."""
    position: NDArray[np.float64]
    """`(t, 3)` the agent's feet after each step, metres, world frame."""
    yaw: NDArray[np.float64]
    """`(t,)` radians about +Y, left positive."""
    pitch: NDArray[np.float64]
    """`(t,)` radians, up positive."""
    camera_to_world: NDArray[np.float64]
    """`(t, 4, 4)` sensor poses of the captured views, habitat axes."""
    action: NDArray[np.int64]
    """`(t,)` the actions taken."""
    reward: NDArray[np.float64]
    """`(t,)` the sum of the parts."""
    reward_parts: dict[str, NDArray[np.float64]]
    """`(t,)` each named part of the reward."""
    coverage: NDArray[np.float64]
    """`(t,)` share of the navigable cells observed up to and including each step."""
    collided: NDArray[np.bool_]
    """`(t,)` forward was chosen and the agent moved less than 0.05 m."""
    redundant: NDArray[np.bool_]
    """`(t,)` an earlier view lies close in position and in both angles."""
    first_seen: NDArray[np.int16]
    """`(m,)` for each navigable cell, the step (from 1) whose view first observed it; 0 for never."""
    surface: float | None = None
    """How well the scene's surface was seen at the end, within [0, 1] (`surfaces`); None where it was not computed."""


def episode_metrics(trajectory: Trajectory, *, stopped: bool, further: Sequence[Any] = ()) -> dict[str, float]:
    """Figures of one finished episode, which the agent itself stopped or not, and those of `TaskSettings.metrics`."""
    surface = {} if trajectory.surface is None else {"surface": trajectory.surface}
    views = len(trajectory.action)
    coverage = float(trajectory.coverage[-1]) if views else 0.0
    return {
        "coverage": coverage,
        "views": float(views),
        "annd_m": metrics.nearest_neighbour_distance(trajectory.camera_to_world[:, :3, 3]),
        "ei": metrics.efficiency_index(coverage, views),
        "path_length_m": metrics.path_length(trajectory.start, trajectory.position),
        "collisions": float(trajectory.collided.sum()),
        "redundant_views": float(trajectory.redundant.sum()),
        "stopped": float(stopped),
        **{f"return_{name}": float(values.sum()) for name, values in trajectory.reward_parts.items()},
        **surface,
        **metrics.measured(further, "episode", trajectory),
    }
