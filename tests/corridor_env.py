"""A corridor of 20 cells in which an agent looks ahead: the info keys and methods of `AVP-v0` at a thousandth of the cost."""

from types import SimpleNamespace

import gymnasium
import numpy as np

from avp_habitat.metrics import efficiency_index, nearest_neighbour_distance, path_length
from avp_habitat.poses import camera_to_world
from avp_habitat.trajectory import Trajectory

CELLS = 20


class CorridorEnv(gymnasium.Env):
    scene_name, scene_digest = "corridor", "0" * 64

    def __init__(self, budget=8):
        self.observation_space = gymnasium.spaces.Box(-1, 1, (3,), np.float32)
        self.action_space = gymnasium.spaces.Discrete(3)
        self.budget = budget
        x = np.arange(CELLS) * 0.1 + 0.05
        centres = np.stack([x, np.zeros(CELLS), np.full(CELLS, 0.05)], axis=-1)
        mask = np.ones((1, CELLS), dtype=bool)
        self.area = SimpleNamespace(cell_m=0.1, origin=np.zeros(2), mask=mask, centres=centres)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.cells, self.actions, self.first_seen = [0], [], np.zeros(CELLS, dtype=np.int16)
        return self.observe(), {}

    def step(self, action):
        self.actions.append(int(action))
        self.cells.append(int(np.clip(self.cells[-1] + (action == 0) - (action == 1), 0, CELLS - 1)))
        seen = self.first_seen[self.cells[-1] : self.cells[-1] + 3]
        new = int((seen == 0).sum())
        seen[seen == 0] = len(self.actions)
        stopped, late = bool(action == 2), len(self.actions) >= self.budget
        info = {} if not (stopped or late) else self.summary(stopped)
        return self.observe(), new - 0.5, stopped, late and not stopped, info

    def observe(self):
        return np.array([self.cells[-1] / CELLS, len(self.actions) / self.budget, 0], dtype=np.float32)

    def summary(self, stopped):
        t = len(self.actions)
        position = self.area.centres[self.cells[1:]]
        parts = {"coverage": np.array([(self.first_seen == i + 1).sum() for i in range(t)]), "step": np.full(t, -0.5)}
        coverage = np.cumsum(parts["coverage"]) / CELLS
        collided = np.diff(self.cells) == 0
        pose = camera_to_world(position + [0, 1.5, 0], yaw=np.full(t, -np.pi / 2), pitch=np.full(t, -0.3))
        trajectory = Trajectory(
            start=self.area.centres[0], position=position, yaw=np.full(t, -np.pi / 2), pitch=np.full(t, -0.3),
            camera_to_world=pose, action=np.array(self.actions), reward=sum(parts.values()), reward_parts=parts,
            coverage=coverage, collided=collided, redundant=collided, first_seen=self.first_seen.copy(),
        )  # fmt: skip
        episode = {
            "coverage": float(coverage[-1]), "views": float(t), "annd_m": nearest_neighbour_distance(position),
            "ei": efficiency_index(coverage[-1], t), "path_length_m": path_length(trajectory.start, position),
            "collisions": float(collided.sum()), "redundant_views": float(collided.sum()), "stopped": float(stopped),
            **{f"return_{name}": float(values.sum()) for name, values in parts.items()},
        }  # fmt: skip
        return {"avp_episode": episode, "avp_trajectory": trajectory}

    def capture(self, camera_to_world, intrinsics):
        shape = (len(camera_to_world), intrinsics.height, intrinsics.width)
        depth = np.broadcast_to(camera_to_world[:, 0, 3, None, None] + 1, shape).astype(np.float32)
        rgb = np.zeros((*shape, 3), np.uint8)
        rgb[:, : intrinsics.height // 2, :, 0] = 200
        return SimpleNamespace(rgb=rgb, depth=depth)
