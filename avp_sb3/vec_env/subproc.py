"""Many agents as one Stable-Baselines3 `VecEnv` over several processes, each with a simulator of its own."""

import os
import signal
import socket
import time
import traceback
import weakref
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices

from avp_habitat.errors import AVPError, SimulatorError, UsageError
from avp_habitat.simulators.registry import SimulatorChoice
from avp_habitat.task.observations import Observed, action_space, each, make_observation
from avp_habitat.task.settings import TaskSettings
from avp_sb3.vec_env.batched import AVPVecEnv, Scenes, scenes_given
from avp_sb3.vec_env.pool import TURNOVER, describe

START_METHODS = ("forkserver", "spawn")
_GUARD = '; a script that starts workers needs the guard `if __name__ == "__main__":`, because they import it'
_GRACE_S = 5.0
"""How long a worker may take to end by itself, seconds."""
_OF_SCENE = ("area", "scene_name", "scene_digest")
_FIXED = (*_OF_SCENE, "settings", "render_mode")
"""Attributes that never change, of scenes of a pool excepted: known also when the workers have ended, so that the last
path can be drawn."""


class _Agents(gymnasium.Env):
    """What a worker holds: some agents in one scene, behind the protocol of SB3's workers for one environment."""

    def __init__(self, settings: TaskSettings, **options: Any) -> None:
        # Ctrl-C is left to the parent, which ends its workers; without one, an answer ends them without a traceback.
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        signal.signal(signal.SIGPIPE, signal.SIG_DFL)
        self.observation_space, self.action_space = make_observation(settings).space, action_space()
        self._open = partial(AVPVecEnv, settings=settings, **options)
        self._agents: AVPVecEnv | None = None

    def call(self, method: str, *args: Any, **kwargs: Any) -> Any:
        """What a method of `AVPVecEnv` returns or raises; raised here, it would end the worker with a traceback."""
        try:
            if self._agents is None:
                self._agents = self._open()
            return getattr(self._agents, method)(*args, **kwargs)
        except (AVPError, AttributeError) as error:
            return error
        except Exception as error:
            traceback.print_exc()
            return SimulatorError(f"{type(error).__name__}: {error}; its traceback stands above")


class AVPSubprocVecEnv(SubprocVecEnv):
    """n agents of `AVP-v0` over worker processes, each of which steps its agents in one scene as an `AVPVecEnv`.

    For simulators of which a process can hold one only (Habitat-Sim), and for several cores or GPUs; the numbers are
    those of `AVPVecEnv`. A program that makes one needs the guard `if __name__ == "__main__":`, because its workers
    import it.

    A worker that fails or ends becomes one error that names it and its scene; where it has ended, so do the others.
    """

    def __init__(
        self,
        scene: Scenes = "builtin:0",
        *,
        agents: int | None = None,
        workers: int | None = None,
        simulator: str = "raycast",
        gpu: int | Sequence[int] | None = None,
        navmesh: str | Path | None = None,
        up: str | None = None,
        settings: TaskSettings | None = None,
        seed: int | None = None,
        open_scenes: int | None = None,
        turnover: int = TURNOVER,
        start_method: str = "forkserver",
    ) -> None:
        """Start the workers, and wait until their scenes are open; the arguments are as of `AVPVecEnv`, but for these.

        `agents` are one for each worker when omitted. `workers` is a multiple of the number of scenes, one for each
        when omitted; agent i is of worker i modulo their number. The simulator is chosen by name. Of several CUDA
        devices in `gpu`, worker i takes number i modulo theirs. With `open_scenes`, which counts those of all workers,
        the scenes are shared: worker i of any number up to theirs has scenes i, i + workers, … as a pool of its own.
        `start_method` is `forkserver` or `spawn`, because a forked process cannot use a graphics device.

        Raises:
            UsageError: numbers that do not fit each other, or an unknown name.
            SceneError: a scene cannot be used; the text names it and its worker.
            SimulatorError: the simulator cannot run here, or a worker ended.
        """
        gpus = list(gpu) if isinstance(gpu, Sequence) else [gpu]
        file = Path(navmesh) if navmesh else None
        choices = [SimulatorChoice(simulator, gpu=number, navmesh=file, up=up) for number in gpus]
        if start_method not in START_METHODS:
            raise UsageError(f"start_method: expected one of {', '.join(START_METHODS)}, got {start_method!r}")
        self.scenes = scenes_given(scene, choices[0])
        """Of the agents in turn, as given."""
        self._is_pool = open_scenes is not None and open_scenes < len(self.scenes)
        count = _workers(len(self.scenes), workers, is_pool=self._is_pool)
        self._count, self._workers = count, range(count)
        agents = count if agents is None else agents
        if agents < count:
            raise UsageError(f"agents: expected at least {count}, one for each worker, got {agents}")
        self.settings = settings or TaskSettings(lookup=choices[0].single_rays)
        self._asked: list[int] = []
        self._fixed: dict[str, list[Any]] = {}
        makes: list[Callable[[], gymnasium.Env]] = [
            partial(
                _Agents,
                self.settings,
                scene=self._scenes_of(worker),
                agents=len(range(worker, agents, count)),
                open_scenes=-(-open_scenes // count) if open_scenes is not None and self._is_pool else None,
                turnover=turnover,
                seed=seed,
                **vars(choices[worker % len(choices)]),
            )
            for worker in self._workers
        ]
        try:
            with self._named_death(0, _GUARD):
                super().__init__(makes, start_method=start_method)
            # A program that is interrupted, or never closes.
            weakref.finalize(self, _end, self.remotes, self.processes)
            # SB3 has counted the workers.
            VecEnv.__init__(self, agents, self.observation_space, self.action_space)
            fixed = [name for name in _FIXED if not (self._is_pool and name in _OF_SCENE)]
            self._fixed = {name: self._of_agents(self._workers, "get_attr", name) for name in fixed}
        except BaseException:
            self.close()
            raise
        self.seed(seed)

    @property
    def pool(self) -> str | None:
        """As of `AVPVecEnv`, of all workers together."""
        return describe(self.scenes) if self._is_pool else None

    def reset(self) -> Observed:  # type: ignore[override]
        """Start all episodes at random; the first axis of what is observed is n."""
        self._send_parts("seed_agents", self._seeds)
        self._receive()
        self._send("reset", {worker: ((), {}) for worker in self._workers})
        observations = self._receive().values()
        self._reset_seeds()
        self._reset_options()
        self.reset_infos = [{"coverage": 0.0, "views": 0} for _ in range(self.num_envs)]
        return each(self._joined, *observations)

    def step_async(self, actions: NDArray[np.integer]) -> None:
        """Send the `(n,)` actions to the workers."""
        self._send_parts("step", np.asarray(actions))

    def step_wait(self) -> tuple[Observed, NDArray, NDArray, list[dict[str, Any]]]:  # type: ignore[override]
        """What all agents saw; those whose episode ended start the next one, as SB3 expects."""
        observations, rewards, dones, own_infos = zip(*self._receive().values(), strict=True)
        infos: list[dict[str, Any]] = [{}] * self.num_envs
        for worker, own in enumerate(own_infos):
            infos[worker :: self._count] = own
        return each(self._joined, *observations), self._joined(*rewards), self._joined(*dones), infos

    def close(self) -> None:
        """End the workers, also those that do not answer."""
        if not self.closed:
            self.closed = True
            _end(self.remotes, self.processes)

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """An attribute of the chosen agents, as separate `AVPEnv`s have it; `simulator` stays in its process."""
        rows = self._get_indices(indices)
        if attr_name == "simulator":
            raise UsageError("AVPSubprocVecEnv: simulator stays in its process; ask for area, scene_name or agent_view")
        if attr_name == "pool":
            return [self.pool for _ in rows]
        if attr_name in self._fixed:
            return [self._fixed[attr_name][row % self._count] for row in rows]
        return self._of_agents(rows, "get_attr", attr_name)

    def has_attr(self, attr_name: str) -> bool:
        """Whether `get_attr` knows the name."""
        if attr_name in ("pool", "simulator", *self._fixed):
            return attr_name != "simulator"
        self._send("has_attr", {0: ((attr_name,), {})})
        return self._receive()[0]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Refused: the agents share one task, whose settings are frozen."""
        raise UsageError(f"AVPSubprocVecEnv: {attr_name} cannot be set after it was made; give it as settings")

    def env_method(self, method_name: str, *args: Any, indices: VecEnvIndices = None, **kwargs: Any) -> list[Any]:
        """Call a method once for each chosen agent; `capture` looks into that agent's scene."""
        return self._of_agents(self._get_indices(indices), "env_method", method_name, *args, **kwargs)

    def env_is_wrapped(self, wrapper_class: type[gymnasium.Wrapper], indices: VecEnvIndices = None) -> list[bool]:
        """No agent has a Gymnasium wrapper."""
        return [False for _ in self._get_indices(indices)]

    def _of_agents(self, rows: Iterable[int], method: str, *args: Any, **kwargs: Any) -> list[Any]:
        """Answers for agents, in the order of `rows`; each worker is asked once."""
        rows, own = list(rows), defaultdict(list)
        for row in rows:
            own[row % self._count].append(row // self._count)
        self._send(method, {worker: (args, kwargs | {"indices": indices}) for worker, indices in own.items()})
        answers = {worker: iter(answer) for worker, answer in self._receive().items()}
        return [next(answers[row % self._count]) for row in rows]

    def _send(self, method: str, requests: Mapping[int, tuple[tuple[Any, ...], dict[str, Any]]]) -> None:
        """Ask workers, by their numbers; `_receive` waits for what they answer."""
        if self.closed:
            raise SimulatorError("AVPSubprocVecEnv: its workers were ended; make a new one")
        self._answers()  # To a request whose asker was interrupted.
        for worker, (args, kwargs) in requests.items():
            with self._named_death(worker):
                self.remotes[worker].send(("env_method", ("call", (method, *args), kwargs)))
            self._asked.append(worker)

    def _send_parts(self, method: str, values: Sequence[Any] | NDArray) -> None:
        """Ask all workers, each with its agents' part of the `(n,)` values."""
        self._send(method, {worker: ((values[worker :: self._count],), {}) for worker in self._workers})

    def _receive(self) -> dict[int, Any]:
        """Answers by the worker's number; the first that is an error is raised with the worker and its scene."""
        answers = self._answers()
        for worker, answer in answers.items():
            if isinstance(answer, Exception):
                raise type(answer)(f"{answer} [{self._name(worker)}]")
        return answers

    def _answers(self) -> dict[int, Any]:
        answers = {}
        while self._asked:
            with self._named_death(self._asked[0]):
                answers[self._asked[0]] = self.remotes[self._asked[0]].recv()
            del self._asked[0]
        return answers

    @contextmanager
    def _named_death(self, worker: int, hint: str = "") -> Iterator[None]:
        """Within the block, a broken pipe becomes an error that names the worker; the others are ended, too."""
        try:
            yield
        except (EOFError, BrokenPipeError, ConnectionResetError):
            how = _how_it_ended(self.processes[worker])
            self.close()
            raise SimulatorError(f"{self._name(worker)} {how}; the other workers were ended{hint}") from None

    def _name(self, worker: int) -> str:
        return f"worker {worker} of {self._count} (scene {describe(self._scenes_of(worker))})"

    def _scenes_of(self, worker: int) -> list[str]:
        return self.scenes[worker :: self._count] if self._is_pool else [self.scenes[worker % len(self.scenes)]]

    def _joined(self, *arrays: NDArray) -> NDArray:
        joined = np.empty((self.num_envs, *arrays[0].shape[1:]), arrays[0].dtype)
        for worker, array in enumerate(arrays):
            joined[worker :: self._count] = array
        return joined


def _workers(scenes: int, asked: int | None, *, is_pool: bool) -> int:
    """How many workers; a pool's share its scenes, others have one scene each."""
    count = (1 if is_pool else scenes) if asked is None else asked
    if is_pool and not 1 <= count <= scenes:
        raise UsageError(f"workers: expected 1 to {scenes}, the number of scenes, got {asked}")
    if not is_pool and (count < 1 or count % scenes):
        raise UsageError(f"workers: expected a multiple of the number of scenes, {scenes}, got {asked}")
    return count


def _how_it_ended(process: BaseProcess) -> str:
    """The end of a process whose pipe is broken, as a phrase: by which signal, or with which exit code."""
    process.join(_GRACE_S)
    code = process.exitcode
    if code is None:
        return "does not answer any more"
    if code >= 0:
        return f"ended with exit code {code}; what it said last stands above"
    name = signal.Signals(-code).name if -code in signal.valid_signals() else f"signal {-code}"
    by_whom = " (by somebody, or by the system for want of memory)" if -code == signal.SIGKILL else ""
    return f"was killed by {name}{by_whom}"


def _end(pipes: Sequence[Connection], processes: Sequence[BaseProcess]) -> None:
    """Let workers find the end of their pipes, and kill those that have not ended after a while."""
    for pipe in pipes:
        # One that is closed over an answer which nobody has read is an error in its worker.
        with suppress(OSError), socket.socket(fileno=os.dup(pipe.fileno())) as end:
            end.shutdown(socket.SHUT_RDWR)
    until = time.monotonic() + _GRACE_S
    for process in processes:
        process.join(max(0.0, until - time.monotonic()))
    for process in processes:
        if process.is_alive():
            process.kill()
            process.join()
    for pipe in pipes:
        pipe.close()
