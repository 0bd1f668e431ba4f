"""`python -m avp_habitat.collect`: let a policy capture one episode of a scene into a rollout folder."""

import argparse
import os
import shlex
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from avp_habitat import command
from avp_habitat.drawing import draw_trajectory
from avp_habitat.env import AVPEnv
from avp_habitat.errors import UsageError
from avp_habitat.heldout import VIEWS, heldout_poses, heldout_seed
from avp_habitat.images import write_rgb
from avp_habitat.policies import POLICY_NAMES, Policy, check_policy, make_policy
from avp_habitat.poses import Intrinsics
from avp_habitat.rewards import REWARD_NAMES
from avp_habitat.rollout_writer import RolloutWriter
from avp_habitat.settings import ACTION_NAMES, TaskSettings
from avp_habitat.simulators import SIMULATOR_NAMES, make_simulator
from avp_habitat.versions import installed_versions

_VERSIONED = ("avp-suite", "numpy", "gymnasium", "open3d", "pillow", "stable-baselines3", "torch")
_HELDOUT_BATCH = 4


@dataclass(frozen=True)
class Request:
    """What to collect."""

    scene: str
    """A mesh file, or `builtin:SEED`."""
    policy: str
    """A baseline's name, or a PPO model (`.zip`)."""
    out: Path
    """The rollout folder; must not exist."""
    settings: TaskSettings
    """Of the task."""
    seed: int = 0
    """Of the start and of policies that draw at random."""
    simulator: str = "raycast"
    """The simulator's name."""
    camera: Intrinsics = field(default_factory=lambda: Intrinsics.from_hfov(640, 480, hfov_deg=90.0))
    """Of the pictures that are written."""
    stochastic: bool = False
    """Sample a model's actions instead of taking the likeliest."""
    heldout: int = VIEWS
    """Number of held-out views."""


def collect(request: Request) -> dict[str, Any]:
    """Collect one rollout.

    Returns:
        The metrics written to `rollout.json`: coverage, views, annd_m, ei, … (see `task.episode_metrics`).

    Raises:
        UsageError: a name is unknown or the folder exists.
        AVPError: the scene, the simulator, the policy or the disk cannot be used; nothing is left behind.
    """
    check_policy(request.policy)
    with RolloutWriter(request.out, request.camera) as writer:
        simulator = make_simulator(request.simulator, request.scene)
        env = AVPEnv(request.scene, simulator=simulator, settings=request.settings)
        policy = make_policy(request.policy, env, request.seed)
        total = request.settings.budget + request.heldout
        with tqdm(total=total, unit="view", desc=f"collecting {request.out}", disable=None) as progress:
            episode, trajectory = _capture_episode(request, env, policy, writer, progress)
            _capture_heldout(request, env, writer, progress)
        write_rgb(writer.path("trajectory.png"), draw_trajectory(env.area, trajectory))
        writer.publish(_meta(request, env, policy, episode))
    return episode


def _capture_episode(request: Request, env: AVPEnv, policy: Policy, writer: RolloutWriter, progress: tqdm) -> Any:
    observation, _ = env.reset(seed=request.seed)
    state: Any = None
    first = True
    while True:
        action, state = policy.predict(observation, state, np.array([first]), deterministic=not request.stochastic)
        observation, reward, terminated, truncated, info = env.step(int(action))
        first = False
        pose = env.camera_to_world
        frames = env.capture(pose[None], request.camera)
        assert frames.rgb is not None
        writer.add_frame(frames.rgb[0], frames.depth[0], pose)
        writer.add_step(_step_row(env, int(action), reward, info))
        progress.update()
        if terminated or truncated:
            progress.total -= request.settings.budget - info["views"]
            return info["avp_episode"], info["avp_trajectory"]


def _capture_heldout(request: Request, env: AVPEnv, writer: RolloutWriter, progress: tqdm) -> None:
    if not request.heldout:
        return
    poses = heldout_poses(env.simulator, sensor_height_m=request.settings.sensor_height_m, views=request.heldout)
    for batch in np.array_split(poses, -(-len(poses) // _HELDOUT_BATCH)):
        frames = env.capture(batch, request.camera)
        assert frames.rgb is not None
        for rgb, depth, pose in zip(frames.rgb, frames.depth, batch, strict=True):
            writer.add_heldout(rgb, depth, pose)
            progress.update()


def _step_row(env: AVPEnv, action: int, reward: float, info: dict[str, Any]) -> dict[str, Any]:
    position, yaw, pitch = env.agent_pose
    return {
        "step": info["views"],
        "action": ACTION_NAMES[action],
        "reward": f"{reward:.9g}",
        **{f"reward_{name}": f"{value:.9g}" for name, value in info["reward_parts"].items()},
        "coverage": f"{info['coverage']:.9g}",
        "new_cells": info["new_cells"],
        "collided": int(info["collided"]),
        "redundant": int(info["redundant"]),
        "x_m": f"{position[0]:.6f}",
        "y_m": f"{position[1]:.6f}",
        "z_m": f"{position[2]:.6f}",
        "yaw_rad": f"{yaw:.9f}",
        "pitch_rad": f"{pitch:.9f}",
    }


def _meta(request: Request, env: AVPEnv, policy: Policy, episode: dict[str, float]) -> dict[str, Any]:
    settings = request.settings
    area = env.area
    return {
        "scene": {"name": env.scene_name, "sha256": env.scene_digest},
        "simulator": {"name": env.simulator.name, "version": env.simulator.version},
        "policy": {"name": Path(request.policy).name, "deterministic": not request.stochastic},
        "seed": request.seed,
        "reward": settings.reward,
        "reward_constants": asdict(settings.constants),
        "budget": settings.budget,
        "actions": {
            "names": list(ACTION_NAMES),
            "forward_m": settings.forward_m,
            "turn_deg": settings.turn_deg,
            "tilt_deg": settings.tilt_deg,
            "pitch_limit_deg": settings.pitch_limit_deg,
        },
        "camera": {"hfov_deg": settings.hfov_deg, "height_above_floor_m": settings.sensor_height_m},
        "coverage": {
            "definition": "share of the navigable cells whose floor point is visible in a captured frame"
            if settings.coverage_mode == "visible"
            else "share of the navigable cells over which a camera ray of a captured frame passes",
            "mode": settings.coverage_mode,
            "cell_m": area.cell_m,
            "max_range_m": settings.max_range_m,
            "tolerance_m": settings.tolerance_m,
            "navigable_cells": len(area.centres),
            "navigable_area_m2": round(float(area.area_m2), 4),
        },
        "heldout": {"views": request.heldout, "seed": str(heldout_seed(env.scene_digest))},
        "metrics": episode,
        "versions": installed_versions(_VERSIONED),
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "mlflow_run_id": getattr(policy, "avp_mlflow_run_id", None) or os.environ.get("MLFLOW_RUN_ID"),
    }


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m avp_habitat.collect",
        description="Let a policy capture one episode of a scene: pictures, depth, poses, coverage, held-out views.",
    )
    add = parser.add_argument
    add("--scene", required=True, help="a mesh (.glb .gltf .ply .obj), or builtin:SEED for a generated room")
    add("--policy", required=True, metavar="POLICY", help=f"{', '.join(POLICY_NAMES)}, or a PPO model (.zip)")
    add("--out", required=True, type=Path, help="the rollout folder to write; must not exist")
    add("--reward", default="proposed", metavar="REWARD", help=f"{', '.join(REWARD_NAMES)} (default: %(default)s)")
    add("--simulator", default="raycast", metavar="NAME", help=f"{', '.join(SIMULATOR_NAMES)} (default: %(default)s)")
    add("--seed", default=0, type=int, help="of the start and of random policies (default: %(default)s)")
    add("--budget", default=80, type=int, help="steps, which are views (default: %(default)s)")
    add("--width", default=640, type=int, help="of the pictures in pixels (default: %(default)s)")
    add("--height", default=480, type=int, help="of the pictures in pixels (default: %(default)s)")
    add("--stochastic", action="store_true", help="sample a model's actions instead of taking the likeliest")
    return parser


def _request(argv: Sequence[str]) -> Request:
    options = _parser().parse_args(argv)
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
        simulator=options.simulator,
        camera=Intrinsics.from_hfov(options.width, options.height, hfov_deg=settings.hfov_deg),
        stochastic=options.stochastic,
    )


def main(argv: Sequence[str]) -> None:
    """Collect one rollout; print its figures and what to run next."""
    request = _request(argv)
    episode = collect(request)
    out = shlex.quote(str(request.out))
    print(f"{request.out}: {episode['views']:.0f} views, coverage {100 * episode['coverage']:.1f} %")
    for name, value in episode.items():
        print(f"  {name:<20} {value:.4g}")
    print(f"look:         {out}/trajectory.png")
    print(f"reconstruct:  ns-train avp-nerfacto --data {out}")
    print(f"         or:  ns-train nerfacto avp-data --data {out}")


if __name__ == "__main__":
    sys.exit(command.run(main))
