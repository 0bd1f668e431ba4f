"""The twelve numbers that a policy observes, for n agents at a time."""

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.floating]

NAMES = (
    "t / T",
    "dx / r",
    "dz / r",
    "sin yaw",
    "cos yaw",
    "sin pitch",
    "cos pitch",
    "min depth",
    "mean depth",
    "coverage",
    "collided",
    "distance to mean / r",
)
"""What each number is; r is the diameter of the navigable area."""
LOW = np.array([0, -1, -1, -1, -1, -1, -1, 0, 0, 0, 0, 0], dtype=np.float32)
HIGH = np.ones(12, dtype=np.float32)


def depth_statistics(depth: Float, max_range_m: float) -> tuple[Float, Float]:
    """Least and mean depth as shares of the range, `(n,)` each, clipped to [0, 1].

    Args:
        depth: `(n, h, w)` planar depth in metres, 0 where nothing was hit, which counts as the whole range.
        max_range_m: what the value 1 stands for.
    """
    shares = np.where(depth > 0, np.minimum(depth / max_range_m, 1.0), 1.0).reshape(len(depth), -1)
    return shares.min(axis=1), shares.mean(axis=1)


def observation(
    *,
    progress: Float,
    offset: Float,
    yaw: Float,
    pitch: Float,
    min_depth: Float,
    mean_depth: Float,
    coverage: Float,
    collided: NDArray[np.bool_],
    spread: Float,
) -> NDArray[np.float32]:
    """Observations of n agents in the order of `NAMES`.

    Args:
        progress: `(n,)` t / T.
        offset: `(n, 2)` x and z from the start, in units of r.
        yaw: `(n,)` radians, left positive.
        pitch: `(n,)` radians, up positive.
        min_depth: `(n,)` share of 10 m.
        mean_depth: `(n,)` share of 10 m.
        coverage: `(n,)` within [0, 1].
        collided: `(n,)` whether the last step did.
        spread: `(n,)` ‖p − p̄‖ in units of r.

    Returns:
        `(n, 12)` float32 within [`LOW`, `HIGH`].
    """
    columns = [
        progress,
        offset[:, 0],
        offset[:, 1],
        np.sin(yaw),
        np.cos(yaw),
        np.sin(pitch),
        np.cos(pitch),
        min_depth,
        mean_depth,
        coverage,
        collided,
        spread,
    ]
    return np.clip(np.stack(columns, axis=1).astype(np.float32), LOW, HIGH)
