"""Train a viewpoint policy with Stable-Baselines3's PPO and the suite's callbacks."""

import argparse
import shlex
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from avp_habitat import command
from avp_habitat.errors import UsageError
from avp_habitat.files import check_writable
from avp_habitat.policies.registry import TRUSTED, load_model
from avp_habitat.policies.saved_model import is_normalised, load_statistics, statistics_of
from avp_habitat.scenes.location import HELP as SCENES
from avp_habitat.simulators.registry import SimulatorChoice, add_simulator_options, simulator_choice
from avp_habitat.task.settings import TaskSettings
from avp_sb3.presets import MAP, PRESETS, Preset

_MLFLOW = "runs:/"
_STATISTICS = "_vecnormalize.pkl"


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        description=f"{__doc__} 300,000 steps of 64 agents take about a minute on two CPU cores with the numbers.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    add = parser.add_argument
    add("--scene", default=["builtin:0"], nargs="+", help=f"{SCENES}; agents share several")
    add("--reward", default="proposed", help="coverage, coverage_redundancy, proposed or surface")
    add("--observation", default="numbers", help="numbers (the paper's twelve), map or surface_map; also chooses PPO's")
    add("--steps", default=300_000, type=int, help="environment steps in total")
    add("--agents", default=None, type=int, help="agents stepped as one batch; the settings' own when omitted")
    add("--workers", default=None, type=int, help="processes with a simulator each, a multiple of the scenes' number")
    add_simulator_options(parser)
    add("--rays", action="store_true", help="cast all rays instead of looking views up in the scenes' tables")
    add("--width", default=160, type=int, help="of the policy's depth image in pixels")
    add("--height", default=120, type=int, help="of the policy's depth image in pixels")
    add("--seed", default=0, type=int, help="of the policy and the starts")
    add("--out", default=Path("runs/ppo.zip"), type=Path, help="the model; also written after Ctrl-C")
    add(
        "--resume",
        default=None,
        metavar="MODEL",
        help="go on until --steps are done with a model: a file, or MLflow's runs:/RUN_ID/model.zip",
    )
    add("--trusted", action="store_true", help=TRUSTED)
    add("--eval-scene", default=None, nargs="+", metavar="SCENE", help="evaluate in these too, and keep the best model")
    add("--eval-every", default=150_000, type=int, help="environment steps between two evaluations")
    add("--recording", default=None, type=Path, help="the Rerun recording (.rrd) of some episodes; none when omitted")
    add("--experiment", default=None, help="of MLflow (default: MLFLOW_EXPERIMENT_NAME, else avp)")
    add("--run-name", default=None, help="of the MLflow run")
    return parser


def _preset(options: argparse.Namespace) -> Preset:
    """PPO's settings; the buffer is shared by as many agents as asked for."""
    TaskSettings(observation=options.observation)
    if options.steps < 1:
        raise UsageError(f"--steps: expected at least 1, got {options.steps}")
    if options.eval_every < 1:
        raise UsageError(f"--eval-every: expected at least 1, got {options.eval_every}")
    preset = PRESETS.get(options.observation, MAP)
    buffer = preset.n_envs * preset.n_steps
    agents = preset.n_envs if options.agents is None else options.agents
    if agents < 1 or buffer % agents:
        raise UsageError(f"--agents: expected a divisor of PPO's buffer of {buffer} steps, got {agents}")
    return replace(preset, n_envs=agents, n_steps=buffer // agents)


def _environment(options: argparse.Namespace, preset: Preset, choice: SimulatorChoice) -> Any:
    """The agents in this process, or in several: when asked for, and where each scene needs its own simulator."""
    from stable_baselines3.common.vec_env import VecMonitor

    from avp_sb3 import AVPSubprocVecEnv, AVPVecEnv

    settings = TaskSettings(
        reward=options.reward,
        observation=options.observation,
        lookup=not options.rays and choice.single_rays,
        width=options.width,
        height=options.height,
    )
    common = {"agents": preset.n_envs, "settings": settings, "seed": options.seed}
    common |= {"simulator": choice.simulator, "gpu": choice.gpu, "navmesh": choice.navmesh, "up": choice.up}
    if options.workers is None and (len(options.scene) == 1 or not choice.one_per_process):
        return VecMonitor(AVPVecEnv(options.scene, **common))
    return VecMonitor(AVPSubprocVecEnv(options.scene, workers=options.workers, **common))


def _model(options: argparse.Namespace, preset: Preset, env: Any) -> Any:
    if options.resume is None:
        from gymnasium import spaces
        from stable_baselines3 import PPO

        policy = "MultiInputPolicy" if isinstance(env.observation_space, spaces.Dict) else "MlpPolicy"
        return PPO(policy, env, device="cpu", seed=options.seed, **preset.arguments())
    with tempfile.TemporaryDirectory() as folder:
        path = _resumed_file(options.resume, folder)
        try:
            model = load_model(path, env=_normalised(path, env, options.trusted), trusted=options.trusted)
        except ValueError as error:
            raise UsageError(f"--resume {options.resume}: does not fit these options: {error}") from None
    if model.num_timesteps >= options.steps:
        raise UsageError(f"--steps: {options.resume} has {model.num_timesteps} already; expected more")
    return model


def _normalised(path: Path, env: Any, trusted: bool) -> Any:
    """The environment as the model's training had it: under `VecNormalize` with its statistics, or as it is."""
    statistics = statistics_of(path)
    if statistics is None:
        return env
    normalised = load_statistics(statistics, env.observation_space, trusted=trusted)
    normalised.set_venv(env)
    return normalised


def _resumed_file(resume: str, folder: str) -> Path:
    if not resume.startswith(_MLFLOW):
        if not Path(resume).is_file():
            raise UsageError(f"--resume {resume}: no such model file")
        return Path(resume)
    import mlflow
    from mlflow.artifacts import download_artifacts
    from mlflow.exceptions import MlflowException

    from avp_habitat.tracking.stores import DEFAULT_ADDRESS, first_line, is_missing, shown

    address = mlflow.get_tracking_uri() if mlflow.is_tracking_uri_set() else DEFAULT_ADDRESS
    if is_missing(address):
        raise UsageError(f"--resume {resume}: no MLflow database at {shown(address)}; set MLFLOW_TRACKING_URI")
    try:
        found = download_artifacts(artifact_uri=resume, dst_path=folder, tracking_uri=address)
    except (MlflowException, OSError) as error:
        raise UsageError(f"--resume {resume}: not found at {shown(address)}: {first_line(error)}") from None
    if not Path(found).is_file():
        raise UsageError(f"--resume {resume}: expected a model file, found a folder; add /model.zip")
    if is_normalised(Path(found)):
        beside = resume.removesuffix(".zip") + _STATISTICS
        try:
            download_artifacts(artifact_uri=beside, dst_path=folder, tracking_uri=address)
        except (MlflowException, OSError):
            raise UsageError(
                f"--resume {resume}: trained under VecNormalize, but its statistics {beside} are not with the run"
            ) from None
    return Path(found)


def _callbacks(options: argparse.Namespace, choice: SimulatorChoice, tracking: Any) -> list[Any]:
    from avp_sb3 import EvaluationCallback, MetricsCallback, RerunCallback

    callbacks: list[Any] = []
    # First, so that scenes that cannot be opened leave no empty run behind.
    if options.eval_scene is not None:
        best = options.out.with_stem(f"{options.out.stem}-best")
        where = {"simulator": choice.simulator, "gpu": choice.gpu, "up": choice.up}
        callbacks.append(EvaluationCallback(options.eval_scene, every=options.eval_every, best_model=best, **where))
    callbacks += [MetricsCallback(), tracking]
    if options.recording is not None:
        callbacks.append(RerunCallback(options.recording))
    return callbacks


def main(argv: Sequence[str]) -> None:
    """Train, track and save."""
    options = _parser().parse_args(argv)
    preset = _preset(options)
    choice = simulator_choice(options)
    check_writable(options.out)
    print(f"opening {', '.join(options.scene)} …", flush=True)

    # Late, so that --help and a mistyped option answer at once.
    import torch

    from avp_sb3 import MLflowCallback
    from avp_sb3.callbacks.best_model import save_model

    # The policy is a small network: more threads of torch only wait for each other.
    torch.set_num_threads(1)
    env = _environment(options, preset, choice)
    model = _model(options, preset, env)
    tracking = MLflowCallback(options.experiment, run_name=options.run_name)
    callbacks = _callbacks(options, choice, tracking)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    begun = model.num_timesteps
    done = False
    try:
        with tracking:
            # With reset_num_timesteps=False, SB3 counts the steps from where the model stands.
            model.learn(
                options.steps - begun, callback=callbacks, progress_bar=True, reset_num_timesteps=options.resume is None
            )
        done = True
    finally:
        if model.num_timesteps > begun:
            save_model(model, options.out)
            print(f"{options.out}: the policy after {model.num_timesteps} steps; MLflow run {tracking.run_id}")
            if not done:
                again = shlex.join(["python", "-m", "avp_sb3.train", *argv, "--resume", str(options.out)])
                print(f"to go on:  {again}")
        env.close()


if __name__ == "__main__":
    sys.exit(command.run(main))
