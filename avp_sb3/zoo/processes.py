"""Stable-Baselines3's `SubprocVecEnv` with workers that are watched: what fails in them is told by name."""

import os
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from stable_baselines3.common.vec_env import SubprocVecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvObs, VecEnvStepReturn, VecEnvWrapper

from avp_habitat.errors import UsageError
from avp_habitat.scenes.location import locate
from avp_sb3.vec_env.processes import GONE, Failure, end_processes, named_deaths

_UNCHANGING = ("area", "scene_name", "scene_digest", "settings")
_STAYS = "simulator"


class WatchedProcesses(VecEnvWrapper):
    """Environments of `AVP-v0` in processes of their own; a worker that ends becomes one error that names its scene.

    What never changes (areas, scenes, settings) is asked for once, so that an interrupted training, whose workers
    ended with the same Ctrl-C, can still be written down.
    """

    venv: SubprocVecEnv

    def __init__(self, venv: SubprocVecEnv, scenes: Sequence[str | Path] = (), *, reader: str) -> None:
        """Ask the workers whether their scenes are open.

        Args:
            venv: of Stable-Baselines3.
            scenes: worker i changes to scene i modulo their number; none to leave them where they are.
            reader: who asks, for the errors' texts.

        Raises:
            UsageError: no environments of `AVP-v0`, or fewer than the scenes.
            AVPError: as a worker's environment raised it when it was made.
            SimulatorError: a worker has ended.
        """
        self._names: dict[int, str] = {}
        self._known: dict[str, list[Any]] = {}
        self.venv = venv
        try:
            self._check(reader)
            self._spread(scenes, reader)
            self._known = {name: self._watched(lambda name=name: venv.get_attr(name)) for name in _UNCHANGING}
        except BaseException:
            self.close()
            raise
        self._names = dict(enumerate(map(str, self._known["scene_name"])))
        super().__init__(venv)

    def reset(self) -> VecEnvObs:
        """Start all episodes."""
        return self._watched(self.venv.reset)

    def step_async(self, actions: Any) -> None:
        """Send the actions."""
        self._watched(lambda: self.venv.step_async(actions))

    def step_wait(self) -> VecEnvStepReturn:
        """What all agents saw."""
        return self._watched(self.venv.step_wait)

    def get_images(self) -> Sequence[Any]:
        """What the environments render."""
        return self._watched(self.venv.get_images)

    def has_attr(self, attr_name: str) -> bool:
        """Whether all environments have an attribute."""
        return attr_name in self._known or self._watched(lambda: self.venv.has_attr(attr_name))

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """An attribute of the chosen environments; `simulator` stays in its process."""
        if attr_name == _STAYS:
            raise UsageError(f"SubprocVecEnv: {_STAYS} stays in its process; ask for area, scene_name or agent_view")
        if attr_name in self._known:
            return [self._known[attr_name][index] for index in self.venv._get_indices(indices)]
        return self._watched(lambda: self.venv.get_attr(attr_name, indices))

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set an attribute of the chosen environments' outermost wrappers."""
        self._watched(lambda: self.venv.set_attr(attr_name, value, indices))

    def env_method(self, method_name: str, *args: Any, indices: VecEnvIndices = None, **kwargs: Any) -> list[Any]:
        """Call a method of the chosen environments."""
        return self._watched(lambda: self.venv.env_method(method_name, *args, indices=indices, **kwargs))

    def env_is_wrapped(self, wrapper_class: type, indices: VecEnvIndices = None) -> list[bool]:
        """Whether the chosen environments have a wrapper."""
        return self._watched(lambda: self.venv.env_is_wrapped(wrapper_class, indices))

    def close(self) -> None:
        """End the workers, also those that do not answer; without complaint when they have ended already."""
        venv = self.venv
        if venv.closed:
            return
        venv.closed = True
        for remote in venv.remotes:
            with suppress(OSError, *GONE):
                if venv.waiting and remote.poll(0.1):
                    remote.recv()
                remote.send(("close", None))
        # Not before they have ended: whoever still has an answer to give would end in a traceback.
        end_processes(venv.processes, ())
        for remote in venv.remotes:
            remote.close()

    def _check(self, reader: str) -> None:
        if not self._watched(lambda: self.venv.has_attr("failure")):
            raise UsageError(f"{reader}: expected environments of AVP-v0, got others")
        for worker, failure in enumerate(self._watched(lambda: self.venv.get_attr("failure"))):
            if failure is not None:
                raise Failure(*failure).error(self._name(worker))

    def _spread(self, scenes: Sequence[str | Path], reader: str) -> None:
        if not scenes:
            return
        count = self.venv.num_envs
        if count < len(scenes):
            raise UsageError(
                f"{reader}: expected at least one environment for each of the {len(scenes)} scenes, got {count}"
            )
        for scene in scenes:
            locate(scene)  # Here, a missing one is an error of its own, there it would end the worker.
        for worker in range(count):
            scene = self._names[worker] = os.fspath(scenes[worker % len(scenes)])
            self._watched(lambda: self.venv.env_method("change_scene", scene, indices=worker))  # noqa: B023

    def _watched(self, work: Callable[[], Any]) -> Any:
        with named_deaths(self.venv.processes, self._name, self.close):
            return work()

    def _name(self, worker: int) -> str:
        scene = self._names.get(worker)
        return f"worker {worker} of {len(self.venv.processes)}" + (f" (scene {scene})" if scene else "")
