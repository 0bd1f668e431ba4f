"""The newest views of agents, and what they show."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

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


def depth_statistics(depth: Float, max_range_m: float) -> tuple[Float, Float]:
    """Least and mean depth as shares of the range, `(n,)` each, clipped to [0, 1].

    The planar depth is `(n, h, w)` metres, 0 where nothing was hit, which counts as the whole range.
    """
    shares = np.where(depth > 0, np.minimum(depth / max_range_m, 1.0), 1.0).reshape(len(depth), -1)
    return shares.min(axis=1), shares.mean(axis=1)
