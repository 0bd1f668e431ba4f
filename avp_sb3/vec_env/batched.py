"""Many agents in one or more scenes as one Stable-Baselines3 `VecEnv`: one task, and one call for all their views."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices

from avp_habitat.errors import UsageError
from avp_habitat.poses import Intrinsics
from avp_habitat.ranges import Range, number
from avp_habitat.simulators.base import Frames, Simulator, SingleRays, pictures
from avp_habitat.simulators.registry import SimulatorChoice, open_simulator
from avp_habitat.task.env import step_info
from avp_habitat.task.observations import Observed, action_space, each
from avp_habitat.task.settings import TaskSettings
from avp_habitat.task.task import ViewpointTask

Scenes = str | Path | Sequence[str | Path]
"""One, or several that agents take in turn."""


class AVPVecEnv(VecEnv):
    """n agents of `AVP-v0`; the same task, observations, rewards and `info` as n separate `AVPEnv`s.

    Wrap it in SB3's `VecMonitor` for the episode rewards and lengths that SB3 prints.
    """

    def __init__(
        self,
        scene: Scenes = "builtin:0",
        *,
        agents: int = 16,
        simulator: str | Simulator | Sequence[Simulator] = "raycast",
        gpu: int | None = None,
        navmesh: str | Path | None = None,
        up: str | None = None,
        settings: TaskSettings | None = None,
        seed: int | None = None,
    ) -> None:
        """Open the scenes for n agents.

        Args:
            scene: as `scenes.location.locate` takes it, or several; agent i walks in scene i modulo their number.
            agents: n, at least 1, and at least one for each scene.
            simulator: a simulator's name or factory, or those that are open already, one for each scene.
            gpu: the CUDA device of `habitat`; -1 for none, None for the first one there is.
            navmesh: file of the only scene's NavMesh; computed when omitted.
            up: axis of mesh files that points up, `y` or `z`; of each file what is known of it when omitted.
            settings: of the task; when omitted, the defaults, looked up where the simulator casts rays.
            seed: of the starts; agent i uses `seed + i`, as SB3 seeds separate environments.

        Raises:
            UsageError: too few agents, or an unknown name.
            SceneError: a scene cannot be used; the text names it.
            SimulatorError: the simulator cannot run here, or several scenes need a process each (`AVPSubprocVecEnv`).
        """
        self.simulators = _open(scene, simulator, gpu=gpu, navmesh=navmesh, up=up)
        casts = all(isinstance(opened, SingleRays) for opened in self.simulators)
        self.settings = settings or TaskSettings(lookup=casts)
        agents = number("agents", agents, int, Range(0, 1e12))
        if agents < len(self.simulators):
            raise UsageError(f"agents: expected at least {len(self.simulators)}, one for each scene, got {agents}")
        self.render_mode = None
        self._task = ViewpointTask(self.simulators, self.settings, agents)
        super().__init__(agents, self._task.kind.space, action_space())
        self._generators = [np.random.default_rng() for _ in range(agents)]
        self._actions = np.zeros(agents, dtype=np.int64)
        self.seed(seed)

    def capture(self, row: int, camera_to_world: NDArray[np.floating], intrinsics: Intrinsics) -> Frames:
        """Pictures and depth of `(k, 4, 4)` habitat poses in an agent's scene, without any effect on the episodes."""
        return pictures(self._task.simulator(row), camera_to_world, intrinsics)

    def reset(self) -> Observed:  # type: ignore[override]
        """Start all episodes at random; the first axis of what is observed is n."""
        for index, seed in enumerate(self._seeds):
            if seed is not None:
                self._generators[index] = np.random.default_rng(seed)
        self._reset_seeds()
        self._reset_options()
        self.reset_infos = [{"coverage": 0.0, "views": 0} for _ in range(self.num_envs)]
        return self._restart(range(self.num_envs))

    def seed_agents(self, seeds: Sequence[int | None]) -> None:
        """Seed the starts of the next `reset`, `(n,)`; None leaves an agent's generator as it is."""
        self._seeds = list(seeds)

    def step_async(self, actions: NDArray[np.integer]) -> None:
        """Remember the `(n,)` actions."""
        self._actions = np.asarray(actions)

    def step_wait(self) -> tuple[Observed, NDArray, NDArray, list[dict[str, Any]]]:  # type: ignore[override]
        """Step all agents; those whose episode ended start the next one, as SB3 expects."""
        outcome = self._task.step(self._actions)
        done = outcome.terminated | outcome.truncated
        infos = step_info(self._task, outcome)
        observation = outcome.observation
        ended = np.flatnonzero(done)
        for row in ended:
            infos[row]["terminal_observation"] = each(lambda values, row=row: values[row].copy(), observation)
            infos[row]["TimeLimit.truncated"] = bool(outcome.truncated[row])
        if len(ended):
            each(lambda values, first: values.__setitem__(ended, first), observation, self._restart(ended.tolist()))
        return observation, outcome.reward.astype(np.float32), done, infos

    def close(self) -> None:
        """Nothing to free: the simulators are shared and go with their last user."""

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """An attribute of the chosen agents, as separate `AVPEnv`s have it."""
        read = _OF_AGENT.get(attr_name, lambda *_: getattr(self, attr_name))
        return [read(self._task, row) for row in self._get_indices(indices)]

    def has_attr(self, attr_name: str) -> bool:
        """Whether `get_attr` knows the name."""
        return attr_name in _OF_AGENT or hasattr(self, attr_name)

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Refused: the agents share one task, whose settings are frozen."""
        raise UsageError(f"AVPVecEnv: {attr_name} cannot be set after it was made; give it as settings")

    def env_method(self, method_name: str, *args: Any, indices: VecEnvIndices = None, **kwargs: Any) -> list[Any]:
        """Call a method once for each chosen agent; `capture` looks into that agent's scene."""
        rows = self._get_indices(indices)
        if method_name == "capture":
            return [self.capture(row, *args, **kwargs) for row in rows]
        return [getattr(self, method_name)(*args, **kwargs) for _ in rows]

    def env_is_wrapped(self, wrapper_class: type[gymnasium.Wrapper], indices: VecEnvIndices = None) -> list[bool]:
        """No agent has a Gymnasium wrapper."""
        return [False for _ in self._get_indices(indices)]

    def _restart(self, rows: Sequence[int]) -> Observed:
        draws = [(self._task.simulator(row).area, self._generators[row]) for row in rows]
        position = np.concatenate([area.random_points(generator, 1) for area, generator in draws])
        yaw = np.array([generator.uniform(-np.pi, np.pi) for _, generator in draws])
        return self._task.reset(rows, position, yaw)


_OF_AGENT = {
    "area": lambda task, row: task.simulator(row).area,
    "scene_name": lambda task, row: task.simulator(row).scene,
    "scene_digest": lambda task, row: task.simulator(row).scene_digest,
    "simulator": lambda task, row: task.simulator(row),
    "centre_depth": lambda task, row: task.centre_depth(row),
    "camera_to_world": lambda task, row: task.camera_to_world[row],
    "agent_view": lambda task, row: task.agent_view(row),
}


def _open(scene: Scenes, simulator: str | Simulator | Sequence[Simulator], **options: Any) -> list[Simulator]:
    choice = SimulatorChoice.by_name(simulator, **options)
    if choice is None:
        return list(simulator) if isinstance(simulator, Sequence) else [simulator]  # type: ignore[list-item]
    scenes = scenes_given(scene, choice)
    if len(scenes) > 1 and choice.one_per_process:
        raise UsageError(
            f"AVPVecEnv: a process can hold one {choice.name!r} simulator, expected one scene, got {len(scenes)}: "
            f"{', '.join(scenes)}; use AVPSubprocVecEnv (rl_zoo3: --vec-env subproc), which gives each its own process"
        )
    return [open_simulator(choice, name) for name in scenes]


def scenes_given(scene: Scenes, choice: SimulatorChoice) -> list[str]:
    """The scenes as a list of strings; at least one, and several only without a NavMesh."""
    scenes = list(map(str, [scene] if isinstance(scene, (str, Path)) else scene))
    if not scenes:
        raise UsageError("scene: expected at least one, got none")
    if choice.navmesh is not None and len(scenes) > 1:
        raise UsageError(f"navmesh: {choice.navmesh} is of one scene, got {len(scenes)}: {', '.join(scenes)}")
    return scenes
