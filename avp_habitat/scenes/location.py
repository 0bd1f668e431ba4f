"""From what the user calls a scene to the mesh file that is shown, and the axes of that file.

Of Habitat-Sim's scene dataset configs that is: the scenes and stages that one names, and what a scene consists of.
"""

import glob
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from avp_habitat.errors import SceneError, UsageError, did_you_mean
from avp_habitat.scenes.files import SUFFIXES, broken_link
from avp_habitat.scenes.stage_config import (
    REPLICA_MESH,
    STAGE_CONFIG,
    Y_UP,
    Z_UP,
    Layer,
    SceneLocation,
    expect_unmoved,
    is_replica_scene,
    read_config,
    read_stage,
    replica_scene,
    shown,
)

ROOM, HOME = "builtin:", "builtin-home:"
"""What the names of generated scenes begin with; a seed follows."""
UPS = ("y", "z")
"""Axes of a mesh file that can point up."""
DATASET_CONFIG = ".scene_dataset_config.json"
SCENE_INSTANCE = ".scene_instance.json"
_SHOWN_NAMES = 5
HELP = (
    f"a mesh ({' '.join(SUFFIXES)}), a scene folder of Replica, NAME{STAGE_CONFIG}, NAME{DATASET_CONFIG}:ID, or "
    f"{ROOM}SEED or {HOME}SEED for a generated room or home"
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
            `NAME.stage_config.json`; `NAME.scene_dataset_config.json:ID`; `builtin:SEED` or `builtin-home:SEED` for a
            generated room or home.
        up: axis of a mesh file that points up, `y` or `z`, whatever its folder says; generated scenes are Y-up.

    Raises:
        UsageError: nothing that a scene could be called, a dataset config without an id, or `up` beside a config,
            which has its own.
        SceneError: the scene is missing, or a config is damaged, asks for what is not supported, or refers to what is
            missing or lies outside of the data set's folder (of a stage config alone: the folder above its own).
    """
    spec = os.fspath(spec)
    if spec.startswith((ROOM, HOME)):
        return _generated(spec)
    dataset, mark, scene_id = spec.partition(f"{DATASET_CONFIG}:")
    path = Path(f"{dataset}{DATASET_CONFIG}" if mark else spec)
    if up is not None and path.name.endswith((DATASET_CONFIG, STAGE_CONFIG)):
        raise UsageError(f"up: {path} says itself which axis of its mesh points up; expected none beside it, got {up}")
    if path.name.endswith(DATASET_CONFIG):
        _expect_file(path, (DATASET_CONFIG,))
        return _Dataset(path).scene(scene_id)
    if path.name.endswith(STAGE_CONFIG):
        return _stage(path)
    path = _mesh_of(path)
    scene = replica_scene(path)
    found = SceneLocation(path.name, path) if scene is None else SceneLocation(scene.name, path, *Z_UP)
    if up is None:
        return found
    axes = {"y": Y_UP, "z": Z_UP}[up]
    return replace(found, up=axes[0], front=axes[1], chosen_up=up)


def _generated(spec: str) -> SceneLocation:
    """A scene that is made from a seed."""
    kind, mark, seed = spec.partition(":")
    if not (seed.isascii() and seed.isdigit()):
        raise UsageError(f"{spec}: expected {kind}{mark}SEED with an integer SEED >= 0, got {seed!r}")
    return SceneLocation(f"{kind}{mark}{int(seed)}", None)


def _mesh_of(path: Path) -> Path:
    """The file of a mesh, or the one that is shown of a scene folder of Replica."""
    if path.is_dir():
        if not is_replica_scene(Path(os.path.abspath(path))):
            scenes = _replica_scenes(path)
            hint = f"; name one of its {len(scenes)} scenes, {path / scenes[0]} say" if scenes else ""
            raise SceneError(f"{path}: expected a scene file, found a folder that is no scene of Replica{hint}")
        path = path / REPLICA_MESH
    elif path.suffix.lower() not in SUFFIXES:
        if hint := did_you_mean(path.name, _replica_scenes(path.parent)):
            raise SceneError(f"{path}: no such folder{hint}")
        raise UsageError(f"{path}: expected a scene file, got the suffix {path.suffix!r}; a scene is {HELP}")
    _expect_file(path, SUFFIXES)
    return path


def _replica_scenes(folder: Path) -> list[str]:
    """Names of the scenes in a folder that holds Replica, sorted."""
    entries = folder.iterdir() if folder.is_dir() else ()
    return sorted(entry.name for entry in entries if entry.is_dir() and is_replica_scene(entry))


def _stage(path: Path) -> SceneLocation:
    _expect_file(path, (STAGE_CONFIG,))
    scene, name = replica_scene(path), path.name.removesuffix(STAGE_CONFIG)
    # Replica's stage config lies in habitat/ and shows ../mesh.ply, so the folder above is part of the data.
    root, axes = Path(os.path.abspath(path)).parents[1], Y_UP if scene is None else Z_UP
    asset, axes = read_stage([read_config(path)], path.parent, root, name=name, axes=axes)
    return SceneLocation(name if scene is None else scene.name, asset, *axes, files=(path,))


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
    raise SceneError(f"{path}: no such scene file{did_you_mean(path.name, names)}")


@dataclass(frozen=True)
class _Entry:
    """A scene instance or a stage of a dataset: its config, or the mesh of a stage without one."""

    handle: str
    """The file's path relative to the dataset's folder."""
    file: Path

    @property
    def words(self) -> str:
        """The handle without the ending of configs."""
        return self.handle.removesuffix(STAGE_CONFIG).removesuffix(SCENE_INSTANCE)

    @property
    def name(self) -> str:
        """The handle without folders and the ending of configs; of a stage of Replica the name of its scene."""
        scene = replica_scene(self.file)
        return self.words.rpartition("/")[2] if scene is None else scene.name


class _Dataset:
    """The scene instances and stages of one scene dataset config; their own files are read when they are asked for."""

    def __init__(self, path: Path) -> None:
        self.path, self.folder = path, path.parent
        config = read_config(path)
        self._scenes, self._stages = config.cell("scene_instances"), config.cell("stages")
        self.scenes = list(self._listed(self._scenes, SCENE_INSTANCE))
        self.stages = list(self._listed(self._stages, STAGE_CONFIG))
        if self._stages.values.get("configs"):
            raise self._stages.error("configs", "stages that a dataset config describes itself are not supported")

    def scene(self, scene_id: str) -> SceneLocation:
        """The scene of a handle with or without folders and ending, or of a part of it that no other scene has.

        Scene instances go before stages, as in Habitat-Sim.
        """
        every = [*self.scenes, *self.stages]
        names = sorted({entry.name for entry in every})
        examples = f"it has {len(names)} scenes" + (f", such as {', '.join(names[:_SHOWN_NAMES])}" if names else "")
        if not scene_id:
            raise UsageError(f"{self.path}: expected {self.path.name}:ID with the id of a scene; {examples}")
        matches = _matches(scene_id, self.scenes, self.stages)
        if len(matches) > 1:
            some = ", ".join(entry.handle for entry in matches[:_SHOWN_NAMES])
            raise SceneError(f"{self.path}: {scene_id!r} stands for {len(matches)} scenes, such as {some}")
        if not matches:
            hint = did_you_mean(scene_id, sorted({*names, *(each.words for each in every)}))
            raise SceneError(f"{self.path}: has no scene {scene_id!r}; {examples}{hint}")
        entry = matches[0]
        found = self._instance(entry) if entry in self.scenes else self._stage(entry)
        return replace(found, name=entry.name, scene_id=entry.handle)

    def _listed(self, cell: Layer, ending: str) -> Iterator[_Entry]:
        """Entries of the files that the search paths of a cell lead to."""
        paths = cell.cell("paths")
        for kind in paths.values:
            # Habitat-Sim takes every kind that holds ".json" for one of configs, any other for one of assets.
            wanted = ending if ".json" in kind else kind
            for pattern in paths.member(kind, []):
                if not isinstance(pattern, str) or not pattern or "\0" in pattern:
                    raise paths.error(kind, f"expected a path, got {shown(pattern)}")
                for match in sorted(glob.glob(pattern, root_dir=self.folder)):
                    path = paths.inside(kind, match, self.folder, self.folder)
                    files = sorted(path.iterdir()) if path.is_dir() else [path]
                    found = (file for file in files if file.name.endswith(wanted))
                    yield from (_Entry(os.path.relpath(file, self.folder), file) for file in found)

    def _stage(self, entry: _Entry) -> SceneLocation:
        layers, config = [self._stages.cell("default_attributes")], _config_of(entry.file)
        if config.name.endswith(STAGE_CONFIG):
            layers.append(read_config(config))
            files = (self.path, config)
            axes = Y_UP if replica_scene(config) is None else Z_UP
        else:
            layers.append(Layer({"render_asset": config.name}, self.path, "stages.paths."))
            files = (self.path,)
            # Without a config, Habitat-Sim judges by the name, unless the dataset has defaults for its stages.
            z_up = config.name.endswith(".glb") and "default_attributes" not in self._stages.values
            axes = Z_UP if z_up else Y_UP
        name = entry.words.rpartition("/")[2]
        asset, axes = read_stage(layers, config.parent, self.folder, name=name, axes=axes)
        return SceneLocation(name, asset, *axes, dataset=self.path, files=files)

    def _instance(self, entry: _Entry) -> SceneLocation:
        default, own = self._scenes.cell("default_attributes"), read_config(entry.file)
        content = Layer({**default.values, **own.values}, entry.file)
        place = content.cell("stage_instance")
        expect_unmoved([place])
        handle = place.member("template_name", "")
        matches = _matches(handle, self.stages) if handle else []
        if not matches:
            hint = did_you_mean(handle, [each.words for each in self.stages])
            raise place.error("template_name", f"{self.path.name} has no stage {handle!r}{hint}")
        objects = sum(len(content.member(kind, [])) for kind in ("object_instances", "articulated_object_instances"))
        stage = self._stage(matches[0])
        return replace(stage, objects=objects, files=(self.path, entry.file, *stage.files[1:]))


def _config_of(file: Path) -> Path:
    """The stage config that belongs to a mesh: `room.stage_config.json` to `room.glb` and `room.basis.glb`."""
    config = file.with_name(Path(Path(file.name).stem).stem + STAGE_CONFIG)
    return config if not file.name.endswith(STAGE_CONFIG) and config.is_file() else file


def _matches(wanted: str, *pools: Sequence[_Entry]) -> list[_Entry]:
    """What a handle means in the first pool and way that fit: all of it, its last part, folders of it, any part.

    Habitat-Sim takes the first of those that hold the text; one that fits better is preferred here, so that Replica's
    `apartment_0` is not `frl_apartment_0`.
    """
    words = wanted.removesuffix(STAGE_CONFIG).removesuffix(SCENE_INSTANCE)
    tests = (
        lambda handle: handle == words,
        lambda handle: handle.endswith(f"/{words}"),
        lambda handle: f"/{words}/" in f"/{handle}/",
        lambda handle: words in handle,
    )
    found = ([entry for entry in pool if test(entry.words)] for test in tests for pool in pools)
    return next(filter(None, found), [])
