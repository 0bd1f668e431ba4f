"""Filling a rollout folder from a running `AVPEnv`: its views, its steps and what `rollout.json` says about them."""

from collections.abc import Callable
from dataclasses import asdict
from datetime import UTC, datetime
from typing import Any

import numpy as np

from avp_habitat.drawing import draw_trajectory
from avp_habitat.env import AVPEnv
from avp_habitat.heldout import heldout_poses, heldout_seed
from avp_habitat.images import write_numbers, write_rgb
from avp_habitat.navigation.area import NavigableArea
from avp_habitat.rollout_visibility import visibility_of
from avp_habitat.rollout_writer import RolloutWriter
from avp_habitat.settings import ACTION_NAMES
from avp_habitat.trajectory import Trajectory
from avp_habitat.versions import installed_versions

_VERSIONED = ("avp-suite", "numpy", "gymnasium", "open3d", "pillow", "stable-baselines3", "torch")
_FLOOR_FILE = "floor.png"


def capture_step(env: AVPEnv, writer: RolloutWriter, action: int, reward: float, info: dict[str, Any]) -> None:
    """Write the picture, depth, pose and table row of the step that the environment has just done.

    Args:
        env: the environment, not wrapped.
        writer: an entered one; its camera takes the picture.
        action: number of the step's action.
        reward: of the step.
        info: of the step.
    """
    pose = env.camera_to_world
    frames = env.capture(pose[None], writer.intrinsics)
    assert frames.rgb is not None
    writer.add_frame(frames.rgb[0], frames.depth[0], pose)
    writer.add_step(_step_row(env, action, reward, info))


def capture_heldout(
    env: AVPEnv, writer: RolloutWriter, views: int, *, progress: Callable[[], object] = lambda: None
) -> None:
    """Write the scene's held-out views.

    Args:
        env: the environment, not wrapped.
        writer: an entered one; its camera takes the pictures.
        views: how many, 0 for none.
        progress: called after each view.
    """
    if not views:
        return
    poses = heldout_poses(env.simulator, sensor_height_m=env.settings.sensor_height_m, views=views)
    for pose in poses:
        frames = env.capture(pose[None], writer.intrinsics)
        assert frames.rgb is not None
        writer.add_heldout(frames.rgb[0], frames.depth[0], pose)
        progress()


def publish_rollout(
    env: AVPEnv,
    writer: RolloutWriter,
    info: dict[str, Any],
    *,
    policy: dict[str, Any],
    seed: int | None,
    heldout: int,
    mlflow_run_id: str | None = None,
) -> dict[str, Any]:
    """Draw the trajectory and the floor, measure what was seen, and publish the folder.

    Args:
        env: the environment, not wrapped.
        writer: holds all frames, steps and held-out views.
        info: of the episode's last step.
        policy: `rollout.json`'s entry of that name.
        seed: of the episode's start; None when it was not seeded itself.
        heldout: number of held-out views written.
        mlflow_run_id: of the training that the policy comes from.

    Returns:
        The metrics of `rollout.json`, those of the episode and `visibility` where held-out views show a surface.
    """
    write_rgb(writer.path("trajectory.png"), draw_trajectory(env.area, info["avp_trajectory"]))
    floor = _write_floor(env.area, info["avp_trajectory"], writer)
    metrics = info["avp_episode"] | _visibility(writer)
    about = {"policy": policy, "seed": seed, "metrics": metrics, "floor": floor, "mlflow_run_id": mlflow_run_id}
    writer.publish(_scene_and_task(env, heldout) | about)
    return metrics


def _write_floor(area: NavigableArea, trajectory: Trajectory, writer: RolloutWriter) -> dict[str, Any]:
    """`rollout.json`'s entry; the picture holds 0 not navigable, 1 never observed, 1 + t first observed by view t."""
    numbers = np.zeros(area.mask.shape, dtype=np.uint16)
    numbers[area.mask] = 1 + trajectory.first_seen
    write_numbers(writer.path(_FLOOR_FILE), numbers)
    return {
        "file": _FLOOR_FILE,
        "cell_m": area.cell_m,
        "origin_m": [float(value) for value in area.origin],
        "shape": list(area.mask.shape),
    }


def _visibility(writer: RolloutWriter) -> dict[str, float]:
    """From the files, in whole millimetres, so that the figure is the one that a reader of the folder computes."""
    heldout = writer.views(heldout=True)
    if not heldout:
        return {}
    found = visibility_of(writer.views(heldout=False), heldout, writer.intrinsics).figures()
    return {name: value for name, value in found.items() if name == "visibility"}


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


def _scene_and_task(env: AVPEnv, heldout: int) -> dict[str, Any]:
    settings, area = env.settings, env.area
    return {
        "scene": {"name": env.scene_name, "sha256": env.scene_digest, **asdict(env.simulator.scene_frame)},
        "simulator": {"name": env.simulator.name, "version": env.simulator.version},
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
        "heldout": {"views": heldout, "seed": str(heldout_seed(env.scene_digest))},
        "versions": installed_versions(_VERSIONED),
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
    }
