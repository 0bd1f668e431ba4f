"""The hook by which rl_zoo3 steps its environments as one batch: `vec_env_wrapper: avp_sb3.zoo.Batched`."""

import re
from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import psutil
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv, VecMonitor

from avp_habitat.errors import UsageError
from avp_habitat.scenes.location import locate
from avp_habitat.simulators.base import Simulator, SingleRays
from avp_habitat.simulators.registry import SimulatorChoice, open_simulator
from avp_habitat.task.settings import TaskSettings
from avp_sb3.vec_env.batched import AVPVecEnv
from avp_sb3.vec_env.subproc import AVPSubprocVecEnv

_REPLACED = {"Monitor", "OrderEnforcing", "PassiveEnvChecker"}
"""Wrappers whose work the batch does itself, or does not need."""
_HOOK = "avp_sb3.zoo.Batched"


def Batched(venv: VecEnv, *, scenes: Sequence[str | Path] = (), lookup: bool = True) -> VecEnv:
    """The same agents as one batch within a `VecMonitor`: same scenes, settings and starts, stepped as arrays.

    The batch is an `AVPVecEnv`; for environments in processes of their own (`--vec-env subproc`) an
    `AVPSubprocVecEnv` with as many processes, which says why one of them ended. Environments that are rendered,
    recorded or wrapped otherwise are left as they are, because a batch would leave that out.

    Args:
        venv: what rl_zoo3 made.
        scenes: train in these, agent i in scene i modulo their number, instead of in the environments' own; a single
            environment (rl_zoo3's evaluation, `enjoy`) keeps its own scene.
        lookup: look visibility up in tables per scene where the simulator casts rays; False casts them.

    Raises:
        UsageError: an environment is no `AVPEnv`, their settings differ, they are fewer than the scenes, or there are
            scenes for environments that are left as they are.
        SceneError: one of the scenes cannot be used.
        SimulatorError: a simulator cannot run here.
    """
    if venv.num_envs == 1:
        scenes = ()
    if (reason := _reason_to_leave(venv)) is not None:
        if scenes:
            raise UsageError(f"{_HOOK}: scenes: expected environments that can be stepped as one batch, but {reason}")
        print(f"{_HOOK}: the environments are stepped one by one: {reason}")
        return venv
    if venv.num_envs < len(scenes):
        raise UsageError(
            f"{_HOOK}: expected at least one environment for each of the {len(scenes)} scenes, got {venv.num_envs}; "
            f"set n_envs:{len(scenes)} and n_steps so that their product is PPO's buffer"
        )
    for scene in scenes:
        locate(scene)
    choice = venv.get_attr("choice")[0]
    rays = choice.single_rays if choice else isinstance(venv.get_attr("simulator")[0], SingleRays)
    options = {
        "agents": venv.num_envs,
        "settings": replace(_settings(venv), lookup=lookup and rays),
        "seed": venv._seeds[0],
    }
    files = _monitor_files(venv)
    if isinstance(venv, SubprocVecEnv):
        batch = _in_processes(venv, choice, scenes, options)
    else:
        batch = AVPVecEnv(simulator=_simulators(venv, choice, scenes), **options)
        venv.close()
    for file in files:
        file.unlink()
    return VecMonitor(batch, filename=str(files[0].parent) if files else None)


def _reason_to_leave(venv: VecEnv) -> str | None:
    """What the batch would leave out; None when it would leave out nothing."""
    if not isinstance(venv, (DummyVecEnv, SubprocVecEnv)):
        return f"they are a {type(venv).__name__}"
    # An environment's text names its wrappers: <Monitor<OrderEnforcing<PassiveEnvChecker<AVPEnv<AVP-v0>>>>>.
    names = [re.findall(r"<(\w+)(?=[<> ])", text) for text in venv.env_method("__str__")]
    if not venv.has_attr("scene_digest"):
        raise UsageError(f"{_HOOK}: expected environments of AVP-v0, got {names[0][-1]}")
    if venv.render_mode is not None:
        return f"they render (render_mode {venv.render_mode!r})"
    wrappers = [name for own in names for name in own[:-1] if name not in _REPLACED]
    return f"they are wrapped in {wrappers[0]}" if wrappers else None


def _settings(venv: VecEnv) -> TaskSettings:
    """Those of all environments."""
    first, *others = venv.get_attr("settings")
    for index, other in enumerate(others, start=1):
        for field in fields(first):
            one, another = getattr(first, field.name), getattr(other, field.name)
            if one != another:
                raise UsageError(
                    f"{_HOOK}: expected the same settings in every environment, found {field.name} {one!r} in "
                    f"number 0 and {another!r} in number {index}"
                )
    return first


def _simulators(venv: VecEnv, choice: SimulatorChoice | None, scenes: Sequence[str | Path]) -> list[Simulator]:
    own: list[Simulator] = venv.get_attr("simulator")
    if not scenes:
        return _shortest_cycle(own)
    choice = choice or SimulatorChoice(own[0].name)
    if choice.one_per_process and len(scenes) > 1:
        raise UsageError(
            f"{_HOOK}: scenes: a process can hold one simulator of {choice.name!r}, got {len(scenes)} scenes; add "
            f"--vec-env subproc and set n_envs:{len(scenes)}, with n_steps so that their product is PPO's buffer"
        )
    return [open_simulator(choice, scene) for scene in scenes]


def _in_processes(
    venv: SubprocVecEnv, choice: SimulatorChoice | None, scenes: Sequence[str | Path], options: dict[str, Any]
) -> AVPSubprocVecEnv:
    if choice is None:
        raise UsageError(f"{_HOOK}: expected environments whose simulator is chosen by name, got an open one")
    scenes = scenes or _shortest_cycle(venv.get_attr("scene"))
    workers = venv.num_envs - venv.num_envs % len(scenes)
    # Their scenes are opened once more: what a process holds stays there.
    venv.close()
    return AVPSubprocVecEnv(scenes, workers=workers, **vars(choice), **options)


def _shortest_cycle(each: list[Any]) -> list[Any]:
    """The fewest things of which number i modulo their number is that of agent i."""
    for length in range(1, len(each)):
        if all(one == each[i % length] for i, one in enumerate(each)):
            return each[:length]
    return each


def _monitor_files(venv: VecEnv) -> list[Path]:
    """The environments' monitor files, of which each holds a header only."""
    if isinstance(venv, SubprocVecEnv):
        opened = [file.path for process in venv.processes for file in psutil.Process(process.pid).open_files()]
        return [Path(path) for path in opened if path.endswith(Monitor.EXT)]
    found = venv.get_attr("results_writer") if venv.has_attr("results_writer") else []
    return [Path(writer.file_handler.name) for writer in found if writer is not None]
