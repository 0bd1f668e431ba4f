"""Habitat-Sim's scene dataset configs: the scenes and stages that one names, and what a scene consists of."""

import difflib
import glob
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from avp_habitat.errors import SceneError, UsageError
from avp_habitat.scenes.stage_config import (
    STAGE_CONFIG,
    Y_UP,
    Z_UP,
    Layer,
    SceneLocation,
    expect_neutral,
    inside,
    member,
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


class SceneDataset:
    """The scene instances and stages of one scene dataset config; their own files are read when they are asked for."""

    def __init__(self, path: Path) -> None:
        """Read the config and list what its search paths lead to.

        Raises:
            SceneError: the config is damaged, or a search path leaves its folder.
        """
        self.path, self.folder = path, path.parent
        config, self._where = read_config(path), f"{path}: "
        self._scenes = member(config, "scene_instances", {}, self._where)
        self._stages = member(config, "stages", {}, self._where)
        self.scenes = list(self._listed(self._scenes, "scene_instances", SCENE_INSTANCE))
        self.stages = list(self._listed(self._stages, "stages", STAGE_CONFIG))
        for index, cell in enumerate(member(self._stages, "configs", [], f"{self._where}stages.")):
            self._add_configured(cell, f"stages.configs[{index}]")

    def scene(self, scene_id: str) -> SceneLocation:
        """The scene of an id.

        Args:
            scene_id: a handle with or without folders and ending, or a part of it that no other scene has, such as
                Replica's `room_0`. Scene instances go before stages, as in Habitat-Sim.

        Raises:
            UsageError: the id is empty.
            SceneError: no scene or several have this id, or a config of the scene is damaged or not supported.
        """
        every = [*self.scenes, *self.stages]
        names = sorted({entry.name for entry in every})
        examples = f"it has {len(names)} scenes" + (f": {_in_short(names)}" if names else "")
        if not scene_id:
            raise UsageError(f"{self.path}: expected {self.path.name}:ID with the id of a scene; {examples}")
        for matches in _matches(scene_id, self.scenes, self.stages):
            if len(matches) > 1:
                handles = _in_short([entry.handle for entry in matches])
                raise SceneError(f"{self.path}: {scene_id!r} stands for {len(matches)} scenes: {handles}")
            entry = matches[0]
            found = self._instance(entry) if entry in self.scenes else self._stage(entry)
            return replace(found, name=entry.name, scene_id=entry.handle)
        near = difflib.get_close_matches(scene_id, sorted({*names, *(each.words for each in every)}), n=2, cutoff=0.5)
        hint = f"did you mean {' or '.join(near)}? " if near else ""
        raise SceneError(f"{self.path}: has no scene {scene_id!r}; {hint}{examples}")

    def _listed(self, cell: dict[str, Any], key: str, ending: str) -> Iterator[Entry]:
        """Entries of the files that the search paths of a cell lead to."""
        paths = member(cell, "paths", {}, f"{self._where}{key}.")
        for kind in paths:
            # Habitat-Sim takes every kind that holds ".json" for one of configs, any other for one of assets.
            wanted = ending if ".json" in kind else kind
            for pattern in member(paths, kind, [], f"{self._where}{key}.paths."):
                for file in self._files(pattern, f"{self._where}{key}.paths.{kind}", wanted):
                    yield Entry(file, self.folder / file)

    def _files(self, pattern: Any, where: str, ending: str) -> list[str]:
        """Paths relative to the dataset's folder of what a pattern matches, and of what lies in matching folders."""
        if not isinstance(pattern, str) or not pattern or "\0" in pattern:
            raise SceneError(f"{where}: expected a path, got {shown(pattern)}")
        if os.path.isabs(pattern) or os.path.normpath(pattern).split(os.sep)[0] == os.pardir:
            raise SceneError(f"{where}: {pattern!r} lies outside of {self.folder}, the folder of its data")
        found = []
        for match in sorted(glob.glob(pattern, root_dir=self.folder)):
            path = inside(self.folder / match, self.folder, where, match)
            names = [f"{match.rstrip('/')}/{name}" for name in sorted(os.listdir(path))] if path.is_dir() else [match]
            found += [os.path.normpath(name) for name in names if name.endswith(ending)]
        return found

    def _add_configured(self, cell: Any, where: str) -> None:
        """A stage that the dataset config describes itself, or one of its files with changes."""
        if not isinstance(cell, dict) or not isinstance(cell.get("attributes"), dict):
            raise SceneError(f"{self.path}: {where}.attributes: expected an object, got {shown(cell)}")
        change = Layer(cell["attributes"], self.path, f"{where}.attributes.")
        told = f"{self._where}{where}."
        origin, handle = (member(cell, key, "", told) for key in ("original_file", "template_handle"))
        if origin:
            before = self._stage_of(origin, f"{told}original_file")
            if not handle:
                self.stages.remove(before)
            self.stages.append(Entry(handle or before.handle, before.file, (*before.changes, change)))
        elif handle:
            self.stages.append(Entry(handle, None, (change,)))
        else:
            raise SceneError(f"{self.path}: {where}: expected original_file or template_handle")

    def _stage_of(self, handle: str, where: str) -> Entry:
        for matches in _matches(handle, self.stages):
            return matches[0]
        near = difflib.get_close_matches(handle, [entry.words for entry in self.stages], n=1, cutoff=0.5)
        hint = f"; did you mean {near[0]}?" if near else ""
        raise SceneError(f"{where}: {self.path.name} has no stage {handle!r}{hint}")

    def _stage(self, entry: Entry) -> SceneLocation:
        default = member(self._stages, "default_attributes", {}, f"{self._where}stages.")
        layers = [Layer(default, self.path, "stages.default_attributes.")]
        folder, files, axes = self.folder, (self.path,), Y_UP
        if entry.file is not None:
            config = _config_of(entry.file)
            folder = config.parent
            if config.name.endswith(STAGE_CONFIG):
                layers.append(Layer(read_config(config), config))
                files = (self.path, config)
                axes = Y_UP if replica_scene(config) is None else Z_UP
            else:
                layers.append(Layer({"render_asset": config.name}, self.path, "stages.paths."))
                # Without a config, Habitat-Sim judges by the name, unless the dataset has defaults for its stages.
                axes = Z_UP if config.name.endswith(".glb") and "default_attributes" not in self._stages else Y_UP
        name = entry.words.rpartition("/")[2]
        asset, axes = read_stage([*layers, *entry.changes], folder, self.folder, name=name, axes=axes)
        return SceneLocation(name, asset, *axes, dataset=self.path, files=files)

    def _instance(self, entry: Entry) -> SceneLocation:
        assert entry.file is not None
        default = member(self._scenes, "default_attributes", {}, f"{self._where}scene_instances.")
        content = {**default, **read_config(entry.file)}
        place = content.get("stage_instance")
        if not isinstance(place, dict) or not isinstance(place.get("template_name"), str):
            raise SceneError(f"{entry.file}: stage_instance.template_name: expected a stage's, got {shown(place)}")
        layer = [Layer(place, entry.file, "stage_instance.")]
        expect_neutral(layer, "translation", [0, 0, 0])
        expect_neutral(layer, "rotation", [1, 0, 0, 0], [-1, 0, 0, 0])
        expect_neutral(layer, "uniform_scale", 1)
        expect_neutral(layer, "non_uniform_scale", [1, 1, 1])
        kinds = ("object_instances", "articulated_object_instances")
        objects = sum(len(member(content, kind, [], f"{entry.file}: ")) for kind in kinds)
        stage = self._stage(self._stage_of(place["template_name"], f"{entry.file}: stage_instance.template_name"))
        return replace(stage, objects=objects, files=(self.path, entry.file, *stage.files[1:]))


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
