"""What one agent did in one episode, as arrays over its steps."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


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
