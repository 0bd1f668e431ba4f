"""Many agents of one scene as one Stable-Baselines3 `VecEnv`: one task, and one call for all their rays."""

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices

from avp_habitat.env import step_info
from avp_habitat.errors import UsageError
from avp_habitat.observation import HIGH, LOW
from avp_habitat.poses import Intrinsics
from avp_habitat.settings import ACTION_NAMES, TaskSettings
from avp_habitat.simulators import Frames, Simulator, make_simulator
from avp_habitat.task import ViewpointTask


class AVPVecEnv(VecEnv):
    """n agents of `AVP-v0`; the same task, observations, rewards and `info` as n separate `AVPEnv`s.

    Wrap it in SB3's `VecMonitor` for the episode rewards and lengths that SB3 prints.
    """

    def __init__(
        self,
        scene: str = "builtin:0",
        *,
        agents: int = 16,
        simulator: str | Simulator = "raycast",
        settings: TaskSettings | None = None,
        seed: int | None = None,
    ) -> None:
        """Open a scene for n agents.

        Args:
            scene: a mesh file, or `builtin:SEED`.
            agents: n, at least 1.
            simulator: a simulator's name, or one that is open already.
            settings: of the task; the design's defaults when omitted.
            seed: of the starts; agent i uses `seed + i`, as SB3 seeds separate environments.

        Raises:
            UsageError: fewer than one agent, or an unknown name.
            SceneError: the scene cannot be used.
            SimulatorError: the simulator cannot run here.
        """
        if agents < 1:
            raise UsageError(f"agents: expected at least 1, got {agents}")
        self.settings = settings or TaskSettings()
        self.simulator = make_simulator(simulator, scene) if isinstance(simulator, str) else simulator
        self.render_mode = None
        super().__init__(
            agents,
            gymnasium.spaces.Box(LOW, HIGH, dtype=np.float32),
            gymnasium.spaces.Discrete(len(ACTION_NAMES)),
        )
        self._task = ViewpointTask(self.simulator, self.settings, agents)
        self._generators = [np.random.default_rng() for _ in range(agents)]
        self._actions = np.zeros(agents, dtype=np.int64)
        self.seed(seed)

    @property
    def area(self) -> Any:
        """The scene's `NavigableArea`."""
        return self.simulator.area

    @property
    def scene_name(self) -> str:
        """What the user called the scene, without folders."""
        return self.simulator.scene

    @property
    def scene_digest(self) -> str:
        """Hexadecimal SHA-256 of the scene's content."""
        return self.simulator.scene_digest

    def capture(self, camera_to_world: NDArray[np.floating], intrinsics: Intrinsics) -> Frames:
        """Pictures and depth of `(k, 4, 4)` habitat poses, without any effect on the episodes."""
        return self.simulator.render(camera_to_world, intrinsics, rgb=True)

    def reset(self) -> NDArray[np.float32]:  # type: ignore[override]
        """Start all episodes at random; `(n, 12)`."""
        for index, seed in enumerate(self._seeds):
            if seed is not None:
                self._generators[index] = np.random.default_rng(seed)
        self._reset_seeds()
        self._reset_options()
        self.reset_infos = [{"coverage": 0.0, "views": 0} for _ in range(self.num_envs)]
        return self._restart(range(self.num_envs))

    def step_async(self, actions: NDArray[np.integer]) -> None:
        """Remember the `(n,)` actions."""
        self._actions = np.asarray(actions)

    def step_wait(self) -> tuple[NDArray, NDArray, NDArray, list[dict[str, Any]]]:  # type: ignore[override]
        """Step all agents; those whose episode ended start the next one, as SB3 expects."""
        outcome = self._task.step(self._actions)
        done = outcome.terminated | outcome.truncated
        infos = [step_info(self._task, outcome, row) for row in range(self.num_envs)]
        observation = outcome.observation
        ended = np.flatnonzero(done)
        for row in ended:
            infos[row]["terminal_observation"] = observation[row].copy()
            infos[row]["TimeLimit.truncated"] = bool(outcome.truncated[row])
        if len(ended):
            observation[ended] = self._restart(ended.tolist())
        return observation, outcome.reward.astype(np.float32), done, infos

    def close(self) -> None:
        """Nothing to free: the simulator is shared and goes with its last user."""

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """An attribute of the chosen agents' environments."""
        rows = self._get_indices(indices)
        if attr_name == "centre_depth":
            return [float(self._task.centre_depth[row]) for row in rows]
        if attr_name == "camera_to_world":
            return [self._task.camera_to_world[row] for row in rows]
        if attr_name == "agent_view":
            return [self._task.agent_view(row) for row in rows]
        return [getattr(self, attr_name) for _ in rows]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Refused: the agents share one task, whose settings are frozen."""
        raise UsageError(f"AVPVecEnv: {attr_name} cannot be set after the environment was made; give it as settings")

    def env_method(self, method_name: str, *args: Any, indices: VecEnvIndices = None, **kwargs: Any) -> list[Any]:
        """Call a method once for each chosen agent."""
        return [getattr(self, method_name)(*args, **kwargs) for _ in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: type[gymnasium.Wrapper], indices: VecEnvIndices = None) -> list[bool]:
        """No agent has a Gymnasium wrapper."""
        return [False for _ in self._get_indices(indices)]

    def _restart(self, rows: Sequence[int]) -> NDArray[np.float32]:
        area = self.simulator.area
        position = np.concatenate([area.random_points(self._generators[row], 1) for row in rows])
        yaw = np.array([self._generators[row].uniform(-np.pi, np.pi) for row in rows])
        return self._task.reset(rows, position, yaw)
