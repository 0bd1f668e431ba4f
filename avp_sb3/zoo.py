"""The hook by which rl_zoo3 steps its environments as one batch: `vec_env_wrapper: avp_sb3.zoo.Batched`."""

import re
from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import psutil
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv, VecMonitor

from avp_habitat.errors import UsageError
from avp_habitat.scenes.location import locate
from avp_habitat.simulators.base import Simulator
from avp_habitat.simulators.registry import ONE_PER_PROCESS, SimulatorChoice, open_simulator
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
    options: dict[str, Any] = {"agents": venv.num_envs, "settings": _settings(venv, lookup), "seed": venv._seeds[0]}
    if isinstance(venv, SubprocVecEnv):
        return _in_processes(venv, scenes or _shortest_cycle(venv.get_attr("scene")), options)
    batch = AVPVecEnv(simulator=_simulators(venv, scenes), **options)
    folder = _remove_monitor_files([writer.file_handler.name for writer in _monitor_writers(venv)])
    venv.close()
    return VecMonitor(batch, filename=folder)


def _reason_to_leave(venv: VecEnv) -> str | None:
    """What the batch would leave out; None when it would leave out nothing."""
    if not isinstance(venv, (DummyVecEnv, SubprocVecEnv)):
        return f"they are a {type(venv).__name__}"
    # A wrapper's text has those of all that it wraps: "<Monitor<OrderEnforcing<AVPEnv<AVP-v0>>>>".
    names = [re.findall(r"<(\w+)", text) for text in venv.env_method("__str__")]
    if not venv.has_attr("scene_digest"):
        inner = [name for name in names[0] if name not in _REPLACED]
        raise UsageError(f"{_HOOK}: expected environments of AVP-v0, got {inner[0]}")
    if venv.render_mode is not None:
        return f"they render (render_mode {venv.render_mode!r})"
    wrappers = [name for own in names for name in own[:-1] if name not in _REPLACED and own[-1] != name]
    return wrappers and f"they are wrapped in {wrappers[0]}" or None


def _settings(venv: VecEnv, lookup: bool) -> TaskSettings:
    settings, *others = venv.get_attr("settings")
    for index, other in enumerate(others, start=1):
        for field in fields(settings):
            one, another = getattr(settings, field.name), getattr(other, field.name)
            if one != another:
                raise UsageError(
                    f"{_HOOK}: expected the same settings in every environment, found {field.name} {one!r} in "
                    f"number 0 and {another!r} in number {index}"
                )
    return settings
