"""Filling rollout folders from a running `AVPEnv`, also below any program that steps `AVP-v0` (`RecordRollout`)."""

import multiprocessing
import os
import sys
import weakref
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, SupportsFloat

import gymnasium
import numpy as np
from numpy.typing import NDArray

from avp_habitat.errors import AVPError, UsageError
from avp_habitat.files import check_new
from avp_habitat.geometry.scores import rollout_figures
from avp_habitat.geometry.truth import scene_truth
from avp_habitat.metrics import measured
from avp_habitat.navigation.area import NavigableArea
from avp_habitat.plugins import name_of
from avp_habitat.poses import Intrinsics
from avp_habitat.provenance import installed_versions
from avp_habitat.rollout.drawing import draw_trajectory
from avp_habitat.rollout.format import Rollout
from avp_habitat.rollout.images import write_numbers, write_rgb
from avp_habitat.rollout.origin import task_of
from avp_habitat.rollout.seen import visibility_of
from avp_habitat.rollout.writing import RolloutWriter
from avp_habitat.sight.heldout import VIEWS, HeldoutKind, chosen_poses, heldout_seed
from avp_habitat.task.env import AVPEnv
from avp_habitat.task.settings import ACTION_NAMES
from avp_habitat.task.trajectory import Trajectory

_VERSIONED = ("avp-suite", "numpy", "gymnasium", "open3d", "pillow", "stable-baselines3", "torch")
_FLOOR_FILE = "floor.png"


def capture_step(env: AVPEnv, writer: RolloutWriter, action: int, reward: float, info: dict[str, Any]) -> None:
    """Write the picture, depth, pose and table row of the step that the environment, not wrapped, has just done."""
    writer.add_frame(*_pictured(env, writer, env.camera_to_world))
    writer.add_step(_step_row(env, action, reward, info))


def capture_heldout(
    env: AVPEnv,
    writer: RolloutWriter,
    views: int,
    *,
    kind: HeldoutKind = "standard",
    progress: Callable[[], object] = lambda: None,
) -> None:
    """Write so many held-out views of the scene, of a kind; `progress` is called after each."""
    if not views:
        return
    for pose in chosen_poses(kind, env.simulator, env.settings, views):
        writer.add_heldout(*_pictured(env, writer, pose))
        progress()


def _pictured(env: AVPEnv, writer: RolloutWriter, pose: NDArray[np.float64]) -> tuple[NDArray, NDArray, NDArray]:
    frames = env.capture(pose[None], writer.intrinsics)
    assert frames.rgb is not None
    return frames.rgb[0], frames.depth[0], pose


def publish_rollout(
    env: AVPEnv,
    writer: RolloutWriter,
    info: dict[str, Any],
    *,
    policy: dict[str, Any],
    seed: int | None,
    heldout: int,
    mlflow_run_id: str | None = None,
    geometry: Sequence[int] | None = None,
    kind: HeldoutKind = "standard",
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
        kind: of the held-out views.
        geometry: None, or measure how true the fused depth is, also of the first so many views; takes some seconds.

    Returns:
        The metrics of `rollout.json`: those of the episode, where held-out views show a surface `visibility` and
        `visibility_parallax`, and `metrics.GEOMETRY` where asked for and the pictures show any surface.

    Raises:
        SimulatorError: geometry is asked for, and the simulator gives no mesh.
    """
    write_rgb(writer.path("trajectory.png"), draw_trajectory(env.area, info["avp_trajectory"]))
    floor = _write_floor(env.area, info["avp_trajectory"], writer)
    frames, views = writer.views(heldout=False), writer.views(heldout=True)
    rollout = Rollout(writer.path(""), _scene_and_task(env, heldout, kind), writer.intrinsics, frames, views)
    # From the files, in whole millimetres, so that the figure is the one that a reader of the folder computes.
    seen = visibility_of(frames, views, writer.intrinsics).figures() if views else {}
    visibility = {name: seen[name] for name in ("visibility", "visibility_parallax") if name in seen}
    shape, after = {}, {}
    if geometry is not None:
        shape, after = rollout_figures(rollout, scene_truth(env.simulator, task_of(rollout)), geometry)
    metrics = info["avp_episode"] | visibility | shape | measured(env.settings.metrics, "rollout", rollout)
    about = {"policy": policy, "seed": seed, "metrics": metrics, "floor": floor, "mlflow_run_id": mlflow_run_id}
    about |= {"geometry_after": {str(count): figures for count, figures in after.items()}} if after else {}
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
        **{f"{axis}_m": f"{value:.6f}" for axis, value in zip("xyz", position, strict=True)},
        "yaw_rad": f"{yaw:.9f}",
        "pitch_rad": f"{pitch:.9f}",
    }


def _scene_and_task(env: AVPEnv, heldout: int, kind: HeldoutKind) -> dict[str, Any]:
    settings, area = env.settings, env.area
    return {
        "scene": {"name": env.scene_name, "sha256": env.scene_digest, **asdict(env.simulator.scene_frame)},
        "simulator": {"name": env.simulator.name, "version": env.simulator.version},
        "reward": name_of(settings.reward),
        "reward_constants": asdict(settings.constants),
        "budget": settings.budget,
        "actions": {
            "names": list(ACTION_NAMES),
            **{name: getattr(settings, name) for name in ("forward_m", "turn_deg", "tilt_deg", "pitch_limit_deg")},
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
        "heldout": {"views": heldout, "kind": kind, "seed": str(heldout_seed(env.scene_digest))},
        "versions": installed_versions(_VERSIONED),
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
    }


class RecordRollout(gymnasium.Wrapper, gymnasium.utils.RecordConstructorArgs):
    """Writes the first finished episodes as rollout folders and changes nothing else.

    An episode that is abandoned (by another `reset` or by `close`) leaves no folder.
    """

    def __init__(
        self,
        env: gymnasium.Env,
        folder: str | Path,
        *,
        episodes: int = 1,
        heldout: int = VIEWS,
        width: int = 640,
        height: int = 480,
        policy: str = "not named",
    ) -> None:
        """Wrap an environment.

        Args:
            env: an `AVPEnv`, also a wrapped one.
            folder: of the first episode; the k-th later one goes to `FOLDER-k`, counted from 2. None may exist.
            episodes: how many to record, at least 1.
            heldout: number of held-out views in each folder.
            width: of the pictures in pixels.
            height: of the pictures in pixels.
            policy: what `rollout.json` calls the policy; the environment cannot know it.

        Raises:
            UsageError: not an `AVPEnv`, fewer than one episode, pictures of no size, or a folder exists.
        """
        gymnasium.utils.RecordConstructorArgs.__init__(
            self, folder=folder, episodes=episodes, heldout=heldout, width=width, height=height, policy=policy
        )
        super().__init__(env)
        if not isinstance(env.unwrapped, AVPEnv):
            raise UsageError(f"RecordRollout: expected an AVPEnv, got {type(env.unwrapped).__name__}")
        if episodes < 1:
            raise UsageError(f"RecordRollout: episodes: expected at least 1, got {episodes}")
        self._avp = env.unwrapped
        self._camera = Intrinsics.from_hfov(width, height, hfov_deg=self._avp.settings.hfov_deg)
        self._heldout = heldout
        self._policy = policy
        first = Path(folder)
        later = [first.with_name(f"{first.name}-{number}") for number in range(2, episodes + 1)]
        self._targets = [first, *later]
        for target in self._targets:
            check_new(target)
        self._seed: int | None = None
        self._writer: RolloutWriter | None = None
        self._open = ExitStack()
        # Programs that never call close() leave no temporary folder either.
        weakref.finalize(self, self._open.close)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start an episode, recorded if there are folders left to write."""
        self._drop()
        answer = self.env.reset(seed=seed, options=options)
        self._seed = seed
        if self._targets:
            self._writer = self._open.enter_context(RolloutWriter(self._targets[0], self._camera))
        return answer

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """Do one action and record its view."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        if self._writer is not None:
            try:
                self._record(self._writer, int(action), float(reward), info, ended=terminated or truncated)
            except BaseException:
                # The writer removes what it has written, and says it when the disk was at fault.
                self._writer = None
                self._open.__exit__(*sys.exc_info())
                raise
        return observation, reward, terminated, truncated, info

    def close(self) -> None:
        """Drop an unfinished recording and close the environment."""
        self._drop()
        super().close()

    def _drop(self) -> None:
        self._open.close()
        self._writer = None

    def _record(self, writer: RolloutWriter, action: int, reward: float, info: dict[str, Any], *, ended: bool) -> None:
        capture_step(self._avp, writer, action, reward, info)
        if not ended:
            return
        capture_heldout(self._avp, writer, self._heldout)
        publish_rollout(
            self._avp,
            writer,
            info,
            policy={"name": self._policy},
            seed=self._seed,
            heldout=self._heldout,
            mlflow_run_id=os.environ.get("MLFLOW_RUN_ID"),
        )
        episode = info["avp_episode"]
        print(f"{writer.folder}: {episode['views']:.0f} views, coverage {100 * episode['coverage']:.1f} %")
        del self._targets[0]
        self._drop()


def make_env(*, record: str | Path | None = None, record_options: dict[str, Any] | None = None, **kwargs: Any) -> Any:
    """`AVP-v0` as gymnasium makes it: an `AVPEnv`, within a `RecordRollout` where the folder `record` is given.

    The record's options are further arguments of `RecordRollout`, for example `{"episodes": 3}`.

    Raises:
        AVPError: as `AVPEnv` and `RecordRollout`, or options for a recording without a folder.
        SystemExit: instead in a worker of SB3's `SubprocVecEnv`, which then ends with one line.
    """
    try:
        if record is None and record_options:
            raise UsageError("record_options: expected a folder as `record` with them, got none")
        env = AVPEnv(**kwargs)
        return env if record is None else RecordRollout(env, record, **(record_options or {}))
    except AVPError as error:
        worker = getattr(multiprocessing.current_process(), "_target", None)
        if getattr(worker, "__module__", None) == "stable_baselines3.common.vec_env.subproc_vec_env":
            raise SystemExit(f"error: {error}") from None
        raise


# Gymnasium reads the render modes from the entry point.
make_env.metadata = AVPEnv.metadata  # type: ignore[attr-defined]
