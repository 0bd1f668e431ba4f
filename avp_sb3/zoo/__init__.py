"""The hook by which rl_zoo3 steps its environments as one batch: `vec_env_wrapper: avp_sb3.zoo.Batched`."""

from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path

import gymnasium
from gymnasium.wrappers import OrderEnforcing, PassiveEnvChecker
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv, VecMonitor

from avp_habitat.errors import UsageError
from avp_habitat.simulators.base import Simulator, SingleRays
from avp_habitat.simulators.registry import SimulatorChoice, open_simulator
from avp_habitat.task.env import AVPEnv
from avp_habitat.task.settings import TaskSettings
from avp_sb3.vec_env.batched import AVPVecEnv
from avp_sb3.zoo.processes import WatchedProcesses

_REPLACED = (Monitor, OrderEnforcing, PassiveEnvChecker)
"""Wrappers whose work the batch does itself, or does not need."""
_HOOK = "avp_sb3.zoo.Batched"


def Batched(venv: VecEnv, *, scenes: Sequence[str | Path] = (), lookup: bool = True) -> VecEnv:
    """The same agents as one `AVPVecEnv` within a `VecMonitor`: same scenes, settings and starts, stepped as arrays.

    Left as they are: those that are rendered, recorded or wrapped otherwise, because a batch would leave that out, and
    environments in processes of their own (`--vec-env subproc`). The latter are watched: a worker that fails or ends
    is one error that names its scene (`zoo_processes.WatchedProcesses`).

    Args:
        venv: what rl_zoo3 made.
        scenes: train in these, agent i in scene i modulo their number, instead of in the environments' own; a single
            environment (rl_zoo3's evaluation, `enjoy`) keeps its own scene.
        lookup: look visibility up in tables per scene where the simulator casts rays; False casts them.

    Raises:
        UsageError: an environment is no `AVPEnv`, their settings differ, they are fewer than the scenes, or there are
            scenes for environments that are left as they are.
        SceneError: one of the scenes cannot be used.
        SimulatorError: a simulator cannot run here, or a worker ended.
    """
    if isinstance(venv, SubprocVecEnv):
        print(f"{_HOOK}: the environments are stepped one by one: they are in processes of their own")
        return WatchedProcesses(venv, scenes if venv.num_envs > 1 else (), reader=_HOOK)
    if not isinstance(venv, DummyVecEnv):
        return _left_alone(venv, f"they are a {type(venv).__name__}", scenes)
    envs = [_avp_env(env) for env in venv.envs]
    if (reason := _reason_to_leave(venv.envs)) is not None:
        return _left_alone(venv, reason, scenes)
    batch = AVPVecEnv(
        agents=len(envs),
        simulator=_simulators(envs, scenes),
        settings=_settings(envs, lookup=lookup),
        seed=venv._seeds[0],
    )
    folder = _take_over_monitors(venv)
    venv.close()
    return VecMonitor(batch, filename=folder)


def _left_alone(venv: VecEnv, reason: str, scenes: Sequence[str | Path]) -> VecEnv:
    if scenes and venv.num_envs > 1:
        raise UsageError(f"{_HOOK}: scenes: expected environments that can be stepped as one batch, but {reason}")
    print(f"{_HOOK}: the environments are stepped one by one: {reason}")
    return venv


def _avp_env(env: gymnasium.Env) -> AVPEnv:
    inner = env.unwrapped
    if not isinstance(inner, AVPEnv):
        name = type(inner).__name__
        raise UsageError(f"{_HOOK}: expected environments of AVP-v0, got {name}")
    return inner


def _reason_to_leave(envs: list[gymnasium.Env]) -> str | None:
    """What the batch would leave out; None when it would leave out nothing."""
    for env in envs:
        if env.render_mode is not None:
            return f"they render (render_mode {env.render_mode!r})"
        while isinstance(env, gymnasium.Wrapper):
            if not isinstance(env, _REPLACED):
                return f"they are wrapped in {type(env).__name__}"
            env = env.env
    return None


def _settings(envs: list[AVPEnv], *, lookup: bool) -> TaskSettings:
    settings = envs[0].settings
    for index, env in enumerate(envs):
        for field in fields(settings):
            first, other = getattr(settings, field.name), getattr(env.settings, field.name)
            if first != other:
                raise UsageError(
                    f"{_HOOK}: expected the same settings in every environment, found {field.name} {first!r} in "
                    f"number 0 and {other!r} in number {index}"
                )
    rays = all(isinstance(env.simulator, SingleRays) for env in envs)
    return replace(settings, lookup=lookup and rays)


def _simulators(envs: list[AVPEnv], scenes: Sequence[str | Path]) -> list[Simulator]:
    own = [env.simulator for env in envs]
    if not scenes or len(envs) == 1:
        return _shortest_cycle(own)
    if len(envs) < len(scenes):
        raise UsageError(
            f"{_HOOK}: expected at least one environment for each of the {len(scenes)} scenes, got {len(envs)}; "
            f"set n_envs:{len(scenes)} and n_steps so that their product is PPO's buffer"
        )
    choice = envs[0].choice or SimulatorChoice(own[0].name)
    if choice.one_per_process and len(scenes) > 1:
        raise UsageError(
            f"{_HOOK}: scenes: a process can hold one simulator of {choice.name!r}, got {len(scenes)} scenes; add "
            f"--vec-env subproc and set n_envs:{len(scenes)}, with n_steps so that their product is PPO's buffer"
        )
    return [open_simulator(choice, scene) for scene in scenes]


def _shortest_cycle(simulators: list[Simulator]) -> list[Simulator]:
    """The fewest scenes such that agent i walks in scene i modulo their number."""
    for length in range(1, len(simulators)):
        if all(simulator is simulators[i % length] for i, simulator in enumerate(simulators)):
            return simulators[:length]
    return simulators


def _take_over_monitors(venv: DummyVecEnv) -> str | None:
    """The folder of the environments' monitor files, which hold a header only and are removed; None without them."""
    found = venv.get_attr("results_writer") if venv.has_attr("results_writer") else []
    writers = [writer for writer in found if writer is not None]
    files = [Path(writer.file_handler.name) for writer in writers]
    for writer, file in zip(writers, files, strict=True):
        writer.close()
        file.unlink()
    return str(files[0].parent) if files else None
