"""Many agents as one Stable-Baselines3 `VecEnv` over several processes, each with a simulator of its own."""

import multiprocessing
import weakref
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices

from avp_habitat.errors import AVPError, SimulatorError, UsageError
from avp_habitat.simulators.registry import SimulatorChoice
from avp_habitat.task.observations import Observed, action_space, each, make_observation
from avp_habitat.task.settings import TaskSettings
from avp_sb3.vec_env.batched import scenes_given
from avp_sb3.vec_env.processes import Failure, Order, end_processes, named_deaths, serve

START_METHODS = ("forkserver", "spawn")
_GUARD = '; a script that starts workers needs the guard `if __name__ == "__main__":`, because they import it'


class Workers:
    """Processes that each hold one simulator; none is left when this object is closed, lost, or its program ends."""

    def __init__(self, orders: Sequence[Order], *, start_method: str) -> None:
        """Start a process for each order, and wait until all have opened their scenes.

        Args:
            orders: at least one.
            start_method: `forkserver` or `spawn`; a forked process cannot use a graphics device.

        Raises:
            UsageError: another start method.
            AVPError: as a worker's `AVPVecEnv` raised it, with the worker and its scene.
            SimulatorError: a worker has ended.
        """
        if start_method not in START_METHODS:
            raise UsageError(f"start_method: expected one of {', '.join(START_METHODS)}, got {start_method!r}")
        self._orders = list(orders)
        self._ticket = 0
        context = multiprocessing.get_context(start_method)
        self._pipes: list[Connection] = []
        self.processes: list[Any] = []
        self._ending = weakref.finalize(self, end_processes, self.processes, self._pipes)
        try:
            for order in self._orders:
                ours, theirs = context.Pipe()
                self._pipes.append(ours)
                process = context.Process(target=serve, args=(theirs, order), daemon=True)  # type: ignore[attr-defined]
                process.start()
                self.processes.append(process)
                theirs.close()
            self._receive(range(len(self.processes)), 0)
        except BaseException:
            self.close()
            raise

    def send(self, requests: Mapping[int, tuple[Any, ...]], name: str) -> None:
        """Ask some workers; `receive` waits for what they answer.

        Args:
            requests: arguments by the worker's number.
            name: of the command.

        Raises:
            SimulatorError: a worker has ended.
        """
        self._check_open()
        self._ticket += 1
        with self._deaths():
            for worker, arguments in requests.items():
                self._pipes[worker].send((self._ticket, name, arguments))

    def receive(self, workers: Iterable[int]) -> dict[int, Any]:
        """The answers to what was sent last, by the worker's number.

        Raises:
            AVPError: as a worker raised it, with the worker and its scene.
            AttributeError: as a worker raised it.
            SimulatorError: a worker has ended, or made a mistake of its own.
        """
        self._check_open()
        return self._receive(workers, self._ticket)

    def ask(self, requests: Mapping[int, tuple[Any, ...]], name: str) -> dict[int, Any]:
        """`send` and `receive`."""
        self.send(requests, name)
        return self.receive(requests)

    def close(self) -> None:
        """End all workers: those that work get some seconds to leave by themselves."""
        self._ending()

    def _check_open(self) -> None:
        if not self._ending.alive:
            raise SimulatorError("AVPSubprocVecEnv: its workers were ended; make a new one")

    def _receive(self, workers: Iterable[int], ticket: int) -> dict[int, Any]:
        waiting = {self._pipes[worker]: worker for worker in workers}
        answers: dict[int, Any] = {}
        with self._deaths():
            while waiting:
                # Whoever answers first: a failure is told without waiting for workers that are busy.
                for pipe in wait(list(waiting)):
                    answered, value = pipe.recv()  # type: ignore[union-attr]
                    if answered != ticket:
                        continue  # To a request whose asker was interrupted.
                    worker = waiting.pop(pipe)  # type: ignore[arg-type]
                    if isinstance(value, Failure):
                        raise value.error(self._name(worker))
                    answers[worker] = value
        return answers

    def _deaths(self) -> Any:
        return named_deaths(self.processes, self._name, self.close, hint="" if self._ticket else _GUARD)

    def _name(self, worker: int) -> str:
        return f"worker {worker} of {len(self._orders)} (scene {self._orders[worker].scene})"


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
            simulator: its name, `module:factory`, or the factory itself.
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
        file = Path(navmesh) if navmesh else None
        choices = [SimulatorChoice(simulator, gpu=each, navmesh=file, up=up) for each in gpus]
        if not choices:
            raise UsageError("gpu: expected at least one, got none")
        self.scenes = scenes_given(scene, choices[0])
        """Of the agents in turn, as given."""
        self._count = _workers(workers, len(self.scenes))
        agents = self._count if agents is None else agents
        if agents < self._count:
            raise UsageError(f"agents: expected at least {self._count}, one for each worker, got {agents}")
        self.settings = settings or TaskSettings(lookup=choices[0].single_rays)
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
        space = make_observation(self.settings).space
        self._workers = Workers(orders, start_method=start_method)
        self.render_mode = None
        super().__init__(agents, space, action_space())
        self.seed(seed)

    @property
    def processes(self) -> list[Any]:
        """The workers' processes (`multiprocessing.Process`), in order."""
        return list(self._workers.processes)

    def reset(self) -> Observed:  # type: ignore[override]
        """Start all episodes at random; the first axis of what is observed is n."""
        count = self._count
        with _ended_by_errors(self):
            answers = self._workers.ask({worker: (self._seeds[worker::count],) for worker in range(count)}, "reset")
        self._reset_seeds()
        self._reset_options()
        self.reset_infos = [{"coverage": 0.0, "views": 0} for _ in range(self.num_envs)]
        return each(self._joined, *(answers[worker] for worker in range(count)))

    def step_async(self, actions: NDArray[np.integer]) -> None:
        """Send the `(n,)` actions to the workers."""
        actions = np.asarray(actions)
        self._workers.send({worker: (actions[worker :: self._count],) for worker in range(self._count)}, "step")

    def step_wait(self) -> tuple[Observed, NDArray, NDArray, list[dict[str, Any]]]:  # type: ignore[override]
        """What all agents saw; those whose episode ended start the next one, as SB3 expects."""
        with _ended_by_errors(self):
            answers = self._workers.receive(range(self._count))
        columns = list(zip(*(answers[worker] for worker in range(self._count)), strict=True))
        infos: list[dict[str, Any]] = [{}] * self.num_envs
        for worker, own in enumerate(columns[3]):
            infos[worker :: self._count] = own
        observation, reward, done = (each(self._joined, *column) for column in columns[:3])
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

    def _joined(self, *arrays: NDArray) -> NDArray:
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
