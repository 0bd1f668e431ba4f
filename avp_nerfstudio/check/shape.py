"""The format check: files, numbers and tables of a rollout agree with each other, and describe a walk."""

import json
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from avp_habitat.errors import RolloutError
from avp_habitat.rollout import Rollout, frame_name, read_json, read_rollout
from avp_nerfstudio.check.verdict import Verdict
from avp_nerfstudio.check.walk import cause_of_steps, impossible_steps, read_steps, table_fault, upright_fault

NAME = "format"
_FOCAL_SHARE = 1e-4
_POSE_M = 1e-6
_DEFAULT_PITCH_LIMIT_DEG = 60.0

Fault = tuple[str, str | None]
"""What was found, and the likely cause where one is known."""


def check_format(folder: Path) -> tuple[Rollout | None, Verdict]:
    """Read a rollout and hold its parts against each other.

    Args:
        folder: the rollout.

    Returns:
        The rollout, None when it cannot be read; and the verdict.
    """
    try:
        rollout = read_rollout(folder)
        faults = list(_faults(rollout))
    except RolloutError as error:
        return None, Verdict(NAME, False, str(error), cause=_swapped_size(folder))
    views = len(rollout.frames) + len(rollout.heldout)
    figures = {"views": float(views), "faults": float(len(faults))}
    if not faults:
        text = f"{views} views: files, rigid transforms, intrinsics, tables and steps agree (limit: no fault)"
        return rollout, Verdict(NAME, True, text, figures)
    text = "; ".join(fault for fault, _ in faults)
    cause = next((cause for _, cause in faults if cause), None)
    return rollout, Verdict(NAME, False, text, figures, cause)


def _faults(rollout: Rollout) -> Iterator[Fault]:
    yield from _intrinsics(rollout)
    yield from _transforms(rollout)
    yield from _cameras(rollout)
    yield from _walk(rollout)


def _intrinsics(rollout: Rollout) -> Iterator[Fault]:
    k = rollout.intrinsics
    if not (0 < k.cx < k.width and 0 < k.cy < k.height):
        yield f"principal point ({k.cx:g}, {k.cy:g}) outside the picture of {k.width}x{k.height}", _SWAPPED
    elif k.width != k.height and (k.cx, k.cy) == (k.height / 2, k.width / 2):
        yield f"principal point ({k.cx:g}, {k.cy:g}) is the middle of {k.height}x{k.width}", _SWAPPED
    hfov = rollout.meta.get("camera", {}).get("hfov_deg")
    if not isinstance(hfov, (int, float)) or not 0 < hfov < 180:
        return
    expected = k.width / 2 / np.tan(np.radians(hfov) / 2)
    if abs(k.fx / expected - 1) > _FOCAL_SHARE:
        from_height = k.height / 2 / np.tan(np.radians(hfov) / 2)
        swapped = k.width != k.height and abs(k.fx / from_height - 1) < _FOCAL_SHARE
        percent = 100 * (k.fx / expected - 1)
        cause = _SWAPPED if swapped else f"the focal length is {percent:+.1f} % off, or hfov_deg is wrong"
        yield f"fx is {k.fx:.2f} pixels, expected {expected:.2f} from {k.width} pixels and {hfov:g} degrees", cause


_SWAPPED = "width and height look swapped"


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
    limit = float(_actions(rollout).get("pitch_limit_deg", _DEFAULT_PITCH_LIMIT_DEG))
    fault = upright_fault(np.stack([view.camera_to_world for view in views]), limit, names)
    if fault is not None:
        yield fault


def _walk(rollout: Rollout) -> Iterator[Fault]:
    steps = read_steps(rollout.folder / "steps.csv", len(rollout.frames))
    if steps is None:
        return
    poses = np.stack([view.camera_to_world for view in rollout.frames])
    height = rollout.meta.get("camera", {}).get("height_above_floor_m")
    if contradiction := table_fault(poses, steps, height):
        yield contradiction, None
    actions = _actions(rollout)
    if not {"forward_m", "turn_deg", "tilt_deg"} <= actions.keys():
        return
    impossible = impossible_steps(poses, steps, actions)
    if impossible:
        first = min(impossible)
        text = f"{len(impossible)} of {len(poses) - 1} steps are impossible: to frame {first} a {impossible[first]}"
        yield text, cause_of_steps(impossible, len(poses))


def _actions(rollout: Rollout) -> dict[str, Any]:
    actions = rollout.meta.get("actions")
    return actions if isinstance(actions, dict) else {}


def _swapped_size(folder: Path) -> str | None:
    """Say so when the pictures are as wide as `rollout.json` says they are high."""
    try:
        camera = json.loads((folder / "rollout.json").read_text(encoding="utf-8"))["camera"]
        with (folder / "images" / f"{frame_name(0)}.png").open("rb") as file:
            size = struct.unpack(">II", file.read(24)[16:])
        stated = int(camera["width"]), int(camera["height"])
    except (OSError, ValueError, TypeError, KeyError, struct.error):
        return None
    if stated[0] != stated[1] and size == stated[::-1]:
        return f"{_SWAPPED}: rollout.json says {stated[0]}x{stated[1]}, the pictures are {size[0]}x{size[1]}"
    return None
