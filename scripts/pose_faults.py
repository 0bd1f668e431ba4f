"""The deliberate faults of the self-test: damaged copies of a rollout, consistent in all their files."""

import csv
import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from avp_habitat.poses import Intrinsics, camera_to_world, habitat_to_opencv, yaw_and_pitch
from avp_habitat.rollout.format import HELDOUT, Rollout, frame_name, read_rollout

Float = NDArray[np.floating]


@dataclass(frozen=True)
class Written:
    """What a damaged rollout says."""

    frames: Float
    """`(n, 4, 4)` of the captured frames."""
    heldout: Float
    """`(m, 4, 4)` of the held-out views."""
    intrinsics: Intrinsics
    """Of all."""


Damage = Callable[[Written, np.random.Generator], Written]
"""What a fault does to a correct rollout; the generator chooses frames and directions."""


@dataclass(frozen=True)
class Fault:
    """A deliberate fault."""

    name: str
    """For tables."""
    damage: Damage
    """Makes it."""
    named: str
    """A regular expression that the cause found must match."""


def damaged(rollout: Rollout, fault: Fault, *, seed: int = 0) -> Rollout:
    """A rollout with a fault in its poses and intrinsics; its files are as they were.

    Args:
        rollout: a correct one.
        fault: which one.
        seed: of faults that choose frames or directions.
    """
    right = Written(_stack(rollout, heldout=False), _stack(rollout, heldout=True), rollout.intrinsics)
    wrong = fault.damage(right, np.random.default_rng(seed))
    frames, heldout = (
        [replace(view, camera_to_world=pose) for view, pose in zip(views, poses, strict=True)]
        for views, poses in ((rollout.frames, wrong.frames), (rollout.heldout, wrong.heldout))
    )
    return replace(rollout, frames=frames, heldout=heldout, intrinsics=wrong.intrinsics)


def write_faulty(source: str | Path, target: Path, fault: Fault, *, seed: int = 0) -> Path:
    """Write a copy of a rollout with a fault; the pictures are linked where that is possible.

    The poses, `transforms.json`, `rollout.json` and the positions and angles in `steps.csv` all follow the fault, as
    they would had the program that wrote them been wrong.

    Args:
        source: a correct rollout.
        target: the folder to make.
        fault: which one.
        seed: of faults that choose frames or directions.
    """
    rollout = read_rollout(source)
    made = damaged(rollout, fault, seed=seed)
    wrong = Written(_stack(made, heldout=False), _stack(made, heldout=True), made.intrinsics)
    shutil.copytree(rollout.folder, target, copy_function=_link)
    for base, poses in ((target, wrong.frames), (target / HELDOUT, wrong.heldout)):
        for index, pose in enumerate(poses):
            rows = "\n".join(" ".join(f"{value:.9f}" for value in row) for row in pose)
            _replace(base / "poses" / f"{frame_name(index)}.txt", rows + "\n")
    _rewrite_meta(target / "rollout.json", wrong.intrinsics)
    _rewrite_transforms(target / "transforms.json", wrong)
    if (target / "steps.csv").exists():
        _rewrite_steps(target / "steps.csv", wrong.frames, rollout.meta)
    return target


def _stack(rollout: Rollout, *, heldout: bool) -> Float:
    views = rollout.heldout if heldout else rollout.frames
    return np.array([view.camera_to_world for view in views]).reshape(-1, 4, 4)


def _link(source: str, target: str) -> None:
    try:
        Path(target).hardlink_to(source)
    except OSError:
        shutil.copy2(source, target)


def _replace(path: Path, text: str) -> None:
    # Never written through: the file may be a link to the source's own.
    path.unlink()
    path.write_text(text, encoding="utf-8")


def _rewrite_meta(path: Path, k: Intrinsics) -> None:
    meta = json.loads(path.read_text(encoding="utf-8"))
    camera: dict[str, Any] = meta["camera"]
    camera.update(width=k.width, height=k.height, fx=k.fx, fy=k.fy, cx=k.cx, cy=k.cy)
    if "hfov_deg" in camera:
        camera["hfov_deg"] = float(2 * np.degrees(np.arctan(k.width / 2 / k.fx)))
    _replace(path, json.dumps(meta, indent=2) + "\n")


def _rewrite_transforms(path: Path, wrong: Written) -> None:
    transforms, k = json.loads(path.read_text(encoding="utf-8")), wrong.intrinsics
    transforms.update(w=k.width, h=k.height, fl_x=k.fx, fl_y=k.fy, cx=k.cx, cy=k.cy)
    for frame, pose in zip(transforms["frames"], [*wrong.frames, *wrong.heldout], strict=True):
        frame["transform_matrix"] = pose.tolist()
    _replace(path, json.dumps(transforms) + "\n")


def _rewrite_steps(path: Path, poses: Float, meta: dict[str, Any]) -> None:
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    yaw, pitch = yaw_and_pitch(poses)
    height = meta["camera"].get("height_above_floor_m", 0.0)
    for row, pose, psi, phi in zip(rows, poses, yaw, pitch, strict=True):
        x, y, z = pose[:3, 3] - np.array([0.0, height, 0.0])
        row.update(x_m=f"{x:.6f}", y_m=f"{y:.6f}", z_m=f"{z:.6f}", yaw_rad=f"{psi:.9f}", pitch_rad=f"{phi:.9f}")
    path.unlink()
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, fieldnames=list(rows[0]) if rows else [])
        writer.writeheader()
        writer.writerows(rows)


def _of_all(change: Callable[[Float], Float]) -> Damage:
    """A fault that changes all poses alike."""
    return lambda right, _: replace(right, frames=change(right.frames), heldout=change(right.heldout))


def _transposed(poses: Float) -> Float:
    wrong = poses.copy()
    wrong[:, :3, :3] = np.swapaxes(poses[:, :3, :3], 1, 2)
    return wrong


def _scaled(poses: Float) -> Float:
    wrong = poses.copy()
    wrong[:, :3, 3] *= 1.1
    return wrong


def _degrees_for_radians(poses: Float) -> Float:
    yaw, pitch = yaw_and_pitch(poses)
    return camera_to_world(poses[:, :3, 3], yaw=yaw, pitch=np.degrees(pitch))


def _radians_for_degrees(poses: Float) -> Float:
    yaw, pitch = yaw_and_pitch(poses)
    return camera_to_world(poses[:, :3, 3], yaw=yaw, pitch=np.radians(pitch))


def _focal(percent: float) -> Damage:
    def damage(right: Written, _: np.random.Generator) -> Written:
        k, factor = right.intrinsics, 1 + percent / 100
        return replace(right, intrinsics=replace(k, fx=factor * k.fx, fy=factor * k.fy))

    return damage


def _swapped(right: Written, _: np.random.Generator) -> Written:
    k = right.intrinsics
    return replace(right, intrinsics=Intrinsics(k.height, k.width, k.fy, k.fx, k.cy, k.cx))


def _exchanged(right: Written, rng: np.random.Generator) -> Written:
    frames = right.frames.copy()
    first = int(rng.integers(len(frames)))
    others = np.flatnonzero(np.abs(frames - frames[first]).max(axis=(1, 2)) > 0.01)
    second = int(rng.choice(others))
    frames[[first, second]] = right.frames[[second, first]]
    return replace(right, frames=frames)


def _off(distance_m: float, turn_deg: float) -> Damage:
    """One pose moved and turned, in random directions."""

    def damage(right: Written, rng: np.random.Generator) -> Written:
        frames = right.frames.copy()
        shift, axis = (direction / np.linalg.norm(direction) for direction in rng.normal(size=(2, 3)))
        frame = rng.integers(len(frames))
        frames[frame, :3, 3] += distance_m * shift
        frames[frame, :3, :3] = Rotation.from_rotvec(np.radians(turn_deg) * axis).as_matrix() @ frames[frame, :3, :3]
        return replace(right, frames=frames)

    return damage


def _shifted(right: Written, _: np.random.Generator) -> Written:
    frames = right.frames
    return replace(right, frames=np.concatenate([frames[1:], frames[-1:]]))


FAULTS = (
    Fault("y and z axes flipped", _of_all(habitat_to_opencv), "opencv written as habitat: y and z flipped"),
    Fault("rotations transposed", _of_all(_transposed), "rotations look transposed"),
    Fault("world-to-camera", _of_all(np.linalg.inv), r"look like world_to_camera: expected"),
    Fault("focal length 3 % too long", _focal(3), r"focal length is [23]\.\d % too long"),
    Fault("width and height swapped", _swapped, "width and height look swapped"),
    Fault("scale x 1.1", _of_all(_scaled), r"positions are 1\.1\d* times too large"),
    Fault("two poses exchanged", _exchanged, r"the poses of frame \d+ and frame \d+ are exchanged"),
    Fault("one pose 5 cm off", _off(0.05, 0), r"pose of frame \d+ is off"),
    Fault("time shift of one frame", _shifted, "shifted in time by 1 frame: each frame has the pose of the next"),
    Fault("pitch: degrees taken for radians", _of_all(_degrees_for_radians), "pitch in degrees was taken for radians"),
)
"""The ten of the self-test."""
MORE_FAULTS = (
    Fault("pitch: radians taken for degrees", _of_all(_radians_for_degrees), "degrees to radians twice"),
    Fault(
        "world-to-camera with opencv axes",
        _of_all(lambda poses: np.linalg.inv(habitat_to_opencv(poses))),
        "world_to_camera with opencv axes",
    ),
)
"""Further ones, which are named too."""
SMALL_FAULTS = (
    *(Fault(f"one pose {cm} cm off", _off(cm / 100, 0), r"pose of frame \d+") for cm in (2, 5, 10)),
    *(Fault(f"one pose {deg:g}° off", _off(0, deg), r"pose of frame \d+") for deg in (0.5, 1, 2)),
    *(Fault(f"focal length {percent} % too long", _focal(percent), "focal length") for percent in (1, 2, 3)),
)
"""Faults of one frame or of the focal length by growing amounts, to measure from where on they are seen."""
