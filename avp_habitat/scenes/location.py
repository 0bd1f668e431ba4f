"""From what the user calls a scene to the mesh file that is shown, and the axes of that file."""

import difflib
import os
from dataclasses import dataclass, replace
from pathlib import Path

from avp_habitat.errors import AVPError, SceneError, UsageError
from avp_habitat.scenes.dataset import SceneDataset
from avp_habitat.scenes.files import SUFFIXES, broken_link
from avp_habitat.scenes.stage_config import (
    REPLICA_MESH,
    STAGE_CONFIG,
    Y_UP,
    Z_UP,
    Layer,
    SceneLocation,
    is_replica_scene,
    read_config,
    read_stage,
    replica_scene,
)

BUILTIN = "builtin:"
UPS = ("y", "z")
"""Axes of a mesh file that can point up."""
DATASET_CONFIG = ".scene_dataset_config.json"
HELP = (
    f"a mesh ({' '.join(SUFFIXES)}), a scene folder of Replica, NAME{STAGE_CONFIG}, NAME{DATASET_CONFIG}:ID, or "
    f"{BUILTIN}SEED for a generated room"
)
"""What a command line says of its option for scenes."""
UP_HELP = "axis of a mesh file that points up (omitted: y, of Replica's files z)"
"""And of its option `up`."""


@dataclass(frozen=True)
class Frame:
    """How a scene's file lies in the world."""

    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """What was taken off the file's coordinates, turned to Y up, in metres; not zero for a scene far from there."""
    up: str | None = None
    """The axis of the file that was said to point up; None where nobody said."""


def locate(spec: str | Path, *, up: str | None = None) -> SceneLocation:
    """Find a scene without reading its mesh.

    Args:
        spec: path of a `.glb`, `.gltf`, `.ply` or `.obj` file (Y up); scene folder of Replica or a mesh in it (Z up);
            `NAME.stage_config.json`; `NAME.scene_dataset_config.json:ID`; or `builtin:SEED` for a generated room.
        up: axis of a mesh file that points up, `y` or `z`, whatever its folder says; generated rooms are Y-up.

    Raises:
        UsageError: nothing that a scene could be called, a dataset config without an id, or `up` beside a config,
            which has its own.
        SceneError: the scene is missing, or a config is damaged, asks for what is not supported, or refers to what is
            missing or lies outside of the data set's folder (of a stage config alone: the folder above its own).
    """
    spec = os.fspath(spec)
    if spec.startswith(BUILTIN):
        return SceneLocation(f"{BUILTIN}{_seed(spec)}", None)
    dataset, mark, scene_id = spec.partition(f"{DATASET_CONFIG}:")
    path = Path(f"{dataset}{DATASET_CONFIG}" if mark else spec)
    if up is not None and path.name.endswith((DATASET_CONFIG, STAGE_CONFIG)):
        raise UsageError(f"up: {path} says itself which axis of its mesh points up; expected none beside it, got {up}")
    if path.name.endswith(DATASET_CONFIG):
        _expect_file(path, (DATASET_CONFIG,))
        return SceneDataset(path).scene(scene_id)
    if path.name.endswith(STAGE_CONFIG):
        return _stage(path)
    if path.is_dir():
        path = _mesh_of(path)
    elif path.suffix.lower() not in SUFFIXES:
        raise _unknown(path)
    _expect_file(path, SUFFIXES)
    scene = replica_scene(path)
    found = SceneLocation(path.name, path) if scene is None else SceneLocation(scene.name, path, *Z_UP)
    if up is None:
        return found
    axes = {"y": Y_UP, "z": Z_UP}[up]
    return replace(found, up=axes[0], front=axes[1], chosen_up=up)


def _seed(spec: str) -> int:
    text = spec.removeprefix(BUILTIN)
    if not (text.isascii() and text.isdigit()):
        raise UsageError(f"{spec}: expected {BUILTIN}SEED with an integer SEED >= 0, got {text!r}")
    return int(text)


def _replica_scenes(folder: Path) -> list[str]:
    """Names of the scenes in a folder that holds Replica, sorted."""
    return sorted(entry.name for entry in folder.iterdir() if entry.is_dir() and is_replica_scene(entry))


def _mesh_of(folder: Path) -> Path:
    """The mesh that is shown of a scene folder of Replica."""
    if is_replica_scene(Path(os.path.abspath(folder))):
        return folder / REPLICA_MESH
    scenes = _replica_scenes(folder)
    hint = f"; name one of its {len(scenes)} scenes, {folder / scenes[0]} say" if scenes else ""
    raise SceneError(f"{folder}: expected a scene file, found a folder that is no scene of Replica{hint}")


def _stage(path: Path) -> SceneLocation:
    _expect_file(path, (STAGE_CONFIG,))
    scene, name = replica_scene(path), path.name.removesuffix(STAGE_CONFIG)
    # Replica's stage config lies in habitat/ and shows ../mesh.ply, so the folder above is part of the data.
    root, axes = Path(os.path.abspath(path)).parents[1], Y_UP if scene is None else Z_UP
    asset, axes = read_stage([Layer(read_config(path), path)], path.parent, root, name=name, axes=axes)
    return SceneLocation(name if scene is None else scene.name, asset, *axes, files=(path,))


def _unknown(path: Path) -> AVPError:
    folders = _replica_scenes(path.parent) if path.parent.is_dir() else []
    near = difflib.get_close_matches(path.name, folders, n=2, cutoff=0.5)
    if near:
        return SceneError(f"{path}: no such folder; did you mean {' or '.join(near)}?")
    found = f"the suffix {path.suffix!r}" if path.suffix else "no suffix"
    return UsageError(
        f"{path}: expected a scene file ({', '.join(SUFFIXES)}), a scene folder of Replica, NAME{STAGE_CONFIG}, "
        f"NAME{DATASET_CONFIG}:ID or {BUILTIN}SEED, got a name with {found}"
    )


def _expect_file(path: Path, endings: tuple[str, ...]) -> None:
    """Refuse a path that is no file, with the nearest name of one that ends likewise."""
    if path.is_file():
        return
    if path.exists():
        raise SceneError(f"{path}: expected a scene file, found a folder")
    if broken := broken_link(path):
        raise SceneError(f"{path}: {broken}")
    if not path.parent.is_dir():
        raise SceneError(f"{path}: there is no folder {path.parent}")
    names = sorted(entry.name for entry in path.parent.iterdir() if entry.name.lower().endswith(endings))
    near = difflib.get_close_matches(path.name, names, n=1, cutoff=0.5)
    hint = f"; did you mean {near[0]}?" if near else ""
    raise SceneError(f"{path}: no such scene file{hint}")
