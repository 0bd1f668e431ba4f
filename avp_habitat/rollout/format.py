"""Reading a rollout folder, with every fault of it named; `rollout.writing` makes it.

Nothing is decoded here: pictures are checked by their first and last bytes, so that thousands of frames cost a second.
"""

import json
import os
import reprlib
import sys
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np
from numpy.typing import NDArray

from avp_habitat.errors import RolloutError
from avp_habitat.poses import Intrinsics, rigidity_fault
from avp_habitat.rollout.images import GREY_16, RGB_8, check_png_contents, check_png_structure

FORMAT = "avp-rollout"
FORMAT_VERSION = 1
POSE_CONVENTION = (
    "camera_to_world, 4x4, row major, metres; world right-handed with Y up, the floor is the X-Z plane; "
    "camera axes habitat (= OpenGL): x right, y up, looks along -z"
)
HELDOUT = "heldout"

# 16 numbers take less, with all their digits.
_LONGEST_POSE_BYTES = 4096
# Beyond any size in pixels or metres.
_BEYOND_ANY_SIZE = 1e9


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
class Floor:
    """The floor seen from above: which cells are navigable, and when each was first observed; the file exists."""

    picture: Path
    """16-bit grey PNG, rows along +Z, columns along +X: 0 not navigable, 1 never observed, 1 + t first by view t."""
    cell_m: float
    """Side of a cell in metres."""
    origin_m: tuple[float, float]
    """x and z of the least corner of cell (0, 0), metres."""
    shape: tuple[int, int]
    """Rows and columns."""


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
    floor: Floor | None = None
    """Its floor cells; None in rollouts that were written before there were any."""


def frame_name(index: int) -> str:
    """The stem of a frame's files."""
    return f"frame_{index:05d}"


def view_of(base: Path, index: int, pose: NDArray[np.float64]) -> View:
    """A view by its number and pose, in a rollout's folder or that of its held-out views."""
    name = f"{frame_name(index)}.png"
    return View(base / "images" / name, base / "depth" / name, pose)


def read_rollout(folder: str | Path) -> Rollout:
    """Read and check a rollout, given by its folder or its `rollout.json`.

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
    frames = _read_views(folder, _count(folder, meta, "frames"), intrinsics)
    heldout = _read_views(folder / HELDOUT, _count(folder, meta, HELDOUT), intrinsics)
    return Rollout(folder, meta, intrinsics, frames, heldout, _read_floor(folder, meta))


def read_meta(folder: Path) -> dict[str, Any]:
    """`rollout.json` of a folder, everything in it that the suite uses held to its type and range.

    Raises:
        RolloutError: it is missing, not JSON, not a rollout, of another version, or has an entry of another kind.
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
    _check_facts(path, meta)
    origin = _of(meta, "scene").get("origin", [0, 0, 0])
    if not _are_lengths(origin, 3):
        raise _unlike(path, "scene.origin", "three lengths in metres", origin)
    _intrinsics(path, meta)
    for key in ("frames", HELDOUT):
        _count(folder, meta, key)
    return meta


def name_of(meta: dict[str, Any], key: str) -> str:
    """The name of a rollout's `scene`, `simulator` or `policy`; empty where there is none."""
    value = meta.get(key)
    return value if isinstance(value, str) else _of(meta, key).get("name") or ""


def read_json(path: Path) -> dict[str, Any]:
    """A JSON file whose top is an object.

    Raises:
        RolloutError: it is missing, unreadable, not a JSON object, or holds a number that is not finite.
    """
    try:
        value = json.loads(path.read_text(encoding="utf-8"))
        # Python also reads NaN, infinity and halves of characters, which nothing else can bear.
        json.dumps(value, ensure_ascii=False, allow_nan=False).encode()
    except FileNotFoundError:
        raise RolloutError(f"{path}: expected this file of the rollout, found none") from None
    except (OSError, ValueError, RecursionError) as error:
        raise RolloutError(f"{path}: expected JSON, could not read it: {error}") from None
    if not isinstance(value, dict):
        raise RolloutError(f"{path}: expected a JSON object, found a {type(value).__name__}")
    return value


def _unlike(path: Path, name: str, expected: str, found: Any) -> RolloutError:
    return RolloutError(f"{path}: expected {name} to be {expected}, found {reprlib.repr(found)}")


def _read_pose(path: str) -> NDArray[np.float64]:
    """A `(4, 4)` camera_to_world text file, checked to be rigid."""
    try:
        with open(path, "rb", buffering=0) as file:
            numbers = [float(word) for word in file.read(_LONGEST_POSE_BYTES).split()]
    except FileNotFoundError:
        raise RolloutError(f"{path}: expected this pose file, found none") from None
    except (OSError, ValueError) as error:
        raise RolloutError(f"{path}: expected 4 rows of 4 numbers, could not read them: {error}") from None
    if len(numbers) != 16:
        raise RolloutError(f"{path}: expected 4 rows of 4 numbers, found {len(numbers)} numbers")
    if beyond := [number for number in numbers if abs(number) >= _BEYOND_ANY_SIZE]:
        raise RolloutError(f"{path}: expected metres, found {beyond[0]:g}")
    pose = np.array(numbers).reshape(4, 4)
    if fault := rigidity_fault(pose):
        raise RolloutError(f"{path}: not a rigid camera_to_world: {fault}")
    return pose


def _check_facts(path: Path, meta: dict[str, Any]) -> None:
    """Hold what is shown, logged and computed with to its kind; what is left out is left out."""
    for key in ("scene", "simulator", "policy"):
        value = meta.get(key)
        name = value.get("name") if isinstance(value, dict) else value
        if not isinstance(name, str | None):
            raise _unlike(path, f"the name of the {key}", "text", name)
    for key in ("metrics", "versions", "actions"):
        if not isinstance(meta.get(key, {}), dict):
            raise _unlike(path, key, "an object", meta[key])
    for key in ("metrics", "actions"):
        for name, value in meta.get(key, {}).items():
            if name != "names" and not _is_number(value):
                raise _unlike(path, f"{key}.{name}", "a finite number", value)


def _of(meta: dict[str, Any], key: str) -> dict[str, Any]:
    value = meta.get(key)
    return value if isinstance(value, dict) else {}


def _count(folder: Path, meta: dict[str, Any], key: str) -> int:
    count = _of(meta, "counts").get(key)
    if not isinstance(count, int) or isinstance(count, bool) or count < 0:
        raise _unlike(folder / "rollout.json", f"counts.{key}", "a whole number", count)
    return count


def _intrinsics(path: Path, meta: dict[str, Any]) -> Intrinsics:
    values: dict[str, Any] = {}
    for field in fields(Intrinsics):
        value = _of(meta, "camera").get(field.name)
        if not _is_size(value) or (field.type is int and value % 1):
            whole = "whole " if field.type is int else ""
            raise _unlike(path, f"camera.{field.name}", f"a {whole}number of pixels above 0", value)
        values[field.name] = int(value) if field.type is int else float(value)
    return Intrinsics(**values)


def _is_number(value: Any) -> TypeGuard[float]:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= sys.float_info.max


def _is_size(value: Any) -> TypeGuard[float]:
    return _is_number(value) and 0 < value < _BEYOND_ANY_SIZE


def _are_lengths(value: Any, count: int) -> TypeGuard[list[float]]:
    listed = isinstance(value, list) and len(value) == count
    return listed and all(_is_number(number) and abs(number) < _BEYOND_ANY_SIZE for number in value)


def _read_views(base: Path, count: int, intrinsics: Intrinsics) -> list[View]:
    if not count:
        return []
    for kind, suffix in (("images", ".png"), ("depth", ".png"), ("poses", ".txt")):
        _check_listing(base / kind, suffix, count)
    stems = [frame_name(index) for index in range(count)]
    poses = [_read_pose(f"{base}/poses/{stem}.txt") for stem in stems]
    size = {"width": intrinsics.width, "height": intrinsics.height}
    for stem in stems:
        check_png_structure(f"{base}/images/{stem}.png", **size, kind=RGB_8)
        check_png_structure(f"{base}/depth/{stem}.png", **size, kind=GREY_16)
    return [view_of(base, index, pose) for index, pose in enumerate(poses)]


def _check_listing(folder: Path, suffix: str, count: int) -> None:
    """Hold a folder to the names of exactly `count` frames."""
    try:
        found = {name for name in os.listdir(folder) if name.endswith(suffix)}
    except OSError as error:
        raise RolloutError(f"{folder}: expected {count} files, could not list it: {error.strerror}") from None
    expected: set[str] = set()
    for index in range(count):
        # The count may be anything: the search ends at the first name that is not there.
        if (name := frame_name(index) + suffix) not in found:
            raise RolloutError(f"{folder / name}: expected this file ({count} frames by rollout.json), found none")
        expected.add(name)
    if extra := found - expected:
        raise RolloutError(f"{folder / min(extra)}: a frame that rollout.json does not count ({count} frames)")


def _read_floor(folder: Path, meta: dict[str, Any]) -> Floor | None:
    if "floor" not in meta:
        return None
    entry, about = _of(meta, "floor"), folder / "rollout.json"
    name, shape, origin, cell = (entry.get(key) for key in ("file", "shape", "origin_m", "cell_m"))
    if not isinstance(name, str) or not name:
        raise _unlike(about, "floor.file", "the name of a file", name)
    if not _are_lengths(shape, 2) or not all(isinstance(side, int) and side > 0 for side in shape):
        raise _unlike(about, "floor.shape", "rows and columns above 0", shape)
    if not _are_lengths(origin, 2):
        raise _unlike(about, "floor.origin_m", "x and z in metres", origin)
    if not _is_size(cell):
        raise _unlike(about, "floor.cell_m", "metres above 0", cell)
    picture = folder / name
    if not Path(os.path.abspath(picture)).is_relative_to(os.path.abspath(folder)):
        raise RolloutError(f"{picture}: expected a path inside {folder}")
    rows, columns = (int(side) for side in shape)
    check_png_structure(str(picture), width=columns, height=rows, kind=GREY_16)
    check_png_contents(picture)
    return Floor(picture, float(cell), (float(origin[0]), float(origin[1])), (rows, columns))
