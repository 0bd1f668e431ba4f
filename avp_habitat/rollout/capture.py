"""Filling a rollout folder from a running `AVPEnv`: its views, its steps and what `rollout.json` says about them."""

from collections.abc import Callable
from dataclasses import asdict
from datetime import UTC, datetime
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avp_habitat import poses
from avp_habitat.errors import SceneError
from avp_habitat.metrics import measured
from avp_habitat.navigation.area import NavigableArea
from avp_habitat.plugins import name_of
from avp_habitat.poses import Intrinsics
from avp_habitat.provenance import installed_versions
from avp_habitat.rollout.drawing import draw_trajectory
from avp_habitat.rollout.format import Rollout
from avp_habitat.rollout.images import write_numbers, write_rgb
from avp_habitat.rollout.seen import visibility_of
from avp_habitat.rollout.writing import RolloutWriter
from avp_habitat.simulators.base import Simulator
from avp_habitat.task.env import AVPEnv
from avp_habitat.task.settings import ACTION_NAMES
from avp_habitat.task.trajectory import Trajectory

VIEWS = 20
"""Held-out views of a rollout."""
PITCH_DEG = 20.0
"""Their greatest pitch, either way."""
MIN_MEAN_DEPTH_M = 1.0
"""A view that sees no farther on average has its nose on a wall."""

_TRIES = 2000
_VERSIONED = ("avp-suite", "numpy", "gymnasium", "open3d", "pillow", "stable-baselines3", "torch")
_FLOOR_FILE = "floor.png"


def heldout_seed(scene_digest: str) -> int:
    """The fixed seed of a scene's held-out views, from the digest of its content."""
    return int(scene_digest[:16], 16)


def heldout_poses(simulator: Simulator, *, sensor_height_m: float, views: int = VIEWS) -> NDArray[np.float64]:
    """Poses uniform over the navigable area, any yaw, pitch within ±20°, that see at least 1 m far on average.

    Args:
        simulator: of the scene.
        sensor_height_m: above the floor, metres.
        views: how many.

    Returns:
        `(views, 4, 4)` habitat camera_to_world; the same for the same scene, always.

    Raises:
        SceneError: the scene is too narrow for such views.
    """
    rng = np.random.default_rng(heldout_seed(simulator.scene_digest))
    camera = Intrinsics.from_hfov(32, 24, hfov_deg=90.0)
    found: list[NDArray[np.float64]] = []
    for _ in range(_TRIES):
        position = simulator.area.random_points(rng, 1) + np.array([0.0, sensor_height_m, 0.0])
        yaw, pitch = rng.uniform(-np.pi, np.pi, 1), np.radians(rng.uniform(-PITCH_DEG, PITCH_DEG, 1))
        pose = poses.camera_to_world(position, yaw=yaw, pitch=pitch)
        if simulator.render(pose, camera, rgb=False).depth.mean() >= MIN_MEAN_DEPTH_M:
            found.append(pose[0])
        if len(found) == views:
            return np.stack(found)
    raise SceneError(
        f"{simulator.scene}: found only {len(found)} of {views} held-out views that see at least "
        f"{MIN_MEAN_DEPTH_M} m far on average; is the scene in metres?"
    )


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
    frames, views = writer.views(heldout=False), writer.views(heldout=True)
    rollout = Rollout(writer.path(""), _scene_and_task(env, heldout), writer.intrinsics, frames, views)
    metrics = info["avp_episode"] | _visibility(rollout) | measured(env.settings.metrics, "rollout", rollout)
    about = {"policy": policy, "seed": seed, "metrics": metrics, "floor": floor, "mlflow_run_id": mlflow_run_id}
    writer.publish(rollout.meta | about)
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


def _visibility(rollout: Rollout) -> dict[str, float]:
    """From the files, in whole millimetres, so that the figure is the one that a reader of the folder computes."""
    if not rollout.heldout:
        return {}
    found = visibility_of(rollout.frames, rollout.heldout, rollout.intrinsics).figures()
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
        "reward": name_of(settings.reward),
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
