"""Least and mean depth of every view from a place, computed from one panorama of distances around it.

A panorama holds the inverse distance along directions on a regular grid of azimuth and elevation. Inverse distance is
close to linear over the image of a plane, so values between the directions are interpolated bilinearly, and so are the
statistics between places, yaws and pitches.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from avp_habitat.compiled import njit
from avp_habitat.poses import Intrinsics, camera_to_world
from avp_habitat.simulators.base import SingleRays

Float = NDArray[np.floating]

STEP_DEG = 2.5
"""Angle between neighbouring directions of a panorama, and half of that between neighbouring yaws of the statistics."""
AZIMUTHS = round(360 / STEP_DEG)
ELEVATIONS = round(180 / STEP_DEG) + 1
YAWS = AZIMUTHS // 2
"""Of the statistics, beginning with yaw 0."""
PITCH_STEP_DEG = 10.0
"""Between neighbouring pitches of the statistics."""
_COLUMNS, _ROWS = 20, 15


@dataclass(frozen=True)
class Samples:
    """Where the samples of a view lie in a panorama; every array is `(pitches, samples)`."""

    azimuth: NDArray[np.float64]
    """Position along the azimuths for yaw 0, in steps, within [0, AZIMUTHS)."""
    elevation: NDArray[np.float64]
    """Position along the elevations, in steps, within [0, ELEVATIONS - 1]."""
    cosine: NDArray[np.float64]
    """Planar depth over distance."""
    inner: int
    """The first so many samples fill the image evenly and give the mean; the others, on its border, only the least."""


def look_around(simulator: SingleRays, eye: Float) -> Float:
    """`(k, AZIMUTHS, ELEVATIONS)` metres from `(k, 3)` places, inf where nothing is hit.

    Azimuth 0 is yaw 0, left is positive; the elevations go from straight down to straight up.
    """
    azimuth = np.radians(STEP_DEG) * np.arange(AZIMUTHS)[:, None]
    elevation = np.radians(STEP_DEG) * np.arange(ELEVATIONS)[None] - np.pi / 2
    flat = np.cos(elevation)
    parts = (-np.sin(azimuth) * flat, np.sin(elevation) + 0 * azimuth, -np.cos(azimuth) * flat)
    ways = np.stack(np.broadcast_arrays(*parts), axis=-1).reshape(-1, 3).astype(np.float32)
    eyes = np.repeat(eye.astype(np.float32), len(ways), axis=0)
    distance = simulator.distance(eyes, np.tile(ways, (len(eye), 1)))
    return distance.reshape(len(eye), AZIMUTHS, ELEVATIONS)


@lru_cache(maxsize=4)
def view_samples(intrinsics: Intrinsics, pitches: tuple[float, ...]) -> Samples:
    """The samples of views with the given pitches in radians, in a depth image with the given intrinsics."""
    width, height = intrinsics.width, intrinsics.height
    columns, rows = (np.arange(_COLUMNS) + 0.5) / _COLUMNS * width, (np.arange(_ROWS) + 0.5) / _ROWS * height
    # The least depth often lies on the border (the floor at the lower one), so the outermost pixels are sampled too.
    left, lower = np.array([0.5, width - 0.5]), np.array([0.5, height - 0.5])
    grids = [np.meshgrid(columns, rows), np.meshgrid(columns, lower), np.meshgrid(left, rows), np.meshgrid(left, lower)]
    u, v = (np.concatenate([grid[axis].ravel() for grid in grids]) for axis in (0, 1))
    local = np.stack([(u - intrinsics.cx) / intrinsics.fx, -(v - intrinsics.cy) / intrinsics.fy, -np.ones_like(u)], 1)
    length = np.linalg.norm(local, axis=1)
    rotation = camera_to_world(np.zeros((len(pitches), 3)), yaw=np.zeros(len(pitches)), pitch=np.array(pitches))
    world = np.einsum("pij,sj->psi", rotation[:, :3, :3], local / length[:, None])
    azimuth = np.degrees(np.arctan2(-world[..., 0], -world[..., 2])) / STEP_DEG % AZIMUTHS
    elevation = (np.degrees(np.arcsin(np.clip(world[..., 1], -1, 1))) + 90) / STEP_DEG
    return Samples(azimuth, elevation, np.broadcast_to(1 / length, azimuth.shape).copy(), _COLUMNS * _ROWS)


def view_statistics(distance: Float, samples: Samples, max_range_m: float) -> NDArray[np.uint16]:
    """Least and mean planar depth of the views from k points, for all yaws and pitches.

    Args:
        distance: `(k, AZIMUTHS, ELEVATIONS)` as `look_around` gives it.
        samples: of the views.
        max_range_m: what the whole range of the numbers stands for; larger depths count as this.

    Returns:
        `(k, YAWS, pitches, 2)` as shares of the range, in units of 1 / 65535.
    """
    inverse = (1.0 / np.maximum(distance, 1e-3)).astype(np.float32)
    # Yaws are two azimuths apart: even and odd azimuths by themselves, twice around, so that the values of one sample
    # for all yaws lie side by side.
    halves = np.stack([inverse[:, 0::2], inverse[:, 1::2]], axis=1).swapaxes(2, 3)
    result = np.empty((len(distance), YAWS, len(samples.azimuth), 2), np.uint16)
    twice = np.concatenate([halves, halves], axis=3)
    _statistics(twice, samples.azimuth, samples.elevation, samples.cosine, samples.inner, max_range_m, result)
    return result


@njit(cache=True, fastmath=True)
def _statistics(twice, azimuth, elevation, cosine, inner, max_range_m, result):
    """`view_statistics` of `(k, 2, ELEVATIONS, 2 * YAWS)` inverse distances, by the azimuth's last bit."""
    elevations, yaws, pitches = twice.shape[2], result.shape[1], result.shape[2]
    total, greatest = np.empty(yaws, np.float32), np.empty(yaws, np.float32)
    for pitch in range(pitches):
        a0 = np.floor(azimuth[pitch]).astype(np.int64)
        e0 = np.minimum(np.floor(elevation[pitch]).astype(np.int64), elevations - 2)
        wa = (azimuth[pitch] - a0).astype(np.float32)
        we = (elevation[pitch] - e0).astype(np.float32)
        scale = (max_range_m / cosine[pitch]).astype(np.float32)
        for k in range(len(twice)):
            total[:], greatest[:] = 0, 1
            for s in range(a0.size):
                a, b, e = a0[s], a0[s] + 1, e0[s]
                low, high = twice[k, a & 1, e, a // 2 :], twice[k, a & 1, e + 1, a // 2 :]
                low_after, high_after = twice[k, b & 1, e, b // 2 :], twice[k, b & 1, e + 1, b // 2 :]
                up, across, full = we[s], wa[s], scale[s]
                share = np.float32(1 if s < inner else 0)
                for yaw in range(yaws):
                    near = low[yaw] + up * (high[yaw] - low[yaw])
                    far = low_after[yaw] + up * (high_after[yaw] - low_after[yaw])
                    # Inverse depth in units of 1 / range, at least 1: a depth beyond the range counts as the range.
                    value = (near + across * (far - near)) * full
                    value = value if value > np.float32(1) else np.float32(1)
                    greatest[yaw] = value if value > greatest[yaw] else greatest[yaw]
                    total[yaw] += share / value
            for yaw in range(yaws):
                result[k, yaw, pitch, 0] = np.uint16(65535 / greatest[yaw] + 0.5)
                result[k, yaw, pitch, 1] = np.uint16(65535 * total[yaw] / inner + 0.5)


@njit(cache=True)
def interpolate(statistics, slots, weights, yaw, pitch):
    """Least and mean depth of views, `(k,)` each, as shares of the range, between places, yaws and pitches.

    Args:
        statistics: `(slots, yaws, pitches, 2)` of `view_statistics`.
        slots: `(k, 4)` places around each agent.
        weights: `(k, 4)` of those places.
        yaw: `(k,)` in steps of the table, from 0.
        pitch: `(k,)` in steps of the table from its lowest pitch.
    """
    least, mean = np.empty(len(slots)), np.empty(len(slots))
    yaws, pitches = statistics.shape[1:3]
    for k in range(len(slots)):
        y0 = int(np.floor(yaw[k]))
        # The last pitch lies on the table's border: the entry beyond it has no weight and is not read.
        p0 = min(max(int(np.floor(pitch[k])), 0), max(pitches - 2, 0))
        wy, wp = yaw[k] - y0, pitch[k] - p0
        low, average = 0.0, 0.0
        for entry in range(16):
            corner, turn, tilt = entry // 4, entry // 2 % 2, entry % 2
            share = weights[k, corner] * (wy if turn else 1 - wy) * (wp if tilt else 1 - wp)
            if share != 0:
                at = statistics[slots[k, corner], (y0 + turn) % yaws, p0 + tilt]
                low += share * at[0]
                average += share * at[1]
        least[k], mean[k] = low / 65535, average / 65535
    return least, mean
