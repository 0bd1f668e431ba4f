"""`python -m avp_habitat.collect`: let a policy capture one episode of a scene into a rollout folder."""

import os
import shlex
import sys
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import arg

from avp_habitat import command
from avp_habitat.command import progress
from avp_habitat.errors import AVPError, RolloutError, UsageError
from avp_habitat.files import check_writable
from avp_habitat.geometry.truth import scene_truth
from avp_habitat.metrics import METRICS_HELP
from avp_habitat.plugins import name_of
from avp_habitat.policies.registry import (
    POLICIES_HELP,
    TRUSTED,
    check_policy,
    described,
    learned_reward,
    make_policy_env,
    steps_of,
)
from avp_habitat.poses import Intrinsics
from avp_habitat.provenance import nerfacto_line
from avp_habitat.ranges import Range, hold_ranges
from avp_habitat.rollout.capture import capture_heldout, capture_step, publish_rollout
from avp_habitat.rollout.writing import RolloutWriter
from avp_habitat.scenes.location import HELP as SCENES
from avp_habitat.sight.heldout import VIEWS, HeldoutKind
from avp_habitat.simulators.base import Simulator
from avp_habitat.simulators.registry import SimulatorChoice, open_simulator
from avp_habitat.task.budget import BUDGET_HELP, Budget, budget_for
from avp_habitat.task.rewards import REWARDS_HELP
from avp_habitat.task.settings import OBSERVATIONS_HELP, TaskSettings
from avp_habitat.tracking.experiments import DEFAULT_HELP
from avp_habitat.tracking.rollout_run import command_for, rollout_run
from avp_habitat.tracking.stores import TrackingError, about_run, address_of, open_store, shown


@dataclass(frozen=True)
class Collect:
    """Let a policy capture one episode of a scene: pictures, depth, poses, coverage, held-out views.

    Takes about a minute on two CPU cores; the policies that plan (greedy, oracle, survey) take longer.
    """

    scene: Annotated[str, arg(help=SCENES)]
    policy: Annotated[str, arg(help=POLICIES_HELP)]
    out: Path
    """The rollout folder to write; must not exist."""
    reward: Annotated[str | None, arg(help=f"{REWARDS_HELP} (omitted: that of the policy's weights, or proposed)")] = (
        None
    )
    observation: Annotated[
        str | None,
        arg(help=f"{OBSERVATIONS_HELP} (omitted: the first that fits the policy)"),
    ] = None
    simulator: SimulatorChoice = field(default_factory=SimulatorChoice)
    """Which simulator opens the scene."""
    seed: Annotated[int, Range(0, 2**32 - 1)] = 0
    """Of the start and of policies that draw at random."""
    metrics: Annotated[tuple[str, ...], arg(help=METRICS_HELP)] = ()
    budget: Annotated[Budget, arg(help=BUDGET_HELP)] = 80
    width: Annotated[int, Range(8, 8192)] = 640
    """Of the pictures in pixels."""
    height: Annotated[int, Range(8, 8192)] = 480
    """Of the pictures in pixels."""
    heldout: HeldoutKind = "standard"
    """Held-out views: standard, pitched by up to 20 degrees; observable, by up to 45, where what they show can be seen
    from elsewhere too."""
    geometry: bool = False
    """Also measure how true the fused depth is (accuracy, completion …); takes ten seconds or more."""
    geometry_after: tuple[int, ...] = ()
    """With --geometry: also that of the first so many views."""
    stochastic: bool = False
    """Sample a model's actions instead of taking the likeliest."""
    trusted: Annotated[bool, arg(help=TRUSTED)] = False
    mlflow: str = "auto"
    """Log the rollout as an MLflow run below that of the policy's training, at an address such as sqlite:///mlflow.db;
    auto: MLFLOW_TRACKING_URI if that is set, else nowhere; off: nowhere."""
    experiment: Annotated[
        str | None, arg(help=f"MLflow's, where that of the policy's training is not there (omitted: {DEFAULT_HELP})")
    ] = None

    def __post_init__(self) -> None:
        """Hold the ranges."""
        hold_ranges(self)
        if self.geometry_after and (not self.geometry or min(self.geometry_after) < 1):
            raise UsageError(f"geometry_after: expected numbers from 1, and --geometry, got {self.geometry_after}")


def _settings(options: Collect, area_m2: float | None = None) -> TaskSettings:
    """Of the task; where the scene is not open yet, with any budget in place of `auto`."""
    reward = options.reward or learned_reward(options.policy) or TaskSettings.reward
    settings = TaskSettings(reward=reward, metrics=options.metrics)
    if options.budget == "auto" and area_m2 is None:
        return settings
    return replace(settings, budget=budget_for(options.budget, area_m2 or 0.0))


def collect(options: Collect, *, settings: TaskSettings | None = None, heldout: int = VIEWS) -> dict[str, Any]:
    """Collect one rollout, by other settings of the task and so many held-out views where these are given.

    Returns:
        The metrics written to `rollout.json`, which are those of `trajectory.episode_metrics`, and visibility.

    Raises:
        UsageError: a name is unknown or the folder exists.
        AVPError: the scene, the simulator, the policy or the disk cannot be used; nothing is left behind.
    """
    check_policy(options.policy)
    camera = Intrinsics.from_hfov(options.width, options.height, hfov_deg=(settings or TaskSettings).hfov_deg)
    with RolloutWriter(options.out, camera) as writer:
        simulator = open_simulator(options.simulator, options.scene)
        settings = settings or _settings(options, simulator.area.area_m2)
        measured = options.geometry and _knows_truth(simulator, settings, camera)
        env, policy = make_policy_env(
            options.policy,
            simulator,
            settings,
            seed=options.seed,
            observation=options.observation,
            trusted=options.trusted,
        )
        with progress(total=settings.budget + heldout, unit="view", desc=f"collecting {options.out}") as bar:
            info: dict[str, Any] = {}
            for step in steps_of(env, policy, seed=options.seed, deterministic=not options.stochastic):
                info = step.info
                capture_step(env, writer, step.action, step.reward, info)
                bar.update()
            bar.total -= settings.budget - info["views"]
            capture_heldout(env, writer, heldout, kind=options.heldout, progress=bar.update)
        return publish_rollout(
            env,
            writer,
            info,
            policy={"name": Path(name_of(options.policy)).name, "deterministic": not options.stochastic},
            seed=options.seed,
            heldout=heldout,
            kind=options.heldout,
            geometry=options.geometry_after if measured else None,
            mlflow_run_id=getattr(policy, "avp_mlflow_run_id", None) or os.environ.get("MLFLOW_RUN_ID"),
        )


def _knows_truth(simulator: Simulator, settings: TaskSettings, camera: Intrinsics) -> bool:
    """Whether geometry can be measured; said before anything is captured, where it cannot."""
    try:
        scene_truth(simulator, replace(settings, width=camera.width, height=camera.height))
    except AVPError as error:
        print(f"warning: geometry is left out: {error}", file=sys.stderr)
        return False
    return True


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


def main(options: Collect) -> None:
    """Collect one rollout; print its figures and what to run next."""
    _settings(options)
    check_policy(options.policy)
    check_writable(options.out, failure=RolloutError)
    print(f"opening {options.scene} for {described(options.policy)} …", flush=True)
    if options.mlflow not in ("auto", "off"):
        open_store(options.mlflow)
    episode = collect(options)
    out = shlex.quote(str(options.out))
    print(f"{options.out}: {episode['views']:.0f} views, coverage {100 * episode['coverage']:.1f} %")
    for name, value in episode.items():
        print(f"  {name:<20} {value:.4g}")
    _track(options.out, options.mlflow, options.experiment)
    print(f"look:         {out}/trajectory.png")
    track = "" if options.mlflow in ("auto", "off") else f" --mlflow {shlex.quote(shown(options.mlflow))}"
    print(f"reconstruct:  ns-train avp-nerfacto --data {out}{track}")
    print(f"         or:  {nerfacto_line(out)}")


if __name__ == "__main__":
    sys.exit(command.run(main))
