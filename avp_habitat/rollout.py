"""Reading a rollout folder, with every fault of it named.

The folder is the contract between the halves of the suite (capturing and reconstructing); `rollout_writer` makes it.
Nothing is decoded here: pictures are checked by their PNG headers, so that thousands of frames cost a second.
"""

import json
import os
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avp_habitat.errors import RolloutError
from avp_habitat.poses import Intrinsics, rigidity_fault

FORMAT = "avp-rollout"
FORMAT_VERSION = 1
POSE_CONVENTION = (
    "camera_to_world, 4x4, row major, metres; world right-handed with Y up, the floor is the X-Z plane; "
    "camera axes habitat (= OpenGL): x right, y up, looks along -z"
)
HELDOUT = "heldout"
_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_RGB_8, _GRAY_16 = (8, 2), (16, 0)


@dataclass(frozen=True)
class View:
    """One captured picture with its depth and pose; the files exist and have the right size."""

    image: Path
    """8-bit RGB PNG."""
    depth: Path
    """16-bit PNG, planar depth in millimetres, 0 = none."""
    camera_to_world: NDArray[np.float64]
    """`(4, 4)`, habitat axes, metres."""


@dataclass(frozen=True)
class Rollout:
    """A checked rollout folder."""

    folder: Path
    """Where it is."""
    meta: dict[str, Any]
    """`rollout.json` as read."""
    intrinsics: Intrinsics
    """Of all its pictures."""
    frames: list[View]
    """The captured frames in the order of the steps."""
    heldout: list[View]
    """The held-out views."""


def frame_name(index: int) -> str:
    """The stem of a frame's files."""
    return f"frame_{index:05d}"


def read_rollout(folder: str | Path) -> Rollout:
    """Read and check a rollout.

    Args:
        folder: the rollout's folder, or its `rollout.json`.

    Raises:
        RolloutError: a file is missing, unreadable, of the wrong size, not a rigid transform, leaves the folder, or
            the format is of another version. The text names the file and says what was expected.
    """
    folder = Path(folder)
    if folder.name == "rollout.json":
        folder = folder.parent
    if not folder.is_dir():
        raise RolloutError(f"{folder}: expected a rollout folder (made by `python -m avp_habitat.collect`), found none")
    meta = read_meta(folder)
    intrinsics = _intrinsics(folder / "rollout.json", meta)
    frames = _read_views(folder, folder, _count(folder, meta, "frames"), intrinsics)
    heldout = _read_views(folder, folder / HELDOUT, _count(folder, meta, HELDOUT), intrinsics)
    return Rollout(folder, meta, intrinsics, frames, heldout)


def read_meta(folder: Path) -> dict[str, Any]:
    """`rollout.json` of a folder, its format and version checked.

    Raises:
        RolloutError: it is missing, not JSON, not a rollout, or of another version.
    """
    path = folder / "rollout.json"
    meta = read_json(path)
    if meta.get("format") != FORMAT:
        raise RolloutError(f"{path}: expected format {FORMAT!r}, found {meta.get('format')!r}")
    if meta.get("format_version") != FORMAT_VERSION:
        writer = _of(meta, "versions").get("avp-suite", "of unknown version")
        raise RolloutError(
            f"{path}: expected format version {FORMAT_VERSION}, found {meta.get('format_version')!r}, written by "
            f"avp-suite {writer}; collect it again or read it with that version"
        )
    return meta


def read_json(path: Path) -> dict[str, Any]:
    """A JSON file whose top is an object.

    Raises:
        RolloutError: it is missing, unreadable, or not a JSON object.
    """
    _check_inside(path.parent, path)
    try:
        value = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise RolloutError(f"{path}: expected this file of the rollout, found none") from None
    except (OSError, ValueError) as error:
        raise RolloutError(f"{path}: expected JSON, could not read it: {error}") from None
    if not isinstance(value, dict):
        raise RolloutError(f"{path}: expected a JSON object, found a {type(value).__name__}")
    return value


def read_pose(path: Path) -> NDArray[np.float64]:
    """A `(4, 4)` camera_to_world text file, checked to be rigid.

    Raises:
        RolloutError: it is missing, not 16 numbers, or not a rigid transform.
    """
    try:
        pose = np.array([float(word) for word in path.read_text(encoding="ascii").split()])
    except FileNotFoundError:
        raise RolloutError(f"{path}: expected this pose file, found none") from None
    except (OSError, ValueError) as error:
        raise RolloutError(f"{path}: expected 4 rows of 4 numbers, could not read them: {error}") from None
    if pose.size != 16:
        raise RolloutError(f"{path}: expected 4 rows of 4 numbers, found {pose.size} numbers")
    pose = pose.reshape(4, 4)
    fault = rigidity_fault(pose)
    if fault:
        raise RolloutError(f"{path}: not a rigid camera_to_world: {fault}")
    return pose


def _of(meta: dict[str, Any], key: str) -> dict[str, Any]:
    value = meta.get(key)
    return value if isinstance(value, dict) else {}


def _count(folder: Path, meta: dict[str, Any], key: str) -> int:
    count = _of(meta, "counts").get(key)
    if not isinstance(count, int) or isinstance(count, bool) or count < 0:
        raise RolloutError(f"{folder / 'rollout.json'}: expected counts.{key} to be a whole number, found {count!r}")
    return count


def _intrinsics(path: Path, meta: dict[str, Any]) -> Intrinsics:
    camera = _of(meta, "camera")
    values: dict[str, Any] = {}
    value: Any
    for name, kind in (("width", int), ("height", int), ("fx", float), ("fy", float), ("cx", float), ("cy", float)):
        value = camera.get(name)
        usable = isinstance(value, (int, float)) and not isinstance(value, bool) and np.isfinite(value) and value > 0
        if not usable or (kind is int and value != int(value)):
            expected = "a whole number of pixels" if kind is int else "a number of pixels"
            raise RolloutError(f"{path}: expected camera.{name} to be {expected} above 0, found {value!r}")
        values[name] = kind(value)
    return Intrinsics(**values)


def _read_views(root: Path, base: Path, count: int, intrinsics: Intrinsics) -> list[View]:
    for kind, suffix in (("images", ".png"), ("depth", ".png"), ("poses", ".txt")):
        if count:
            _check_listing(root, base / kind, suffix, count)
    views = []
    for index in range(count):
        stem = frame_name(index)
        view = View(
            base / "images" / f"{stem}.png",
            base / "depth" / f"{stem}.png",
            read_pose(base / "poses" / f"{stem}.txt"),
        )
        _check_png(view.image, intrinsics, _RGB_8, "8-bit RGB")
        _check_png(view.depth, intrinsics, _GRAY_16, "16-bit grey")
        views.append(view)
    return views


def _check_listing(root: Path, folder: Path, suffix: str, count: int) -> None:
    """Hold a folder to exactly the files of `count` frames, none of them leading out of the rollout."""
    _check_inside(root, folder)
    try:
        with os.scandir(folder) as entries:
            found = {entry.name: entry.is_symlink() for entry in entries}
    except OSError as error:
        raise RolloutError(f"{folder}: expected {count} files, could not list it: {error.strerror}") from None
    expected = {frame_name(index) + suffix for index in range(count)}
    if missing := sorted(expected - found.keys()):
        raise RolloutError(f"{folder / missing[0]}: expected this file ({count} frames by rollout.json), found none")
    if extra := sorted(name for name in found.keys() - expected if name.endswith(suffix)):
        raise RolloutError(f"{folder / extra[0]}: a frame that rollout.json does not count ({count} frames)")
    for name in sorted(name for name, link in found.items() if link and name in expected):
        _check_inside(root, folder / name)


def _check_inside(root: Path, path: Path) -> None:
    if not path.resolve().is_relative_to(root.resolve()):
        raise RolloutError(f"{path}: expected a path inside {root}, it leads to {path.resolve()}")


def _check_png(path: Path, intrinsics: Intrinsics, kind: tuple[int, int], wanted: str) -> None:
    try:
        with path.open("rb") as file:
            header = file.read(26)
    except OSError as error:
        raise RolloutError(f"{path}: expected a {wanted} PNG, could not read it: {error.strerror}") from None
    if len(header) < 26 or header[:8] != _PNG_SIGNATURE:
        raise RolloutError(
            f"{path}: expected a {wanted} PNG, found {'an empty file' if not header else 'something else'}"
        )
    width, height, bits, colour = struct.unpack(">IIBB", header[16:26])
    if (width, height) != (intrinsics.width, intrinsics.height):
        raise RolloutError(
            f"{path}: expected {intrinsics.width}x{intrinsics.height} pixels (rollout.json), found {width}x{height}"
        )
    if (bits, colour) != kind:
        raise RolloutError(f"{path}: expected a {wanted} PNG, found {bits} bits with PNG colour type {colour}")
