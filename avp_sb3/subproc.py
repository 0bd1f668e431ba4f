"""Many agents as one Stable-Baselines3 `VecEnv` over several processes, each with a simulator of its own."""

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices

from avp_habitat.errors import AVPError, UsageError
from avp_habitat.settings import TaskSettings
from avp_habitat.simulators import SimulatorChoice
from avp_habitat.spaces import action_space, observation_space
from avp_sb3.vec_env import scenes_given
from avp_sb3.worker_process import Order
from avp_sb3.workers import Workers

_UNCHANGING = ("area", "scene_name", "scene_digest")
_STAYS = "simulator"


class AVPSubprocVecEnv(VecEnv):
    """n agents of `AVP-v0` over worker processes, each of which steps its agents in one scene as an `AVPVecEnv`.

    For simulators of which a process can hold one only (Habitat-Sim), and for several cores or GPUs. Observations,
    rewards and `info` are those of `AVPVecEnv` with the same scenes, agents, settings and seed. A program that makes
    one needs the guard `if __name__ == "__main__":`, because its workers import it.

    A worker that fails or ends becomes one error that names it and its scene; the other workers are ended then.
    """

    def __init__(
        self,
        scene: str | Path | Sequence[str | Path] = "builtin:0",
        *,
        agents: int | None = None,
        workers: int | None = None,
        simulator: str = "raycast",
        gpu: int | Sequence[int] | None = None,
        navmesh: str | Path | None = None,
        up: str | None = None,
        settings: TaskSettings | None = None,
        seed: int | None = None,
        start_method: str = "forkserver",
    ) -> None:
        """Start the workers, and wait until all scenes are open.

        Args:
            scene: as `avp_habitat.scenes.location.locate` takes it, or several; agent i walks in scene i modulo their
                number.
            agents: n, at least one for each worker; one for each when omitted.
            workers: processes, a multiple of the number of scenes; one for each scene when omitted. Agent i is of
                worker i modulo their number.
            simulator: `raycast` or `habitat`.
            gpu: the CUDA device of `habitat`, or several, of which worker i takes number i modulo their number; -1
                for none, None for the first one there is.
            navmesh: file of the only scene's NavMesh; computed when omitted.
            up: axis of mesh files that points up, `y` or `z`; of each file what is known of it when omitted.
            settings: of the task; when omitted, the design's defaults, looked up where the simulator casts rays.
            seed: of the starts; agent i uses `seed + i`.
            start_method: `forkserver` or `spawn`.

        Raises:
            UsageError: numbers that do not fit each other, or an unknown name.
            SceneError: a scene cannot be used; the text names it and its worker.
            SimulatorError: the simulator cannot run here, or a worker ended.
        """
        gpus = list(gpu) if isinstance(gpu, Sequence) else [gpu]
        choices = [SimulatorChoice.of(simulator, gpu=each, navmesh=navmesh, up=up) for each in gpus]
        if not choices:
            raise UsageError("gpu: expected at least one, got none")
        self.scenes = scenes_given(scene, choices[0])
        """Of the agents in turn, as given."""
        self._count = _workers(workers, len(self.scenes))
        agents = self._count if agents is None else agents
        if agents < self._count:
            raise UsageError(f"agents: expected at least {self._count}, one for each worker, got {agents}")
        self.settings = settings or TaskSettings(lookup=simulator == "raycast")
        orders = [
            Order(
                self.scenes[worker % len(self.scenes)],
                choices[worker % len(choices)],
                len(range(worker, agents, self._count)),
                self.settings,
            )
            for worker in range(self._count)
        ]
        self._known: dict[tuple[str, int], Any] = {}
        self._workers = Workers(orders, start_method=start_method)
        self.render_mode = None
        super().__init__(agents, observation_space(self.settings.observation), action_space())
        self.seed(seed)

    @property
    def processes(self) -> list[Any]:
        """The workers' processes (`multiprocessing.Process`), in order."""
        return list(self._workers.processes)

    def reset(self) -> NDArray[np.float32]:  # type: ignore[override]
        """Start all episodes at random; `(n, 12)`, longer with a map."""
        count = self._count
        with _ended_by_errors(self):
            answers = self._workers.ask({worker: (self._seeds[worker::count],) for worker in range(count)}, "reset")
        self._reset_seeds()
        self._reset_options()
        self.reset_infos = [{"coverage": 0.0, "views": 0} for _ in range(self.num_envs)]
        return self._joined(answers[worker] for worker in range(count))

    def step_async(self, actions: NDArray[np.integer]) -> None:
        """Send the `(n,)` actions to the workers."""
        actions = np.asarray(actions)
        self._workers.send({worker: (actions[worker :: self._count],) for worker in range(self._count)}, "step")

    def step_wait(self) -> tuple[NDArray, NDArray, NDArray, list[dict[str, Any]]]:  # type: ignore[override]
        """What all agents saw; those whose episode ended start the next one, as SB3 expects."""
        with _ended_by_errors(self):
            answers = self._workers.receive(range(self._count))
        columns = list(zip(*(answers[worker] for worker in range(self._count)), strict=True))
        infos: list[dict[str, Any]] = [{}] * self.num_envs
        for worker, own in enumerate(columns[3]):
            infos[worker :: self._count] = own
        observation, reward, done = (self._joined(column) for column in columns[:3])
        return observation, reward, done, infos

    def close(self) -> None:
        """End the workers; they free their simulators."""
        self._workers.close()

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """An attribute of the chosen agents, as separate `AVPEnv`s have it; `simulator` stays in its process."""
        rows = list(self._get_indices(indices))
        if attr_name == _STAYS:
            raise UsageError(f"AVPSubprocVecEnv: {_STAYS} stays in its process; ask for area, scene_name or agent_view")
        if attr_name in ("settings", "render_mode"):
            return [getattr(self, attr_name) for _ in rows]
        if attr_name in _UNCHANGING:
            return [self._unchanging(attr_name, row % self._count) for row in rows]
        return self._of_agents(rows, "get_attr", attr_name)

    def has_attr(self, attr_name: str) -> bool:
        """Whether `get_attr` knows the name."""
        if attr_name in ("settings", "render_mode", *_UNCHANGING):
            return True
        return attr_name != _STAYS and self._workers.ask({0: (attr_name,)}, "has_attr")[0]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Refused: the agents share one task, whose settings are frozen."""
        raise UsageError(f"AVPSubprocVecEnv: {attr_name} cannot be set after it was made; give it as settings")

    def env_method(self, method_name: str, *args: Any, indices: VecEnvIndices = None, **kwargs: Any) -> list[Any]:
        """Call a method once for each chosen agent; `capture` looks into that agent's scene."""
        return self._of_agents(list(self._get_indices(indices)), "env_method", method_name, args, kwargs)

    def env_is_wrapped(self, wrapper_class: type[gymnasium.Wrapper], indices: VecEnvIndices = None) -> list[bool]:
        """No agent has a Gymnasium wrapper."""
        return [False for _ in self._get_indices(indices)]

    def _of_agents(self, rows: list[int], command: str, name: str, *more: Any) -> list[Any]:
        """Answers for agents, in the order of `rows`; each worker is asked once."""
        workers = {
            row % self._count: [other for other in rows if other % self._count == row % self._count] for row in rows
        }
        requests = {worker: (name, [row // self._count for row in own], *more) for worker, own in workers.items()}
        answers = {worker: iter(answer) for worker, answer in self._workers.ask(requests, command).items()}
        return [next(answers[row % self._count]) for row in rows]

    def _unchanging(self, name: str, worker: int) -> Any:
        if (name, worker) not in self._known:
            # The agent of a worker's number is that worker's first one.
            self._known[name, worker] = self._of_agents([worker], "get_attr", name)[0]
        return self._known[name, worker]

    def _joined(self, parts: Iterable[NDArray]) -> NDArray:
        arrays = list(parts)
        joined = np.empty((self.num_envs, *arrays[0].shape[1:]), arrays[0].dtype)
        for worker, array in enumerate(arrays):
            joined[worker :: self._count] = array
        return joined


@contextmanager
def _ended_by_errors(env: AVPSubprocVecEnv) -> Iterator[None]:
    """A step or reset that failed leaves agents of different times: nothing can go on from there."""
    try:
        yield
    except (AVPError, AttributeError):
        env.close()
        raise


def _workers(workers: int | None, scenes: int) -> int:
    if workers is None:
        return scenes
    if workers < 1 or workers % scenes:
        there_are = "there is 1 scene" if scenes == 1 else f"there are {scenes} scenes"
        raise UsageError(f"workers: expected {scenes} or a multiple of it, as {there_are}, got {workers}")
    return workers
