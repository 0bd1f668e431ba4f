"""The format check: files, numbers and tables of a rollout agree with each other, and describe a walk."""

import csv
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from avp_habitat.errors import RolloutError
from avp_habitat.poses import opencv_to_habitat, wrap_angle, yaw_and_pitch, z_up_to_y_up
from avp_habitat.rollout.format import Rollout, frame_name, read_json, read_meta, read_rollout
from avp_nerfstudio.check import Verdict
from avp_nerfstudio.check.mistakes import Walk, has_no_roll, is_upright, transposed

Float = NDArray[np.floating]
Fault = tuple[str, str | None]
"""What was found, and the likely cause where one is known."""

STEP_M = 0.002
"""Steps may be so much longer than a forward move; in correct rollouts they exceed it by less than 0.000002 m."""
CLIMB_M, CLIMB_CELL_M = 0.2, 0.1
"""What an agent can climb from one navigable cell to the next, and the side of a cell: a step may cross several."""
ANGLE_RAD = 1e-4
"""Turns may differ so much from their amount; in correct rollouts by less than 0.000001."""
TABLE_M = 2e-4
"""Positions in the table may differ so much from the poses (six decimals are written)."""
_FOCAL_SHARE = 1e-4
_POSE_M = 1e-6
_SWAPPED = "width and height look swapped"
_COLUMNS = ("x_m", "y_m", "z_m", "yaw_rad", "pitch_rad")


@dataclass(frozen=True)
class Steps:
    """`steps.csv`, as far as poses can be held against it."""

    action: list[str]
    """Name of each step's action."""
    position: Float
    """`(n, 3)` the agent's feet, metres."""
    yaw: Float
    """`(n,)` radians."""
    pitch: Float
    """`(n,)` radians."""


def read_steps(path: Path, count: int) -> Steps | None:
    """Read the table, None where there is none or it is empty.

    Raises:
        RolloutError: it is unreadable, lacks columns, or has another number of rows than there are frames.
    """
    if not path.exists():
        return None
    try:
        with path.open(newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
        if not rows:
            return None
        columns = np.array([[float(row[name]) for name in _COLUMNS] for row in rows])
        actions = [str(row["action"]) for row in rows]
    except KeyError as error:
        raise RolloutError(f"{path}: expected a column {error.args[0]!r}, found none") from None
    except (OSError, ValueError, TypeError) as error:
        raise RolloutError(f"{path}: expected a table of numbers, could not read it: {error}") from None
    if len(rows) != count:
        raise RolloutError(f"{path}: expected {count} rows, one per frame, found {len(rows)}")
    return Steps(actions, columns[:, :3], columns[:, 3], columns[:, 4])


def upright_fault(poses: Float, limit_deg: float, names: list[str]) -> Fault | None:
    """What is wrong with how `(n, 4, 4)` cameras stand, and why perhaps; None when all are upright."""
    wrong = np.flatnonzero(~is_upright(poses, limit_deg=limit_deg))
    if not len(wrong):
        return None
    worst = int(wrong[0])
    what = "rolled to the side"
    if has_no_roll(poses[[worst]])[0]:
        what = "upside down" if poses[worst, 1, 1] < 0 else f"pitched beyond {limit_deg:g} degrees"
    text = f"{len(wrong)} of {len(poses)} cameras do not stand upright, {names[worst]} is {what}"
    for cause, undone in (
        ("camera axes look like opencv written as habitat: y and z flipped", opencv_to_habitat(poses)),
        ("the world looks Z-up, as nerfstudio's is: expected Y up", z_up_to_y_up(poses)),
        ("the rotations look transposed, or world_to_camera was written for camera_to_world", transposed(poses)),
    ):
        if is_upright(undone, limit_deg=limit_deg).all():
            return text, cause
    return text, None


def table_fault(poses: Float, steps: Steps, height_m: float | None) -> str | None:
    """How poses contradict the table of steps, None when they do not; `height_m` of the camera above the feet."""
    raised = steps.position + np.array([0.0, height_m or 0.0, 0.0])
    axes = [0, 1, 2] if height_m is not None else [0, 2]
    away = np.abs(poses[:, :3, 3] - raised)[:, axes].max(axis=1)
    worst = int(away.argmax())
    if away[worst] > TABLE_M:
        return (
            f"frame {worst} stands {1000 * away[worst]:.0f} mm from its position in steps.csv "
            f"(camera {'height' if height_m is not None else 'without height'} included, limit {1000 * TABLE_M:g} mm)"
        )
    yaw, pitch = yaw_and_pitch(poses)
    for name, difference in (("yaw", wrap_angle(yaw - steps.yaw)), ("pitch", pitch - steps.pitch)):
        if np.abs(difference).max() > ANGLE_RAD:
            worst = int(np.abs(difference).argmax())
            return f"{name} of frame {worst} differs by {np.degrees(difference[worst]):.2f} degrees from steps.csv"
    return None


def impossible_steps(poses: Float, steps: Steps, actions: dict[str, Any]) -> dict[int, str]:
    """Steps between `(n, 4, 4)` poses that an agent cannot have made, by the number of the frame that they lead to."""
    reach, turn, tilt = (float(actions[name]) for name in ("forward_m", "turn_deg", "tilt_deg"))
    moved = np.diff(poses[:, :3, 3], axis=0)
    length = np.linalg.norm(moved[:, [0, 2]], axis=1)
    yaw, pitch = (np.degrees(np.asarray(angle)) for angle in yaw_and_pitch(poses))
    turned, tilted = np.degrees(wrap_angle(np.radians(np.diff(yaw)))), np.diff(pitch)
    found = {}
    for index, action in enumerate(steps.action[1:]):
        allowed = reach if action == "move_forward" else 0.0
        wanted = {"turn_left": turn, "turn_right": -turn}.get(action, 0.0)
        lift = {"look_up": tilt, "look_down": -tilt}.get(action, 0.0)
        climbed = CLIMB_M * (length[index] / CLIMB_CELL_M + 1) if allowed else STEP_M
        if length[index] > allowed + STEP_M or abs(moved[index, 1]) > climbed:
            found[index + 1] = f"{action} of {np.linalg.norm(moved[index]):.3f} m (at most {allowed:g} m)"
        elif abs(turned[index] - wanted) > np.degrees(ANGLE_RAD):
            found[index + 1] = f"{action} that turned by {turned[index]:+.1f} degrees ({wanted:+g} expected)"
        # At its limit the pitch stays.
        elif abs(tilted[index] - lift) > np.degrees(ANGLE_RAD) and abs(tilted[index]) > np.degrees(ANGLE_RAD):
            found[index + 1] = f"{action} that tilted by {tilted[index]:+.1f} degrees ({lift:+g} expected)"
    return found


def cause_of_steps(found: dict[int, str], count: int) -> str | None:
    """Which single pose explains impossible steps: two in a row lead to and from it."""
    frames = sorted(found)
    if len(frames) == 2 and frames[1] == frames[0] + 1:
        return f"the pose of frame {frames[0]} is off: the steps to it and from it are impossible"
    if len(frames) == 1 and frames[0] in (1, count - 1):
        frame = 0 if frames[0] == 1 else frames[0]
        return f"the pose of frame {frame} is off: the step at that end of the walk is impossible"
    return None


def check_format(folder: Path) -> tuple[Rollout | None, Verdict]:
    """Read a rollout and hold its parts against each other; no rollout where it cannot be read."""
    try:
        rollout = read_rollout(folder)
        faults = [fault for part in (_intrinsics, _transforms, _cameras, _walk) for fault in part(rollout)]
    except RolloutError as error:
        return None, Verdict("format", False, str(error), cause=_swapped_size(folder))
    views = len(rollout.frames) + len(rollout.heldout)
    figures = {"views": float(views), "faults": float(len(faults))}
    if not faults:
        text = f"{views} views: files, rigid transforms, intrinsics, tables and steps agree (limit: no fault)"
        return rollout, Verdict("format", True, text, figures)
    text = "; ".join(fault for fault, _ in faults)
    cause = next((cause for _, cause in faults if cause), None)
    return rollout, Verdict("format", False, text, figures, cause)


def _intrinsics(rollout: Rollout) -> Iterator[Fault]:
    k = rollout.intrinsics
    if not (0 < k.cx < k.width and 0 < k.cy < k.height):
        yield f"principal point ({k.cx:g}, {k.cy:g}) outside the picture of {k.width}x{k.height}", _SWAPPED
    elif k.width != k.height and (k.cx, k.cy) == (k.height / 2, k.width / 2):
        yield f"principal point ({k.cx:g}, {k.cy:g}) is the middle of {k.height}x{k.width}", _SWAPPED
    hfov = rollout.meta["camera"].get("hfov_deg")
    if not isinstance(hfov, (int, float)) or not 0 < hfov < 180:
        return
    expected = k.width / 2 / np.tan(np.radians(hfov) / 2)
    if abs(k.fx / expected - 1) > _FOCAL_SHARE:
        from_height = k.height / 2 / np.tan(np.radians(hfov) / 2)
        swapped = k.width != k.height and abs(k.fx / from_height - 1) < _FOCAL_SHARE
        percent = 100 * (k.fx / expected - 1)
        cause = _SWAPPED if swapped else f"the focal length is {percent:+.1f} % off, or hfov_deg is wrong"
        yield f"fx is {k.fx:.2f} pixels, expected {expected:.2f} from {k.width} pixels and {hfov:g} degrees", cause


def _transforms(rollout: Rollout) -> Iterator[Fault]:
    """What nerfstudio's own parser would read must be what ours reads."""
    path = rollout.folder / "transforms.json"
    if not path.exists():
        return
    found, k = read_json(path), rollout.intrinsics
    for key, value in (("w", k.width), ("h", k.height), ("fl_x", k.fx), ("fl_y", k.fy), ("cx", k.cx), ("cy", k.cy)):
        if not _near(found.get(key), value):
            yield f"transforms.json says {key} = {found.get(key)!r}, rollout.json {value:g}", None
            return
    poses = _poses_by_file(path, found)
    for view in rollout.frames + rollout.heldout:
        name = view.image.relative_to(rollout.folder).as_posix()
        if name not in poses:
            yield f"transforms.json lacks {name}", None
            return
        if np.abs(poses[name] - view.camera_to_world).max() > _POSE_M:
            yield f"transforms.json has another pose for {name} than {view.image.parent.parent.name}/poses", None
            return


def _poses_by_file(path: Path, transforms: dict[str, Any]) -> dict[str, np.ndarray]:
    try:
        return {
            frame["file_path"]: np.array(frame["transform_matrix"], dtype=float).reshape(4, 4)
            for frame in transforms["frames"]
        }
    except (KeyError, TypeError, ValueError) as error:
        raise RolloutError(f"{path}: expected frames with file_path and a 4x4 transform_matrix: {error!r}") from None


def _near(found: Any, expected: float) -> bool:
    return isinstance(found, (int, float)) and abs(found - expected) <= 1e-6 * max(abs(expected), 1.0)


def _cameras(rollout: Rollout) -> Iterator[Fault]:
    views = rollout.frames + rollout.heldout
    if not views:
        yield "there is no frame", None
        return
    names = [f"frame {i}" for i in range(len(rollout.frames))]
    names += [f"held-out view {i}" for i in range(len(rollout.heldout))]
    limit = float(rollout.meta.get("actions", {}).get("pitch_limit_deg", Walk.pitch_limit_deg))
    fault = upright_fault(np.stack([view.camera_to_world for view in views]), limit, names)
    if fault is not None:
        yield fault


def _walk(rollout: Rollout) -> Iterator[Fault]:
    steps = read_steps(rollout.folder / "steps.csv", len(rollout.frames))
    if steps is None:
        return
    poses = np.stack([view.camera_to_world for view in rollout.frames])
    if contradiction := table_fault(poses, steps, rollout.meta["camera"].get("height_above_floor_m")):
        yield contradiction, None
    actions = rollout.meta.get("actions", {})
    if {"forward_m", "turn_deg", "tilt_deg"} <= actions.keys() and (found := impossible_steps(poses, steps, actions)):
        first = min(found)
        text = f"{len(found)} of {len(poses) - 1} steps are impossible: to frame {first} a {found[first]}"
        yield text, cause_of_steps(found, len(poses))


def _swapped_size(folder: Path) -> str | None:
    """Say so when the pictures are as wide as `rollout.json` says they are high."""
    try:
        camera = read_meta(folder)["camera"]
        with Image.open(folder / "images" / f"{frame_name(0)}.png") as picture:
            width, height = picture.size
    except (RolloutError, OSError, Image.DecompressionBombError):
        return None
    if width != height and (width, height) == (camera["height"], camera["width"]):
        return f"{_SWAPPED}: rollout.json says {height}x{width}, the pictures are {width}x{height}"
    return None
