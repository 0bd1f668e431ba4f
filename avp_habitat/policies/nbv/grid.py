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
_BELOW_M, _ABOVE_M, _FARTHEST_M = 1.0, 4.0, 16.0
"""The grid holds so much below and above an agent's feet, and at least its range to all sides, but not more than this;
metres."""
_GROWTH = 40
"""It grows by so many voxels at a time."""
_CLEAR = 0.5
"""Probability that a ray passes an unknown voxel."""


class OccupancyGrid:
    """What depth images have shown, in voxels; what lies beyond the grid is taken as known."""

    def __init__(self, feet: Float, range_m: float) -> None:
        """Know nothing around `(3,)` metres."""
        self.corner = np.floor(np.asarray(feet, np.float64) / VOXEL_M) * VOXEL_M
        """`(3,)` least corner, metres."""
        self.state = np.zeros((1, 1, 1), np.uint8)
        """`(x, y, z)` UNKNOWN, FREE or OCCUPIED."""
        self.cover(feet, range_m)

    def cover(self, feet: Float, range_m: float) -> None:
        """Grow until the surroundings of `(3,)` feet lie in the grid."""
        far = min(range_m, _FARTHEST_M)
        least, most = feet - np.array([far, _BELOW_M, far]), feet + np.array([far, _ABOVE_M, far])
        lacking = np.stack([self.corner - least, most - self.corner - np.array(self.state.shape) * VOXEL_M], axis=1)
        further = np.ceil(np.maximum(lacking, 0) / VOXEL_M / _GROWTH).astype(int) * _GROWTH
        if further.any():
            self.state = np.pad(self.state, further)
            self.corner = self.corner - further[:, 0] * VOXEL_M

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
def _axis(at, direction):
    """Along one axis: the step from voxel to voxel, the length to the first border, and that between borders."""
    if direction > 0:
        return 1, (np.floor(at) + 1.0 - at) / direction, 1.0 / direction
    if direction < 0:
        return -1, (at - np.floor(at)) / -direction, -1.0 / direction
    return 0, np.inf, np.inf


@njit(cache=True)
def _begin(eye, direction):
    """The voxel of an eye `(3,)`, in voxels, and the steps, borders and widths of `_axis` along a direction."""
    a, b, c = _axis(eye[0], direction[0]), _axis(eye[1], direction[1]), _axis(eye[2], direction[2])
    voxel = int(np.floor(eye[0])), int(np.floor(eye[1])), int(np.floor(eye[2]))
    return voxel, (a[0], b[0], c[0]), (a[1], b[1], c[1]), (a[2], b[2], c[2])


@njit(cache=True)
def _beyond(voxel, step, border, width):
    """The next voxel of a ray, its next borders, and the length at which it begins.

    From border to border (Amanatides and Woo, 1987, "A fast voxel traversal algorithm for ray tracing").
    """
    (x, y, z), (a, b, c) = voxel, border
    if a <= b and a <= c:
        return (x + step[0], y, z), (a + width[0], b, c), a
    if b <= c:
        return (x, y + step[1], z), (a, b + width[1], c), b
    return (x, y, z + step[2]), (a, b, c + width[2]), c


@njit(cache=True)
def _inside(state, voxel):
    x, y, z = voxel
    return 0 <= x < state.shape[0] and 0 <= y < state.shape[1] and 0 <= z < state.shape[2]


@njit(cache=True)
def _carve(state, eye, ends):
    """Free what lies between an eye `(3,)` and `(n, 3)` ends, in voxels, up to half a voxel before them."""
    for k in range(len(ends)):
        way = ends[k] - eye
        last = 1.0 - 0.5 / max(np.sqrt(way[0] * way[0] + way[1] * way[1] + way[2] * way[2]), 1e-9)
        voxel, step, border, width = _begin(eye, way)
        share = 0.0
        while share <= last and _inside(state, voxel):
            if state[voxel] == UNKNOWN:
                state[voxel] = FREE
            voxel, border, share = _beyond(voxel, step, border, width)


@njit(cache=True)
def _occupy(state, hits):
    for k in range(len(hits)):
        voxel = int(np.floor(hits[k, 0])), int(np.floor(hits[k, 1])), int(np.floor(hits[k, 2]))
        if _inside(state, voxel):
            state[voxel] = OCCUPIED


@njit(cache=True)
def _gains(state, eyes, directions, reach, rear_side, found):
    for k in range(len(eyes)):
        for d in range(len(directions)):
            found[k, d] = _gain(state, eyes[k], directions[d], reach, rear_side)


@njit(cache=True)
def _gain(state, eye, direction, reach, rear_side):
    voxel, step, border, width = _begin(eye, direction)
    length, gain, clear, before = 0.0, 0.0, 1.0, FREE
    while length <= reach and clear > 0.01 and _inside(state, voxel):
        now = state[voxel]
        if now == OCCUPIED:
            return gain + (clear * rear_side if before == UNKNOWN else 0.0)
        if now == UNKNOWN:
            gain += clear
            clear *= _CLEAR
        before = now
        voxel, border, length = _beyond(voxel, step, border, width)
    return gain
