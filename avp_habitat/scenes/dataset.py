"""Habitat-Sim's scene dataset configs: the scenes and stages that one names, and what a scene consists of."""

import difflib
import glob
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from avp_habitat.errors import SceneError, UsageError
from avp_habitat.scenes.stage_config import (
    STAGE_CONFIG,
    Y_UP,
    Z_UP,
    Layer,
    Stage,
    expect_neutral,
    inside,
    read_config,
    read_stage,
    replica_scene,
    shown,
)

SCENE_INSTANCE = ".scene_instance.json"
_SHOWN_NAMES = 5


@dataclass(frozen=True)
class Entry:
    """A scene instance or a stage of a dataset."""

    handle: str
    """Path of its file relative to the dataset's folder, or the handle that the dataset config gives it."""
    file: Path | None
    """Its config, or the mesh of a stage without one; None for a stage that the dataset config holds itself."""
    changes: tuple[Layer, ...] = ()
    """Attributes from the dataset config that override those of `file`."""

    @property
    def words(self) -> str:
        """The handle without the ending of configs."""
        return self.handle.removesuffix(STAGE_CONFIG).removesuffix(SCENE_INSTANCE)

    @property
    def name(self) -> str:
        """The handle without folders and the ending of configs; of a stage of Replica the name of its scene."""
        scene = None if self.file is None else replica_scene(self.file)
        return self.words.rpartition("/")[2] if scene is None else scene.name


@dataclass(frozen=True)
class FoundScene:
    """A scene of a dataset."""

    name: str
    """Without folders."""
    handle: str
    """The whole one, as Habitat-Sim can be given it."""
    stage: Stage
    """What it shows besides objects."""
    objects: int
    """How many objects it has, articulated ones included."""
    files: tuple[Path, ...]
    """The configs that describe it, the dataset's not included."""


class SceneDataset:
    """The scene instances and stages of one scene dataset config; their own files are read when they are asked for."""

    def __init__(self, path: Path) -> None:
        """Read the config and list what its search paths lead to.

        Raises:
            SceneError: the config is damaged, or a search path leaves its folder.
        """
        self.path, self.folder = path, path.parent
        config = read_config(path)
        self._scenes = self._cell(config, "scene_instances")
        self._stages = self._cell(config, "stages")
        self.scenes = list(self._listed(self._scenes, "scene_instances", SCENE_INSTANCE))
        self.stages = list(self._listed(self._stages, "stages", STAGE_CONFIG))
        for index, cell in enumerate(self._member(self._stages, "stages", "configs", [])):
            self._add_configured(cell, f"stages.configs[{index}]")

    def scene(self, scene_id: str) -> FoundScene:
        """The scene of an id.

        Args:
            scene_id: a handle with or without folders and ending, or a part of it that no other scene has, such as
                Replica's `room_0`. Scene instances go before stages, as in Habitat-Sim.

        Raises:
            UsageError: the id is empty.
            SceneError: no scene or several have this id, or a config of the scene is damaged or not supported.
        """
        if not scene_id:
            raise UsageError(f"{self.path}: expected {self.path.name}:ID with the id of a scene; {self._examples()}")
        for matches in _matches(scene_id, self.scenes, self.stages):
            if len(matches) > 1:
                names = _in_short([entry.handle for entry in matches])
                raise SceneError(f"{self.path}: {scene_id!r} stands for {len(matches)} scenes: {names}")
            return self._instance(matches[0]) if matches[0] in self.scenes else self._bare(matches[0])
        names = {word for entry in self._all() for word in (entry.name, entry.words)}
        near = difflib.get_close_matches(scene_id, sorted(names), n=2, cutoff=0.5)
        hint = f"did you mean {' or '.join(near)}? " if near else ""
        raise SceneError(f"{self.path}: has no scene {scene_id!r}; {hint}{self._examples()}")

    def _all(self) -> list[Entry]:
        return [*self.scenes, *self.stages]

    def _examples(self) -> str:
        names = sorted({entry.name for entry in self._all()})
        return f"it has {len(names)} scenes" + (f": {_in_short(names)}" if names else "")

    def _cell(self, config: dict[str, Any], key: str) -> dict[str, Any]:
        return self._member(config, "", key, {})

    def _member(self, cell: dict[str, Any], where: str, key: str, default: Any) -> Any:
        """The object or list under a key; `default`, which tells the type, where there is none."""
        value = cell.get(key, default)
        if not isinstance(value, type(default)):
            kind = "an object" if isinstance(default, dict) else "a list"
            raise SceneError(f"{self.path}: {where}{'.' if where else ''}{key}: expected {kind}, got {shown(value)}")
        return value

    def _listed(self, cell: dict[str, Any], key: str, ending: str) -> Iterator[Entry]:
        """Entries of the files that the search paths of a cell lead to."""
        paths = self._member(cell, key, "paths", {})
        for kind in paths:
            # Habitat-Sim takes every kind that holds ".json" for one of configs, any other for one of assets.
            wanted = ending if ".json" in kind else kind
            for pattern in self._member(paths, f"{key}.paths", kind, []):
                for file in self._files(pattern, f"{self.path}: {key}.paths.{kind}", wanted):
                    yield Entry(file, self.folder / file)

    def _files(self, pattern: Any, told_by: str, ending: str) -> list[str]:
        """Paths relative to the dataset's folder of what a pattern matches, and of what lies in matching folders."""
        if not isinstance(pattern, str) or not pattern or "\0" in pattern:
            raise SceneError(f"{told_by}: expected a path, got {shown(pattern)}")
        if os.path.isabs(pattern) or os.path.normpath(pattern).split(os.sep)[0] == os.pardir:
            raise SceneError(f"{told_by}: {pattern!r} lies outside of {self.folder}, the folder of its data")
        found = []
        for match in sorted(glob.glob(pattern, root_dir=self.folder)):
            path = inside(self.folder / match, self.folder, told_by, match)
            names = [f"{match.rstrip('/')}/{name}" for name in sorted(os.listdir(path))] if path.is_dir() else [match]
            found += [os.path.normpath(name) for name in names if name.endswith(ending)]
        return found

    def _add_configured(self, cell: Any, where: str) -> None:
        """A stage that the dataset config describes itself, or one of its files with changes."""
        if not isinstance(cell, dict) or not isinstance(cell.get("attributes"), dict):
            raise SceneError(f"{self.path}: {where}.attributes: expected an object, got {shown(cell)}")
        change = Layer(cell["attributes"], self.path, f"{where}.attributes.")
        origin, handle = (self._text(cell, key, where) for key in ("original_file", "template_handle"))
        if origin is None and handle is None:
            raise SceneError(f"{self.path}: {where}: expected original_file or template_handle")
        if origin is None:
            self.stages.append(Entry(str(handle), None, (change,)))
            return
        before = self._stage_of(origin, self.path, f"{where}.original_file")
        if handle is None:
            self.stages.remove(before)
        self.stages.append(Entry(handle or before.handle, before.file, (*before.changes, change)))

    def _text(self, cell: dict[str, Any], key: str, where: str) -> str | None:
        value = cell.get(key)
        if value is not None and not isinstance(value, str):
            raise SceneError(f"{self.path}: {where}.{key}: expected a text, got {shown(value)}")
        return value or None

    def _stage_of(self, handle: str, path: Path, key: str) -> Entry:
        for matches in _matches(handle, self.stages):
            return matches[0]
        names = [entry.words for entry in self.stages]
        near = difflib.get_close_matches(handle, names, n=1, cutoff=0.5)
        hint = f"; did you mean {near[0]}?" if near else ""
        raise SceneError(f"{path}: {key}: {self.path.name} has no stage {handle!r}{hint}")

    def _bare(self, entry: Entry) -> FoundScene:
        stage, files = self._stage(entry)
        return FoundScene(entry.name, entry.handle, stage, 0, files)

    def _stage(self, entry: Entry) -> tuple[Stage, tuple[Path, ...]]:
        """What a stage shows, and the configs of its own."""
        has_default = "default_attributes" in self._stages
        default = self._member(self._stages, "stages", "default_attributes", {})
        layers = [Layer(default, self.path, "stages.default_attributes.")]
        folder, files, axes = self.folder, (), Y_UP
        if entry.file is not None:
            config = _config_of(entry.file)
            folder = config.parent
            if config.name.endswith(STAGE_CONFIG):
                layers.append(Layer(read_config(config), config))
                files = (config,)
                axes = Y_UP if replica_scene(config) is None else Z_UP
            else:
                layers.append(Layer({"render_asset": config.name}, self.path, "stages.paths."))
                # Without a config, Habitat-Sim judges by the name, unless the dataset has defaults for its stages.
                axes = Z_UP if config.name.endswith(".glb") and not has_default else Y_UP
        name = entry.words.rpartition("/")[2]
        return read_stage([*layers, *entry.changes], folder, self.folder, name=name, axes=axes), files

    def _instance(self, entry: Entry) -> FoundScene:
        assert entry.file is not None
        default = self._member(self._scenes, "scene_instances", "default_attributes", {})
        content = {**default, **read_config(entry.file)}
        place = content.get("stage_instance")
        if not isinstance(place, dict) or not isinstance(place.get("template_name"), str):
            raise SceneError(f"{entry.file}: stage_instance.template_name: expected a stage's, got {shown(place)}")
        layer = [Layer(place, entry.file, "stage_instance.")]
        expect_neutral(layer, "translation", [0, 0, 0])
        expect_neutral(layer, "rotation", [1, 0, 0, 0], [-1, 0, 0, 0])
        expect_neutral(layer, "uniform_scale", 1)
        expect_neutral(layer, "non_uniform_scale", [1, 1, 1])
        shows = self._stage_of(place["template_name"], entry.file, "stage_instance.template_name")
        stage, files = self._stage(shows)
        return FoundScene(entry.name, entry.handle, stage, _count_objects(content, entry.file), (entry.file, *files))


def _count_objects(content: dict[str, Any], path: Path) -> int:
    count = 0
    for key in ("object_instances", "articulated_object_instances"):
        value = content.get(key, [])
        if not isinstance(value, list):
            raise SceneError(f"{path}: {key}: expected a list, got {shown(value)}")
        count += len(value)
    return count


def _config_of(file: Path) -> Path:
    """The stage config that belongs to a mesh: `room.stage_config.json` to `room.glb` and `room.basis.glb`."""
    config = file.with_name(Path(Path(file.name).stem).stem + STAGE_CONFIG)
    return config if not file.name.endswith(STAGE_CONFIG) and config.is_file() else file


def _matches(wanted: str, *pools: Sequence[Entry]) -> Iterator[list[Entry]]:
    """What a handle can mean, best first: all of it, its last part, whole folders of it, any part of it.

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
    for test in tests:
        for pool in pools:
            if found := [entry for entry in pool if test(entry.words)]:
                yield found


def _in_short(names: Sequence[str]) -> str:
    more = len(names) - _SHOWN_NAMES
    return ", ".join(names[:_SHOWN_NAMES]) + (f" and {more} more" if more > 0 else "")
