"""The hook by which rl_zoo3 steps its environments as one batch: `vec_env_wrapper: avp_sb3.zoo.Batched`."""

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import psutil
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv, VecMonitor

from avp_habitat.errors import UsageError
from avp_habitat.simulators.registry import SimulatorChoice
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
        venv: what rl_zoo3 made, all with the same settings.
        scenes: train in these, agent i in scene i modulo their number, instead of in the environments' own; a single
            environment (rl_zoo3's evaluation, `enjoy`) keeps its own scene.
        lookup: look visibility up in tables per scene where the simulator casts rays; False casts them.

    Raises:
        UsageError: an environment is no `AVPEnv`, they are fewer than the scenes, or there are scenes for environments
            that are left as they are.
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
    choice: SimulatorChoice = venv.get_attr("choice")[0]
    if not scenes:
        own = venv.get_attr("scene")
        scenes = own[:1] if len(set(own)) == 1 else own
    settings = replace(venv.get_attr("settings")[0], lookup=lookup and choice.single_rays)
    options = {"agents": venv.num_envs, "settings": settings, "seed": venv._seeds[0], **vars(choice)}
    files = _monitor_files(venv)
    if isinstance(venv, SubprocVecEnv):
        # Their scenes are opened once more: what a process holds stays there.
        venv.close()
        batch = AVPSubprocVecEnv(scenes, workers=venv.num_envs - venv.num_envs % len(scenes), **options)
    else:
        batch = AVPVecEnv(scenes, **options)
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
    if venv.get_attr("choice")[0] is None:
        return "their simulator was opened by somebody else"
    if venv.render_mode is not None:
        return f"they render (render_mode {venv.render_mode!r})"
    wrappers = [name for own in names for name in own[:-1] if name not in _REPLACED]
    return f"they are wrapped in {wrappers[0]}" if wrappers else None


def _monitor_files(venv: VecEnv) -> list[Path]:
    """The environments' monitor files, of which each holds a header only."""
    if isinstance(venv, SubprocVecEnv):
        opened = [file.path for process in venv.processes for file in psutil.Process(process.pid).open_files()]
        return [Path(path) for path in opened if path.endswith(Monitor.EXT)]
    found = venv.get_attr("results_writer") if venv.has_attr("results_writer") else []
    return [Path(writer.file_handler.name) for writer in found if writer is not None]
