"""`AVP-v0`: the task for one agent as a Gymnasium environment."""

import os
from dataclasses import replace
from operator import itemgetter
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from avp_habitat.errors import UsageError, unknown_name
from avp_habitat.poses import Intrinsics
from avp_habitat.simulators.base import Frames, Simulator, pictures
from avp_habitat.simulators.registry import SimulatorChoice, open_simulator
from avp_habitat.task.agent_view import AgentView
from avp_habitat.task.observations import Observed, action_space, each
from avp_habitat.task.settings import ACTION_NAMES, TaskSettings
from avp_habitat.task.task import StepOutcome, ViewpointTask
from avp_habitat.task.trajectory import episode_metrics

RENDER_MODES = ("rgb_array",)
_OPTIONS = ("scene", "simulator", "gpu", "navmesh", "up", *TaskSettings.__dataclass_fields__)
_PICTURE = (480, 360)


class AVPEnv(gymnasium.Env[Observed, np.int64]):
    """An agent that walks through a scene and decides which views to take.

    Observations are of the kind `TaskSettings.observation`, actions the six of `settings.ACTION_NAMES`. `info` of every
    step holds `coverage`, `new_cells`, `views`, `collided`, `redundant` and `reward_parts`; the last step of an episode
    adds `avp_episode` (figures, see `trajectory.episode_metrics`), `avp_trajectory` and `is_success`.
    """

    metadata = {"render_modes": list(RENDER_MODES), "render_fps": 4}  # noqa: RUF012 - gymnasium's own declaration

    def __init__(
        self,
        scene: str | Path = "builtin:0",
        *,
        simulator: str | Simulator = "raycast",
        gpu: int | None = None,
        navmesh: str | Path | None = None,
        up: str | None = None,
        render_mode: str | None = None,
        settings: TaskSettings | None = None,
        **overrides: Any,
    ) -> None:
        """Open a scene.

        Args:
            scene: as `avp_habitat.scenes.location.locate` takes it.
            simulator: `raycast`, `habitat`, `module:factory`, another distribution's, or one that is open already (the
                scene's name is then its own).
            gpu: the CUDA device of `habitat`; -1 for none, None for the first one there is.
            navmesh: file of the scene's NavMesh; computed when omitted.
            up: axis of mesh files that points up, `y` or `z`; of each file what is known of it when omitted.
            render_mode: None, or `rgb_array`: the camera's picture beside the top-down map.
            settings: of the task; the design's defaults when omitted.
            **overrides: single fields of `TaskSettings`, for example `reward="coverage"`, `budget=60`,
                `observation="my_module:MyObservation"`.

        Raises:
            UsageError: an unknown name or a value that cannot be right.
            SceneError: the scene cannot be used.
            SimulatorError: the simulator cannot run here.
        """
        if render_mode is not None and render_mode not in RENDER_MODES:
            raise unknown_name("render_mode", render_mode, RENDER_MODES)
        for name in overrides.keys() - TaskSettings.__dataclass_fields__:
            raise unknown_name("AVP-v0 option", name, _OPTIONS)
        self.settings = replace(settings or TaskSettings(), **overrides)
        self.choice = SimulatorChoice.by_name(simulator, gpu=gpu, navmesh=navmesh, up=up)
        """How the simulator was chosen; None for one that was open already."""
        self.render_mode = render_mode
        self.action_space = action_space()
        self._enter(scene, simulator)
        self.observation_space = self._task.kind.space

    def change_scene(self, scene: str | Path) -> None:
        """Leave the scene for another one in the same kind of simulator; `reset` starts there.

        Raises:
            UsageError: the simulator was given open, or its NavMesh is that of the present scene.
            AVPError: as for a new environment.
        """
        if self.choice is None:
            raise UsageError("change_scene: expected a simulator chosen by name, got one that was open already")
        if self.choice.navmesh is not None:
            raise UsageError(f"change_scene: {self.choice.navmesh} is the NavMesh of {self.scene_name}; leave it out")
        # Freed before the next one is opened: a process can hold a single simulator of some kinds.
        del self.simulator, self.area, self._task
        self._enter(scene, self.choice.simulator)

    @property
    def scene_name(self) -> str:
        """What the user called the scene, without folders."""
        return self.simulator.scene

    @property
    def scene_digest(self) -> str:
        """Hexadecimal SHA-256 of the scene's content."""
        return self.simulator.scene_digest

    @property
    def centre_depth(self) -> float:
        """Planar depth in metres in the middle of the newest view."""
        return self._task.centre_depth(0)

    @property
    def camera_to_world(self) -> NDArray[np.float64]:
        """`(4, 4)` the sensor's pose now, habitat axes."""
        return self._task.camera_to_world[0]

    @property
    def agent_pose(self) -> tuple[NDArray[np.float64], float, float]:
        """The agent's feet, `(3,)` metres, and its yaw and pitch in radians."""
        task = self._task
        return task.position[0].copy(), float(task.yaw[0]), float(task.pitch[0])

    @property
    def agent_view(self) -> AgentView:
        """What planners may know about the agent."""
        return self._task.agent_view(0)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observed, dict[str, Any]]:
        """Start an episode at a random navigable point and heading.

        The options `position` (x, z or x, y, z in metres) and `yaw` (radians) place the agent instead.

        Raises:
            UsageError: the given position is not navigable.
        """
        super().reset(seed=seed)
        options = options or {}
        position = self.area.random_points(self.np_random, 1)
        yaw = self.np_random.uniform(-np.pi, np.pi, size=1)
        if options.get("position") is not None:
            position = self._place(np.asarray(options["position"], dtype=np.float64))
        if options.get("yaw") is not None:
            yaw = np.array([float(options["yaw"])])
        observation = self._task.reset([0], position, yaw)
        self._running = True
        return each(itemgetter(0), observation), {"coverage": 0.0, "views": 0}

    def step(self, action: np.int64 | int) -> tuple[Observed, float, bool, bool, dict[str, Any]]:
        """Do one action and capture one view.

        Raises:
            UsageError: the action is not one of the six.
            gymnasium.error.ResetNeeded: the episode has ended, or none was started.
        """
        if not self._running:
            raise gymnasium.error.ResetNeeded("AVP-v0: call reset() before step(): no episode is running")
        if not self.action_space.contains(np.int64(action)):
            raise UsageError(f"action: expected 0 to {len(ACTION_NAMES) - 1}, got {action!r}")
        outcome = self._task.step(np.array([action]))
        info = step_info(self._task, outcome)[0]
        terminated, truncated = bool(outcome.terminated[0]), bool(outcome.truncated[0])
        self._running = not (terminated or truncated)
        return each(itemgetter(0), outcome.observation), float(outcome.reward[0]), terminated, truncated, info

    def render(self) -> NDArray[np.uint8] | None:  # type: ignore[override]
        """The camera's picture beside the top-down map, `(h, w, 3)`; None without a render mode."""
        if self.render_mode is None:
            return None
        from avp_habitat.rollout.drawing import beside, draw_trajectory

        camera = Intrinsics.from_hfov(*_PICTURE, hfov_deg=self.settings.hfov_deg)
        picture = self.capture(self._task.camera_to_world, camera).rgb
        assert picture is not None
        return beside(picture[0], draw_trajectory(self.area, self._task.trajectory(0)))

    def capture(self, camera_to_world: NDArray[np.floating], intrinsics: Intrinsics) -> Frames:
        """Pictures and depth of `(n, 4, 4)` habitat poses, without any effect on the episode."""
        return pictures(self.simulator, camera_to_world, intrinsics)

    def close(self) -> None:
        """End the episode; the simulator is shared and goes with its last user."""
        self._running = False

    def _enter(self, scene: str | Path, simulator: str | Simulator) -> None:
        if self.choice is not None:
            simulator = open_simulator(self.choice, scene)
        assert not isinstance(simulator, str)
        self.scene = os.fspath(scene)
        """As given."""
        self.simulator = simulator
        self.area = simulator.area
        self._task = ViewpointTask(simulator, self.settings, agents=1)
        self._running = False

    def _place(self, position: NDArray[np.float64]) -> NDArray[np.float64]:
        if position.shape not in ((2,), (3,)) or not np.isfinite(position).all():
            raise UsageError(f"position: expected x, z or x, y, z in metres, got {position.tolist()}")
        point = np.array([[position[0], 0.0, position[-1]]])
        if not self.area.contains(point)[0]:
            raise UsageError(f"position: {position.tolist()} is not navigable in {self.scene_name}")
        point[:, 1] = self.area.floor_height(point)
        return point


def step_info(task: ViewpointTask, outcome: StepOutcome) -> list[dict[str, Any]]:
    """`info` of all agents' steps; those whose episode ends there get its figures and trajectory."""
    facts = outcome.facts
    names = tuple(outcome.parts)
    # Whole columns become Python numbers at once: this is done for every step of every agent.
    columns = (facts.coverage, facts.new_cells, task.steps, facts.collided, facts.redundant)
    parts = np.stack(list(outcome.parts.values()), axis=1).tolist()
    infos: list[dict[str, Any]] = [
        {
            "coverage": coverage,
            "new_cells": new_cells,
            "views": views,
            "collided": collided,
            "redundant": redundant,
            "reward_parts": dict(zip(names, values, strict=True)),
        }
        for coverage, new_cells, views, collided, redundant, values in zip(
            *(column.tolist() for column in columns), parts, strict=True
        )
    ]
    for row in np.flatnonzero(outcome.terminated | outcome.truncated):
        stopped = bool(outcome.terminated[row])
        trajectory = task.trajectory(int(row))
        infos[row]["avp_episode"] = episode_metrics(trajectory, stopped=stopped, further=task.settings.metrics)
        infos[row]["avp_trajectory"] = trajectory
        infos[row]["is_success"] = stopped
    return infos
