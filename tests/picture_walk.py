"""A short walk through a built-in room, its features matched once for all tests of the pose checks by pictures."""

import numpy as np

from avp_habitat.poses import Intrinsics, camera_to_world, heading
from avp_habitat.rollout.format import read_rollout
from avp_habitat.rollout.writing import RolloutWriter
from avp_habitat.simulators.registry import make_simulator

CAMERA = Intrinsics.from_hfov(320, 240, hfov_deg=90)
YAW = -1.182
# Steps forward, turns and tilts, some of them on the spot.
STEPS = [0, 1, 1, 1, 2, 3, 4, 4, 5, 6, 7, 8, 9, 10]
YAW_DEG = [0, 0, 10, 20, 20, 10, 0, -10, -20, -20, -10, 0, 10, 10]
PITCH_DEG = [0, 0, 0, -10, -20, -20, -10, 0, 10, 10, 0, 0, -10, -10]


def walk_poses():
    start, forward = np.array([0.252, 1.5, 2.085]), heading(np.array([YAW]))[0]
    positions = start + 0.25 * np.array(STEPS)[:, None] * forward
    return camera_to_world(positions, yaw=YAW + np.radians(YAW_DEG), pitch=np.radians(PITCH_DEG))


def write_walk(folder):
    simulator = make_simulator("raycast", "builtin:0")
    with RolloutWriter(folder, CAMERA) as writer:
        for pose in walk_poses():
            frames = simulator.render(pose[None], CAMERA, rgb=True)
            writer.add_frame(frames.rgb[0], frames.depth[0], pose)
        writer.publish({"scene": {"name": "builtin:0"}})
    simulator.close()
    return read_rollout(folder)
