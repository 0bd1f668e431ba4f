"""Which points of a scene are seen from places, as bits."""

import numpy as np
from numpy.typing import NDArray

from avp_habitat.lookup.rows import words_for
from avp_habitat.poses import camera_to_world
from avp_habitat.simulators.base import Simulator

Float = NDArray[np.floating]


def seen_bits(
    simulator: Simulator, eye: Float, points: Float, *, reach_m: float, tolerance_m: float
) -> NDArray[np.uint64]:
    """Cast a ray from every place to every point in reach.

    Args:
        simulator: casts them.
        eye: `(k, 3)` places, metres.
        points: `(m, 3)` metres.
        reach_m: points as far away as this, or farther, are not seen, metres.
        tolerance_m: a hit this close before a point still reaches it, metres along the ray.

    Returns:
        `(k, words)`: bit j % 64 of word j // 64 says whether point j is seen from the place.
    """
    pairs = np.argwhere(((points[None] - eye[:, None]) ** 2).sum(axis=-1) < reach_m**2)
    poses = camera_to_world(eye, yaw=np.zeros(len(eye)), pitch=np.zeros(len(eye)))
    seen = simulator.visible(poses, points, pairs, tolerance_m=tolerance_m)
    bits = np.zeros((len(eye), words_for(len(points)) * 64), dtype=np.bool_)
    bits[pairs[seen, 0], pairs[seen, 1]] = True
    return np.packbits(bits, axis=1, bitorder="little").view("<u8").astype(np.uint64)
