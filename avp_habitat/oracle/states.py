"""Agents in the middle of a planned episode."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]


@dataclass(frozen=True)
class States:
    """n agents that have taken equally many views; every array's first axis is n."""

    position: Float
    """`(n, 3)` feet, metres."""
    yaw: Float
    """`(n,)` radians."""
    pitch: Float
    """`(n,)` radians."""
    seen: NDArray[np.uint64]
    """`(n, words)` bit sets of the observed cells."""
    value: Float
    """`(n,)` cells times views: what the new cells add to the area under the curve of observed cells over views."""


def start_state(position: Float, seen: NDArray[np.uint64], *, yaw: float, pitch: float) -> States:
    """One agent at `(3,)` metres that has seen the bit set `(words,)`; angles in radians."""
    return States(
        np.asarray(position, dtype=np.float64)[None], np.array([yaw]), np.array([pitch]), seen[None].copy(), np.zeros(1)
    )
