"""Many agents in one or more scenes as one Stable-Baselines3 `VecEnv`: one task, and one call for all their views."""

from collections.abc import Callable, Sequence
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
from avp_habitat.task.rewards import find_reward, stop_pays, stops_always
from avp_habitat.task.settings import TaskSettings
from avp_habitat.task.task import ViewpointTask
from avp_sb3.vec_env.pool import TURNOVER, ScenePool

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
        open_scenes: int | None = None,
        turnover: int = TURNOVER,
    ) -> None:
        """Open the scenes for n agents.

        Args:
            scene: as `scenes.location.locate` takes it, or several; agent i walks in scene i modulo their number.
            agents: n, at least 1, and at least one for each open scene.
            simulator: a simulator's name or factory, or those that are open already, one for each scene.
            gpu: the CUDA device of `habitat`; -1 for none, None for the first one there is.
            navmesh: file of the only scene's NavMesh; computed when omitted.
            up: axis of mesh files that points up, `y` or `z`; of each file what is known of it when omitted.
            settings: of the task; when omitted, the defaults, looked up where the simulator casts rays.
            seed: of the starts; agent i uses `seed + i`, as SB3 seeds separate environments. Also of a pool's order.
            open_scenes: so many of the scenes, which are then a pool, are open at a time; all of them when omitted.
                They are changed one after the other, and agent i walks in the open scene i modulo `open_scenes`. No
                episode is cut: an agent enters the new scene when it begins its next episode, the old one is closed
                when its last agent has left, and each scene of the pool comes once before any comes again.
            turnover: a scene of a pool is held for the steps of so many whole episodes, at least 1.

        Raises:
            UsageError: too few agents, an unknown name, or a pool of simulators that are open already.
            SceneError: a scene cannot be used; the text names it.
            SimulatorError: the simulator cannot run here, or several scenes need a process each (`AVPSubprocVecEnv`).
        """
        number("turnover", turnover, int, Range(1, 1e12))
        self._pool, opened = _open(scene, simulator, open_scenes, seed, gpu=gpu, navmesh=navmesh, up=up)
        casts = all(isinstance(each, SingleRays) for each in opened)
        self.settings = settings or TaskSettings(lookup=casts)
        agents = number("agents", agents, int, Range(0, 1e12))
        if agents < len(opened):
            raise UsageError(f"agents: expected at least {len(opened)}, one for each scene, got {agents}")
        self._open_scenes, self._stepped = len(opened), 0
        # Rounded up: all agents have entered a scene before the next one is opened for them.
        self._change_every = -(-turnover * self.settings.budget // self._open_scenes)
        self._next = np.full(agents, -1)
        self._left: dict[int, Simulator] = {}
        # Where an episode may be ended at any time, the end of the budget, which is observed, is an end like any other:
        # bootstrapping a value there would pay for not stopping.
        self._reward = find_reward(self.settings.reward)
        self._stops_always = stops_always(self._reward)
        self.render_mode = None
        self._task = ViewpointTask(opened, self.settings, agents)
        super().__init__(agents, self._task.kind.space, action_space())
        self._generators = [np.random.default_rng() for _ in range(agents)]
        self._actions = np.zeros(agents, dtype=np.int64)
        self.seed(seed)

    @property
    def simulators(self) -> list[Simulator]:
        """Those that are open, each once."""
        return self._task.simulators

    @property
    def pool(self) -> str | None:
        """What the scenes of a pool are called together; None where all scenes are open all the time."""
        return None if self._pool is None else self._pool.name

    def simulator_of(self, row: int) -> Simulator:
        """The simulator of an agent's scene; when an episode has just ended, of the scene in which it was."""
        return self._left.get(row) or self._task.simulator(row)

    def capture(self, row: int, camera_to_world: NDArray[np.floating], intrinsics: Intrinsics) -> Frames:
        """Pictures and depth of `(k, 4, 4)` habitat poses in an agent's scene, without any effect on the episodes."""
        return pictures(self.simulator_of(row), camera_to_world, intrinsics)

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
        self._left.clear()
        self._change_scene()
        outcome = self._task.step(self._actions)
        done = outcome.terminated | outcome.truncated
        infos = step_info(self._task, outcome)
        if self._stops_always:
            for info, pays in zip(infos, stop_pays(self._reward, outcome.facts, self.settings.constants), strict=True):
                info["stop_pays"] = float(pays)
        observation = outcome.observation
        ended = np.flatnonzero(done)
        for row in ended:
            infos[row]["terminal_observation"] = each(lambda values, row=row: values[row].copy(), observation)
            infos[row]["TimeLimit.truncated"] = bool(outcome.truncated[row]) and not self._stops_always
        if len(ended):
            self._enter_next(ended)
            each(lambda values, first: values.__setitem__(ended, first), observation, self._restart(ended.tolist()))
        return observation, outcome.reward.astype(np.float32), done, infos

    def close(self) -> None:
        """Nothing to free: the simulators are shared and go with their last user."""

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """An attribute of the chosen agents, as separate `AVPEnv`s have it."""
        read = _OF_AGENT.get(attr_name, lambda *_: getattr(self, attr_name))
        return [read(self, row) for row in self._get_indices(indices)]

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

    def _change_scene(self) -> None:
        """Open the pool's next scene where one is due, for the agents of one of the open scenes."""
        if self._pool is None:
            return
        self._stepped += 1
        changes, since = divmod(self._stepped, self._change_every)
        if since == 0:
            rows = np.arange((changes - 1) % self._open_scenes, self.num_envs, self._open_scenes)
            self._next[rows] = self._task.add_scene(self._pool.open_next(), rows)

    def _enter_next(self, rows: NDArray[np.integer]) -> None:
        """Let agents whose episode ended enter the next scene, where there is one for them."""
        moving = rows[self._next[rows] >= 0]
        self._left |= {row: self._task.simulator(row) for row in moving.tolist()}
        for scene in np.unique(self._next[moving]).tolist():
            self._task.enter(moving[self._next[moving] == scene], scene)
        self._next[moving] = -1

    def _restart(self, rows: Sequence[int]) -> Observed:
        draws = [(self._task.simulator(row).area, self._generators[row]) for row in rows]
        position = np.concatenate([area.random_points(generator, 1) for area, generator in draws])
        yaw = np.array([generator.uniform(-np.pi, np.pi) for _, generator in draws])
        return self._task.reset(rows, position, yaw)


_OF_AGENT: dict[str, Callable[[AVPVecEnv, int], Any]] = {
    "area": lambda env, row: env.simulator_of(row).area,
    "scene_name": lambda env, row: env.simulator_of(row).scene,
    "scene_digest": lambda env, row: env.simulator_of(row).scene_digest,
    "simulator": lambda env, row: env.simulator_of(row),
    "centre_depth": lambda env, row: env._task.centre_depth(row),
    "camera_to_world": lambda env, row: env._task.camera_to_world[row],
    "agent_view": lambda env, row: env._task.agent_view(row),
}


def _open(
    scene: Scenes,
    simulator: str | Simulator | Sequence[Simulator],
    open_scenes: int | None,
    seed: int | None,
    **options: Any,
) -> tuple[ScenePool | None, list[Simulator]]:
    """The pool, if there is one, and the simulators of the scenes that are open first."""
    if open_scenes is not None:
        number("open_scenes", open_scenes, int, Range(1, 1e12))
    choice = SimulatorChoice.by_name(simulator, **options)
    if choice is None:
        if open_scenes is not None:
            raise UsageError(f"open_scenes: expected none beside simulators that are open already, got {open_scenes}")
        return None, list(simulator) if isinstance(simulator, Sequence) else [simulator]  # type: ignore[list-item]
    scenes = scenes_given(scene, choice)
    at_a_time = len(scenes) if open_scenes is None else min(open_scenes, len(scenes))
    if choice.one_per_process and at_a_time > 1:
        raise UsageError(
            f"AVPVecEnv: a process can hold one {choice.name!r} simulator, expected one scene, got {len(scenes)}: "
            f"{', '.join(scenes)}; use AVPSubprocVecEnv (rl_zoo3: --vec-env subproc), which gives each its own process"
        )
    if at_a_time == len(scenes):
        return None, [open_simulator(choice, name) for name in scenes]
    pool = ScenePool(scenes, choice, seed)
    return pool, [pool.open_next() for _ in range(at_a_time)]


def scenes_given(scene: Scenes, choice: SimulatorChoice) -> list[str]:
    """The scenes as a list of strings; at least one, and several only without a NavMesh."""
    scenes = list(map(str, [scene] if isinstance(scene, (str, Path)) else scene))
    if not scenes:
        raise UsageError("scene: expected at least one, got none")
    if choice.navmesh is not None and len(scenes) > 1:
        raise UsageError(f"navmesh: {choice.navmesh} is of one scene, got {len(scenes)}: {', '.join(scenes)}")
    return scenes
