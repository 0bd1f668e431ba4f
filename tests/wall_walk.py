"""A camera before one flat wall, most of it covered with a repeating tile: pictures that show little."""

import numpy as np

from avp_habitat.poses import Intrinsics, camera_to_world, pixel_directions
from avp_habitat.rollout.format import read_rollout
from avp_habitat.rollout.writing import RolloutWriter

CAMERA = Intrinsics.from_hfov(320, 240, hfov_deg=90)
DISTANCE_M, FARTHEST_M = 2.5, 8.0
TURNING = camera_to_world(
    np.tile([0.0, 1.5, 0.0], (12, 1)), yaw=np.radians(np.linspace(-40, 40, 12)), pitch=np.zeros(12)
)
"""On the spot."""
WALKING = camera_to_world(
    np.array([[0.0, 1.5, 0.0]] * 4 + [[0.05 * i, 1.5, -0.25 * min(i, 4)] for i in range(1, 9)]),
    yaw=np.radians([-30, -20, -10, 0, 0, 0, 0, 0, -10, -20, -30, -40]),
    pitch=np.zeros(12),
)
"""First turns, then steps towards the wall and along it."""


def _noise(side, seed, width):
    """`(side, side)` blurred noise in 0 to 1 that goes on at its borders."""
    wave = np.fft.fftfreq(side)
    kept = np.exp(-2 * (np.pi * width) ** 2 * (wave[:, None] ** 2 + wave**2))
    blurred = np.fft.ifft2(np.fft.fft2(np.random.default_rng(seed).normal(size=(side, side))) * kept).real
    return (blurred - blurred.min()) / np.ptp(blurred)


def _look_up(texture, x, y, period_m):
    side = len(texture)
    column, row = x / period_m * side, y / period_m * side
    i, j = np.floor(column).astype(int), np.floor(row).astype(int)
    right, down = column - i, row - j
    corner = [[texture[(i + a) % side, (j + b) % side] for b in (0, 1)] for a in (0, 1)]
    return (corner[0][0] * (1 - right) + corner[1][0] * right) * (1 - down) + (
        corner[0][1] * (1 - right) + corner[1][1] * right
    ) * down


def write_wall(folder, poses, *, tile_m=0.4, tiled=0.3):
    """Write the views of some poses; from left to right more of the wall is tiled, `tiled` of it at x = 0."""
    tile, unique = _noise(64, 1, 2.0), _noise(1024, 2, 4.0)
    local = pixel_directions(CAMERA).reshape(-1, 3)
    with RolloutWriter(folder, CAMERA) as writer:
        for pose in poses:
            rays = local @ pose[:3, :3].T
            away = np.where(rays[:, 2] < -1e-6, (-DISTANCE_M - pose[2, 3]) / np.minimum(rays[:, 2], -1e-6), FARTHEST_M)
            depth = np.minimum(away, FARTHEST_M)
            x, y, _ = (pose[:3, 3] + rays * depth[:, None]).T
            share = np.clip(x + tiled, 0, 1)
            grey = (1 - share) * _look_up(unique, x, y, 8.0) + share * _look_up(tile, x, y, tile_m)
            grey = np.where(away < FARTHEST_M, grey, 0.5).reshape(CAMERA.height, CAMERA.width, 1)
            writer.add_frame(
                np.repeat((255 * grey).astype(np.uint8), 3, axis=2), depth.reshape(CAMERA.height, CAMERA.width), pose
            )
        writer.publish({"scene": {"name": "wall"}})
    return read_rollout(folder)
