"""A small room whose pictures are computed by formula, as rollouts for the tests of the nerfstudio plug-ins."""

import numpy as np

from avp_habitat.poses import Intrinsics, camera_to_world, pixel_directions
from avp_habitat.rollout.writing import RolloutWriter

# Walls, floor and ceiling at unlike distances, so that no two axes can be swapped unseen.
ROOM = np.array([[-1.5, 0.0, -2.5], [2.0, 2.4, 1.0]])


def off_centre_camera(width, height):
    """Fields of view and principal point that differ between x and y."""
    return Intrinsics(width, height, 0.52 * width, 0.8 * height, 0.45 * width, 0.55 * height)


def distance_to_walls(points):
    """Distance of `(n, 3)` points to the nearest wall, floor or ceiling, metres."""
    return np.abs(points[:, None] - ROOM).min(axis=(1, 2))


def picture(pose, intrinsics):
    """What a camera in the room sees: `(h, w, 3)` uint8 and `(h, w)` planar depth in metres."""
    directions = pixel_directions(intrinsics) @ pose[:3, :3].T
    with np.errstate(divide="ignore"):
        exits = ((ROOM[:, None, None] - pose[:3, 3]) / directions).max(axis=0)
    depth = exits.min(axis=-1)
    points = pose[:3, 3] + directions * depth[..., None]
    colour = (
        0.5 + 0.2 * np.sin(points * [2.0, 3.0, 1.5]) + 0.1 * np.array([1.0, 0.0, -1.0]) * exits.argmin(-1)[..., None]
    )
    return (np.clip(colour, 0, 1) * 255).astype(np.uint8), depth


def random_poses(count, seed):
    rng = np.random.default_rng(seed)
    positions = rng.uniform(ROOM[0] + 0.5, ROOM[1] - 0.5, (count, 3))
    return camera_to_world(positions, yaw=rng.uniform(-3, 3, count), pitch=rng.uniform(-0.5, 0.5, count))


def write_room(folder, *, width=32, height=24, frames=6, heldout=2):
    intrinsics = off_centre_camera(width, height)
    with RolloutWriter(folder, intrinsics) as writer:
        for pose in random_poses(frames, seed=1):
            writer.add_frame(*picture(pose, intrinsics), pose)
        for pose in random_poses(heldout, seed=2):
            writer.add_heldout(*picture(pose, intrinsics), pose)
        writer.publish({"scene": "a formula"})
    return folder
