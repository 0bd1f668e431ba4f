"""`python -m avp_habitat.collect`: let a policy capture one episode of a scene into a rollout folder."""

import argparse
import os
import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tqdm import tqdm

from avp_habitat import command
from avp_habitat.command import progress
from avp_habitat.errors import RolloutError, UsageError
from avp_habitat.files import check_writable
from avp_habitat.gpu import nerfacto_line
from avp_habitat.policies.registry import (
    POLICY_NAMES,
    TRUSTED,
    Policy,
    check_policy,
    described,
    make_policy_env,
    steps_of,
)
from avp_habitat.poses import Intrinsics
from avp_habitat.rollout.capture import VIEWS, capture_heldout, capture_step, publish_rollout
from avp_habitat.rollout.writing import RolloutWriter
from avp_habitat.scenes.location import HELP as SCENES
from avp_habitat.simulators.registry import SimulatorChoice, add_simulator_options, open_simulator, simulator_choice
from avp_habitat.task.env import AVPEnv
from avp_habitat.task.rewards import REWARD_NAMES
from avp_habitat.task.settings import TaskSettings
from avp_habitat.tracking.experiments import DEFAULT_HELP
from avp_habitat.tracking.names import open_store
from avp_habitat.tracking.rollout_run import command_for, rollout_run
from avp_habitat.tracking.stores import TrackingError, about_run, address_of, shown


@dataclass(frozen=True)
class Request:
    """What to collect."""

    scene: str | Path
    """As `avp_habitat.scenes.location.locate` takes it."""
    policy: str
    """A baseline's name, or a PPO model (`.zip`)."""
    out: Path
    """The rollout folder; must not exist."""
    settings: TaskSettings
    """Of the task."""
    seed: int = 0
    """Of the start and of policies that draw at random."""
    simulator: SimulatorChoice = field(default_factory=SimulatorChoice)
    """Which simulator opens the scene."""
    camera: Intrinsics = field(default_factory=lambda: Intrinsics.from_hfov(640, 480, hfov_deg=90.0))
    """Of the pictures that are written."""
    stochastic: bool = False
    """Sample a model's actions instead of taking the likeliest."""
    trusted: bool = False
    """Open a model's file also where that may run code which the file holds."""
    heldout: int = VIEWS
    """Number of held-out views."""


def collect(request: Request) -> dict[str, Any]:
    """Collect one rollout.

    Returns:
        The metrics written to `rollout.json`, which are those of `trajectory.episode_metrics`, and visibility.

    Raises:
        UsageError: a name is unknown or the folder exists.
        AVPError: the scene, the simulator, the policy or the disk cannot be used; nothing is left behind.
    """
    check_policy(request.policy)
    with RolloutWriter(request.out, request.camera) as writer:
        simulator = open_simulator(request.simulator, request.scene)
        env, policy = make_policy_env(
            request.policy, simulator, request.settings, seed=request.seed, trusted=request.trusted
        )
        total = request.settings.budget + request.heldout
        with progress(total=total, unit="view", desc=f"collecting {request.out}") as bar:
            info = _capture_episode(request, env, policy, writer, bar)
            capture_heldout(env, writer, request.heldout, progress=bar.update)
        return publish_rollout(
            env,
            writer,
            info,
            policy={"name": Path(request.policy).name, "deterministic": not request.stochastic},
            seed=request.seed,
            heldout=request.heldout,
            mlflow_run_id=getattr(policy, "avp_mlflow_run_id", None) or os.environ.get("MLFLOW_RUN_ID"),
        )


def _capture_episode(request: Request, env: AVPEnv, policy: Policy, writer: RolloutWriter, bar: tqdm) -> dict[str, Any]:
    """The `info` of the last step."""
    info: dict[str, Any] = {}
    for step in steps_of(env, policy, seed=request.seed, deterministic=not request.stochastic):
        info = step.info
        capture_step(env, writer, step.action, step.reward, info)
        bar.update()
    bar.total -= request.settings.budget - info["views"]
    return info


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m avp_habitat.collect",
        description="Let a policy capture one episode of a scene: pictures, depth, poses, coverage, held-out views. "
        "Takes about a minute on two CPU cores; the policies that plan (greedy, oracle, survey) take longer.",
    )
    add = parser.add_argument
    add("--scene", required=True, help=SCENES)
    add("--policy", required=True, metavar="POLICY", help=f"{', '.join(POLICY_NAMES)}, or a PPO model (.zip)")
    add("--out", required=True, type=Path, help="the rollout folder to write; must not exist")
    add("--reward", default="proposed", metavar="REWARD", help=f"{', '.join(REWARD_NAMES)} (default: %(default)s)")
    add_simulator_options(parser)
    add("--seed", default=0, type=int, help="of the start and of random policies (default: %(default)s)")
    add("--budget", default=80, type=int, help="steps, which are views (default: %(default)s)")
    add("--width", default=640, type=int, help="of the pictures in pixels (default: %(default)s)")
    add("--height", default=480, type=int, help="of the pictures in pixels (default: %(default)s)")
    add("--stochastic", action="store_true", help="sample a model's actions instead of taking the likeliest")
    add("--trusted", action="store_true", help=TRUSTED)
    add(
        "--mlflow",
        default="auto",
        metavar="ADDRESS",
        help="log the rollout as an MLflow run below that of the policy's training, at an address such as "
        "sqlite:///mlflow.db; auto: MLFLOW_TRACKING_URI if that is set, else nowhere; off: nowhere "
        "(default: %(default)s)",
    )
    add(
        "--experiment",
        metavar="NAME",
        help=f"MLflow experiment of the run when that of the policy's training is not there (default: {DEFAULT_HELP})",
    )
    return parser


def _request(options: argparse.Namespace) -> Request:
    for name in ("width", "height"):
        if not 8 <= getattr(options, name) <= 8192:
            raise UsageError(f"--{name}: expected 8 to 8192 pixels, got {getattr(options, name)}")
    if options.seed < 0:
        raise UsageError(f"--seed: expected a whole number from 0, got {options.seed}")
    settings = TaskSettings(reward=options.reward, budget=options.budget)
    return Request(
        scene=options.scene,
        policy=options.policy,
        out=options.out,
        settings=settings,
        seed=options.seed,
        simulator=simulator_choice(options),
        camera=Intrinsics.from_hfov(options.width, options.height, hfov_deg=settings.hfov_deg),
        stochastic=options.stochastic,
        trusted=options.trusted,
    )


def _track(out: Path, option: str, experiment: str | None) -> None:
    """Log the rollout; a store that fails is a warning, because the rollout is complete and can be logged later."""
    address = address_of(option, default=None)
    if address is None:
        return
    try:
        print(about_run(rollout_run(address, out, experiment=experiment), address))
    except TrackingError as error:
        later = command_for(out, option, experiment)
        print(f"warning: {error}; the rollout is complete, log it later: {later}", file=sys.stderr)


def main(argv: Sequence[str]) -> None:
    """Collect one rollout; print its figures and what to run next."""
    options = _parser().parse_args(argv)
    request = _request(options)
    check_policy(request.policy)
    check_writable(request.out, failure=RolloutError)
    print(f"opening {request.scene} for {described(request.policy)} …", flush=True)
    if options.mlflow not in ("auto", "off"):
        open_store(options.mlflow)
    episode = collect(request)
    out = shlex.quote(str(request.out))
    print(f"{request.out}: {episode['views']:.0f} views, coverage {100 * episode['coverage']:.1f} %")
    for name, value in episode.items():
        print(f"  {name:<20} {value:.4g}")
    _track(request.out, options.mlflow, options.experiment)
    print(f"look:         {out}/trajectory.png")
    track = "" if options.mlflow in ("auto", "off") else f" --mlflow {shlex.quote(shown(options.mlflow))}"
    print(f"reconstruct:  ns-train avp-nerfacto --data {out}{track}")
    print(f"         or:  {nerfacto_line(out)}")


if __name__ == "__main__":
    sys.exit(command.run(main))
