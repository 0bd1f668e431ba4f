"""The task for n agents at a time: actions, views, coverage, rewards and the ends of episodes, over arrays.

`AVPEnv` is n = 1, the batched vector environment is n > 1; this is the only place where the task's maths is put
together. Every step of an agent captures one view, also a step that does not move it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from avp_habitat import metrics, poses
from avp_habitat.agent_view import AgentView
from avp_habitat.coverage import candidates
from avp_habitat.coverage_over import cells_passed_over
from avp_habitat.observation import depth_statistics, observation
from avp_habitat.rewards import PARTS, StepFacts, has_stop, reward_parts, stops_episode
from avp_habitat.settings import LOOK_DOWN, LOOK_UP, MOVE_FORWARD, STOP, TURN_LEFT, TURN_RIGHT, TaskSettings
from avp_habitat.simulators.base import Simulator
from avp_habitat.trajectory import Trajectory

Float = NDArray[np.floating]
_PART_COLUMNS = tuple(f"part {name}" for name in PARTS)


@dataclass(frozen=True)
class StepOutcome:
    """What one step of n agents gave; every array's first axis is n."""

    observation: NDArray[np.float32]
    """`(n, 12)`."""
    reward: NDArray[np.float64]
    """`(n,)` sum of the parts."""
    parts: dict[str, NDArray[np.float64]]
    """`(n,)` each named part of the reward."""
    terminated: NDArray[np.bool_]
    """`(n,)` stop was chosen with enough coverage."""
    truncated: NDArray[np.bool_]
    """`(n,)` the budget ran out without such a stop."""
    facts: StepFacts
    """What the reward was computed from."""


class ViewpointTask:
    """The state of n agents in one scene."""

    def __init__(self, simulator: Simulator, settings: TaskSettings, agents: int) -> None:
        """Make room for n agents; `reset` places them.

        Args:
            simulator: renders and knows the navigable area; never named further.
            settings: of the task.
            agents: n, at least 1.
        """
        self.simulator = simulator
        self.settings = settings
        self.agents = agents
        area, budget = simulator.area, settings.budget
        self._cells = len(area.centres)
        self._intrinsics = settings.intrinsics
        self.steps = np.zeros(agents, dtype=np.int64)
        self.position = np.zeros((agents, 3))
        self.yaw = np.zeros(agents)
        self.pitch = np.zeros(agents)
        self.first_seen = np.zeros((agents, self._cells), dtype=np.int16)
        self.centre_depth = np.zeros(agents)
        """`(n,)` planar depth in metres in the middle of the newest view, the whole range where nothing was hit."""
        self._collided = np.zeros(agents, dtype=np.bool_)
        # Row 0 is the start, row t the state after step t.
        self._path = np.zeros((agents, budget + 1, 3))
        self._angles = np.zeros((agents, budget + 1, 2))
        self._log = {
            name: np.zeros((agents, budget))
            for name in ("action", "reward", "coverage", "collided", "redundant", *_PART_COLUMNS)
        }
        self._cell_index = np.full(area.mask.shape, -1, dtype=np.int64)
        self._cell_index[area.mask] = np.arange(self._cells)

    @property
    def coverage(self) -> NDArray[np.float64]:
        """`(n,)` C of the running episodes (Eq. 17)."""
        return np.count_nonzero(self.first_seen, axis=1) / self._cells

    @property
    def camera_to_world(self) -> NDArray[np.float64]:
        """`(n, 4, 4)` the sensors' poses now, habitat axes."""
        return self._sensor_poses(self.position, self.yaw, self.pitch)

    def reset(self, rows: Sequence[int] | NDArray[np.integer], position: Float, yaw: Float) -> NDArray[np.float32]:
        """Start new episodes of some agents, looking straight ahead.

        Args:
            rows: which agents.
            position: `(len(rows), 3)` their feet, metres.
            yaw: `(len(rows),)` radians.

        Returns:
            `(len(rows), 12)` first observations; their views are not captured and observe nothing.
        """
        rows = np.asarray(rows, dtype=np.int64)
        self.position[rows], self.yaw[rows], self.pitch[rows] = position, poses.wrap_angle(yaw), 0.0
        self.steps[rows], self.first_seen[rows], self._collided[rows] = 0, 0, False
        self._path[rows, 0] = position
        self._angles[rows, 0] = np.stack([self.yaw[rows], self.pitch[rows]], axis=1)
        depth = self._look(self.camera_to_world[rows])
        self.centre_depth[rows] = self._centre(depth)
        return self._observe(rows, depth)

    def step(self, actions: NDArray[np.integer]) -> StepOutcome:
        """Advance every agent by one action and one captured view.

        Args:
            actions: `(n,)` numbers of `settings.ACTION_NAMES`.
        """
        actions = np.asarray(actions)
        everyone = np.arange(self.agents)
        self._collided = self._move(actions)
        self.steps += 1
        self._path[everyone, self.steps] = self.position
        self._angles[everyone, self.steps] = np.stack([self.yaw, self.pitch], axis=1)
        sensor = self.camera_to_world
        depth = self._look(sensor)
        self.centre_depth = self._centre(depth)
        new = self._new_cells(sensor, depth)
        self.first_seen[new] = np.broadcast_to(self.steps[:, None], new.shape)[new]
        facts = self._facts(actions, new)
        parts = reward_parts(self.settings.reward, facts, self.settings.constants)
        reward = np.sum([parts[name] for name in PARTS], axis=0)
        terminated = stops_episode(facts, self.settings.constants)
        self._record(actions, reward, parts, facts)
        return StepOutcome(
            observation=self._observe(everyone, depth),
            reward=reward,
            parts=parts,
            terminated=terminated,
            truncated=(self.steps >= self.settings.budget) & ~terminated,
            facts=facts,
        )

    def trajectory(self, row: int) -> Trajectory:
        """Copies of what one agent did so far in its episode."""
        steps = int(self.steps[row])
        log = {name: values[row, :steps].copy() for name, values in self._log.items()}
        position = self._path[row, 1 : steps + 1].copy()
        yaw, pitch = self._angles[row, 1 : steps + 1].T.copy()
        return Trajectory(
            start=self._path[row, 0].copy(),
            position=position,
            yaw=yaw,
            pitch=pitch,
            camera_to_world=self._sensor_poses(position, yaw, pitch),
            action=log["action"].astype(np.int64),
            reward=log["reward"],
            reward_parts={name: log[f"part {name}"] for name in PARTS},
            coverage=log["coverage"],
            collided=log["collided"].astype(np.bool_),
            redundant=log["redundant"].astype(np.bool_),
            first_seen=self.first_seen[row].copy(),
        )

    def agent_view(self, row: int) -> AgentView:
        """What planners may know about one agent."""
        return AgentView(
            settings=self.settings,
            simulator=self.simulator,
            position=self.position[row].copy(),
            yaw=float(self.yaw[row]),
            pitch=float(self.pitch[row]),
            steps=int(self.steps[row]),
            observed=self.first_seen[row] > 0,
            centre_depth=float(self.centre_depth[row]),
            collided=bool(self._collided[row]),
        )

    def _sensor_poses(self, position: Float, yaw: Float, pitch: Float) -> NDArray[np.float64]:
        raised = position + np.array([0.0, self.settings.sensor_height_m, 0.0])
        return poses.camera_to_world(raised, yaw=yaw, pitch=pitch)

    def _move(self, actions: NDArray[np.integer]) -> NDArray[np.bool_]:
        """Apply the actions; `(n,)` whether a forward move was blocked."""
        settings = self.settings
        turn, tilt = np.radians(settings.turn_deg), np.radians(settings.tilt_deg)
        limit = np.radians(settings.pitch_limit_deg)
        self.yaw = poses.wrap_angle(self.yaw + turn * ((actions == TURN_LEFT) * 1.0 - (actions == TURN_RIGHT)))
        pitch = self.pitch + tilt * ((actions == LOOK_UP) * 1.0 - (actions == LOOK_DOWN))
        self.pitch = np.clip(pitch, -limit, limit)
        walking = np.flatnonzero(actions == MOVE_FORWARD)
        collided = np.zeros(self.agents, dtype=np.bool_)
        if len(walking):
            before = self.position[walking]
            after = self.simulator.area.slide(before, poses.heading(self.yaw[walking]) * settings.forward_m)
            collided[walking] = np.linalg.norm((after - before)[:, [0, 2]], axis=1) < settings.collision_m
            self.position[walking] = after
        return collided

    def _look(self, sensor: Float) -> Float:
        return self.simulator.render(sensor, self._intrinsics, rgb=False).depth

    def _centre(self, depth: Float) -> Float:
        middle = depth[:, self.settings.height // 2, self.settings.width // 2]
        return np.where(middle > 0, middle, self.settings.max_range_m)

    def _new_cells(self, sensor: Float, depth: Float) -> NDArray[np.bool_]:
        """`(n, m)` navigable cells that the agents' newest views observe for the first time."""
        settings, area = self.settings, self.simulator.area
        unseen = self.first_seen == 0
        if settings.coverage_mode == "over":
            return unseen & cells_passed_over(
                sensor,
                self._intrinsics,
                depth,
                self._cell_index,
                area.origin,
                cell_m=area.cell_m,
                cells=self._cells,
                max_range_m=settings.max_range_m,
            )
        pairs = candidates(sensor, self._intrinsics, area.centres, unseen, max_range_m=settings.max_range_m)
        reached = self.simulator.visible(sensor, area.centres, pairs, tolerance_m=settings.tolerance_m)
        new = np.zeros_like(unseen)
        new[pairs[reached, 0], pairs[reached, 1]] = True
        return new

    def _facts(self, actions: NDArray[np.integer], new: NDArray[np.bool_]) -> StepFacts:
        return StepFacts(
            new_cells=new.sum(axis=1),
            earlier_visits=self._earlier_visits(),
            spread_m=self._spread(np.arange(self.agents)),
            collided=self._collided,
            redundant=self._redundant(),
            stop_chosen=(actions == STOP) & has_stop(self.settings.reward),
            coverage=self.coverage,
            steps_left=self.settings.budget - self.steps,
        )

    def _earlier(self) -> NDArray[np.bool_]:
        """`(n, T)` which of the steps 1 … T came before the newest one."""
        return np.arange(1, self.settings.budget + 1) < self.steps[:, None]

    def _earlier_visits(self) -> NDArray[np.int64]:
        """`(n,)` v: earlier views taken from the cell in which the agent now stands."""
        area = self.simulator.area
        visited = area.cell_of(self._path[:, 1:].reshape(-1, 3)).reshape(self.agents, -1, 2)
        same = (visited == area.cell_of(self.position)[:, None]).all(axis=-1)
        return np.count_nonzero(same & self._earlier(), axis=1)

    def _redundant(self) -> NDArray[np.bool_]:
        """`(n,)` whether an earlier view lies within d_red with both angles within δ."""
        constants = self.settings.constants
        near = np.linalg.norm(self._path[:, 1:] - self.position[:, None], axis=-1) < constants.redundancy_distance_m
        now = np.stack([self.yaw, self.pitch], axis=1)[:, None]
        turned = np.abs(poses.wrap_angle(self._angles[:, 1:] - now))
        alike = (turned < np.radians(constants.redundancy_angle_deg)).all(axis=-1)
        return (near & alike & self._earlier()).any(axis=1)

    def _spread(self, rows: NDArray[np.integer]) -> Float:
        """`(len(rows),)` ‖p − p̄‖ in metres on the floor plane, p̄ over the start and all steps so far."""
        visited = np.arange(self.settings.budget + 1) <= self.steps[rows, None]
        plane = self._path[rows][..., [0, 2]]
        mean = (plane * visited[..., None]).sum(axis=1) / visited.sum(axis=1, keepdims=True)
        return np.linalg.norm(self.position[rows][:, [0, 2]] - mean, axis=1)

    def _observe(self, rows: NDArray[np.integer], depth: Float) -> NDArray[np.float32]:
        radius = self.simulator.area.diameter_m
        least, mean = depth_statistics(depth, self.settings.max_range_m)
        return observation(
            progress=self.steps[rows] / self.settings.budget,
            offset=(self.position[rows] - self._path[rows, 0])[:, [0, 2]] / radius,
            yaw=self.yaw[rows],
            pitch=self.pitch[rows],
            min_depth=least,
            mean_depth=mean,
            coverage=self.coverage[rows],
            collided=self._collided[rows],
            spread=self._spread(rows) / radius,
        )

    def _record(
        self, actions: NDArray[np.integer], reward: Float, parts: dict[str, NDArray[np.float64]], facts: StepFacts
    ) -> None:
        columns = {
            "action": actions,
            "reward": reward,
            "coverage": facts.coverage,
            "collided": facts.collided,
            "redundant": facts.redundant,
            **{f"part {name}": values for name, values in parts.items()},
        }
        for name, values in columns.items():
            self._log[name][np.arange(self.agents), self.steps - 1] = values


def episode_metrics(trajectory: Trajectory, *, stopped: bool) -> dict[str, float]:
    """Figures of one finished episode, by the keys of `info["avp_episode"]`.

    Args:
        trajectory: of the whole episode.
        stopped: whether the agent ended it with enough coverage.

    Returns:
        coverage, views, annd_m, ei, path_length_m, collisions, redundant_views, stopped, and `return_PART` for each
        part of the reward.
    """
    views = len(trajectory.action)
    coverage = float(trajectory.coverage[-1]) if views else 0.0
    return {
        "coverage": coverage,
        "views": float(views),
        "annd_m": metrics.nearest_neighbour_distance(trajectory.camera_to_world[:, :3, 3]),
        "ei": metrics.efficiency_index(coverage, views),
        "path_length_m": metrics.path_length(trajectory.start, trajectory.position),
        "collisions": float(trajectory.collided.sum()),
        "redundant_views": float(trajectory.redundant.sum()),
        "stopped": float(stopped),
        **{f"return_{name}": float(values.sum()) for name, values in trajectory.reward_parts.items()},
    }
