"""An occupancy grid made of depth images, and the volumetric information that rays through it would gain.

Isler, Sabzevari, Delmerico and Scaramuzza, 2016, "An information gain formulation for active volumetric 3D
reconstruction" (ICRA). Voxels are unknown, free or occupied; an unknown voxel holds one bit, a known one none.
"""

import numpy as np
from numpy.typing import NDArray

from avp_habitat.compiled import njit
from avp_habitat.poses import Intrinsics, pixel_directions

Float = NDArray[np.floating]

UNKNOWN, FREE, OCCUPIED = range(3)
VOXEL_M = 0.1
"""Side of a voxel, metres."""
_SIDE_M, _BELOW_M, _ABOVE_M = 32.0, 1.0, 4.0
"""The grid's width, and how far it goes below and above the first agent's feet, metres."""
_CLEAR = 0.5
"""Probability that a ray passes an unknown voxel."""


class OccupancyGrid:
    """What depth images have shown, in voxels around the place of the first one.

    What lies beyond the grid is taken as known.
    """

    def __init__(self, feet: Float) -> None:
        """Know nothing around `(3,)` metres."""
        size = np.array([_SIDE_M, _BELOW_M + _ABOVE_M, _SIDE_M])
        self.corner = np.asarray(feet, np.float64) - [_SIDE_M / 2, _BELOW_M, _SIDE_M / 2]
        """`(3,)` least corner, metres."""
        self.state = np.zeros(tuple(np.ceil(size / VOXEL_M).astype(int)), np.uint8)
        """`(x, y, z)` UNKNOWN, FREE or OCCUPIED."""

    def integrate(self, depth: Float, pose: Float, camera: Intrinsics, max_range_m: float) -> None:
        """Enter a depth image: `(height, width)` planar metres, 0 where nothing was hit; `(4, 4)` habitat pose.

        Rays free the voxels before their hit and occupy the one in which it lies; a voxel that was hit once stays
        occupied.
        """
        local = pixel_directions(camera).reshape(-1, 3)
        planar, norm = depth.reshape(-1).astype(np.float64), np.linalg.norm(local, axis=1)
        reach = max_range_m / norm
        length = np.where(planar > 0, np.minimum(planar, reach), reach)
        hit = (planar > 0) & (planar <= reach)
        eye = (pose[:3, 3] - self.corner) / VOXEL_M
        ends = eye + (local * length[:, None]) @ pose[:3, :3].T / VOXEL_M
        _carve(self.state, eye, ends)
        _occupy(self.state, ends[hit])

    def gains(self, eyes: Float, directions: Float, max_range_m: float, rear_side: float) -> NDArray[np.float64]:
        """Information that rays would gain, in voxels.

        Σ over a ray's voxels of (probability that the ray gets so far) · (1 if unknown), which is Isler's
        occlusion-aware gain of unobserved voxels. To it comes `rear_side` where the ray enters a surface through an
        unknown voxel: it sees it from a side from which nobody has looked yet.

        Args:
            eyes: `(k, 3)` metres.
            directions: `(d, 3)` unit vectors.
            max_range_m: length of the rays.
            rear_side: worth of such a surface, in voxels.

        Returns:
            `(k, d)`.
        """
        start = (np.asarray(eyes, np.float64) - self.corner) / VOXEL_M
        found = np.zeros((len(start), len(directions)))
        _gains(self.state, start, np.ascontiguousarray(directions), max_range_m / VOXEL_M, rear_side, found)
        return found


@njit(cache=True)
def _first_border(at, direction):
    """Along one axis: the step from voxel to voxel, the length to the first border, and that between borders."""
    if direction > 0:
        return 1, (np.floor(at) + 1.0 - at) / direction, 1.0 / direction
    if direction < 0:
        return -1, (at - np.floor(at)) / -direction, -1.0 / direction
    return 0, np.inf, np.inf


@njit(cache=True)
def _carve(state, eye, ends):
    """Free what lies between an eye `(3,)` and `(n, 3)` ends, in voxels, up to half a voxel before them.

    From border to border (Amanatides and Woo, 1987, "A fast voxel traversal algorithm for ray tracing").
    """
    for k in range(len(ends)):
        x, y, z = int(np.floor(eye[0])), int(np.floor(eye[1])), int(np.floor(eye[2]))
        dx, dy, dz = ends[k, 0] - eye[0], ends[k, 1] - eye[1], ends[k, 2] - eye[2]
        last = 1.0 - 0.5 / max(np.sqrt(dx * dx + dy * dy + dz * dz), 1e-9)
        step_x, next_x, width_x = _first_border(eye[0], dx)
        step_y, next_y, width_y = _first_border(eye[1], dy)
        step_z, next_z, width_z = _first_border(eye[2], dz)
        share = 0.0
        while share <= last:
            inside = 0 <= x < state.shape[0] and 0 <= y < state.shape[1] and 0 <= z < state.shape[2]
            if inside and state[x, y, z] == UNKNOWN:
                state[x, y, z] = FREE
            if next_x <= next_y and next_x <= next_z:
                share, x, next_x = next_x, x + step_x, next_x + width_x
            elif next_y <= next_z:
                share, y, next_y = next_y, y + step_y, next_y + width_y
            else:
                share, z, next_z = next_z, z + step_z, next_z + width_z


@njit(cache=True)
def _occupy(state, hits):
    for k in range(len(hits)):
        x, y, z = int(np.floor(hits[k, 0])), int(np.floor(hits[k, 1])), int(np.floor(hits[k, 2]))
        if 0 <= x < state.shape[0] and 0 <= y < state.shape[1] and 0 <= z < state.shape[2]:
            state[x, y, z] = OCCUPIED


@njit(cache=True)
def _gains(state, eyes, directions, reach, rear_side, found):
    for k in range(len(eyes)):
        for d in range(len(directions)):
            found[k, d] = _gain(state, eyes[k], directions[d], reach, rear_side)


@njit(cache=True)
def _gain(state, eye, direction, reach, rear_side):
    x, y, z = int(np.floor(eye[0])), int(np.floor(eye[1])), int(np.floor(eye[2]))
    step_x, next_x, width_x = _first_border(eye[0], direction[0])
    step_y, next_y, width_y = _first_border(eye[1], direction[1])
    step_z, next_z, width_z = _first_border(eye[2], direction[2])
    length, gain, clear, before = 0.0, 0.0, 1.0, FREE
    while length <= reach and clear > 0.01:
        if not (0 <= x < state.shape[0] and 0 <= y < state.shape[1] and 0 <= z < state.shape[2]):
            break
        now = state[x, y, z]
        if now == OCCUPIED:
            if before == UNKNOWN:
                gain += clear * rear_side
            break
        if now == UNKNOWN:
            gain += clear
            clear *= _CLEAR
        before = now
        if next_x <= next_y and next_x <= next_z:
            length, x, next_x = next_x, x + step_x, next_x + width_x
        elif next_y <= next_z:
            length, y, next_y = next_y, y + step_y, next_y + width_y
        else:
            length, z, next_z = next_z, z + step_z, next_z + width_z
    return gain
