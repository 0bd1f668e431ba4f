"""Which points of a scene are seen from places, whichever way one would have to look, as bits."""

import numpy as np
from numpy.typing import NDArray

from avp_habitat.errors import UsageError
from avp_habitat.lookup.rows import words_for
from avp_habitat.poses import Intrinsics, camera_to_world
from avp_habitat.simulators.base import Simulator, SingleRays

Float = NDArray[np.floating]

# Six square images around a place; a little wider than a quarter turn, so that no point falls between two of them.
_AROUND = camera_to_world(
    np.zeros((6, 3)), yaw=np.radians([0.0, 90, 180, 270, 0, 0]), pitch=np.radians([0.0, 0, 0, 0, 90, -90])
)
_SIDE = Intrinsics.from_hfov(640, 640, hfov_deg=91.0)


def single_rays(simulator: Simulator, asker: str) -> SingleRays:
    """The simulator itself, where it casts single rays.

    Args:
        simulator: any.
        asker: option that needs them, for the error's text.

    Raises:
        UsageError: it shows whole images only.
    """
    if isinstance(simulator, SingleRays):
        return simulator
    raise UsageError(
        f"{asker}: needs single rays in all directions, which the simulator {simulator.name!r} does not cast; leave "
        f"{asker} off, or use the simulator 'raycast'"
    )


def reached_around(
    simulator: Simulator, eye: Float, points: Float, pairs: NDArray[np.integer], *, tolerance_m: float
) -> NDArray[np.bool_]:
    """Whether rays reach points in any direction: cast one by one where the simulator can, else read in panoramas.

    Args:
        simulator: of the scene.
        eye: `(n, 3)` metres, world frame.
        points: `(m, 3)` metres, world frame.
        pairs: `(k, 2)` rows (eye, point).
        tolerance_m: a hit this close before the point still reaches it, metres along the ray.

    Returns:
        `(k,)`.
    """
    if isinstance(simulator, SingleRays):
        return simulator.reached(eye, points, pairs, tolerance_m=tolerance_m)
    pose = np.tile(_AROUND, (len(eye), 1, 1))
    pose[:, :3, 3] = np.repeat(eye, len(_AROUND), axis=0)
    ahead = -_AROUND[:, :3, 2]
    side = ((points[pairs[:, 1]] - eye[pairs[:, 0]]) @ ahead.T).argmax(axis=1)
    images = np.stack([len(_AROUND) * pairs[:, 0] + side, pairs[:, 1]], axis=1)
    return simulator.visible(pose, _SIDE, points, images, tolerance_m=tolerance_m)


def seen_bits(
    simulator: Simulator, eye: Float, points: Float, *, reach_m: Float | float, tolerance_m: float
) -> NDArray[np.uint64]:
    """Look from every place at every point in reach.

    Args:
        simulator: of the scene.
        eye: `(k, 3)` places, metres.
        points: `(m, 3)` metres.
        reach_m: points farther away are not seen, metres; one number, or `(m,)`.
        tolerance_m: a hit this close before a point still reaches it, metres along the ray.

    Returns:
        `(k, words)`: bit j % 64 of word j // 64 says whether point j is seen from the place.
    """
    pairs = np.argwhere(((points[None] - eye[:, None]) ** 2).sum(axis=-1) <= np.square(reach_m))
    seen = reached_around(simulator, eye, points, pairs, tolerance_m=tolerance_m)
    bits = np.zeros((len(eye), words_for(len(points)) * 64), dtype=np.bool_)
    bits[pairs[seen, 0], pairs[seen, 1]] = True
    return np.packbits(bits, axis=1, bitorder="little").view("<u8").astype(np.uint64)
