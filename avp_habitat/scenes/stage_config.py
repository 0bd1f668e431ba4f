"""Habitat-Sim's stage configs and Replica's folders: the mesh that is shown, and the axes of that mesh.

What a config means is followed, for every kind of mesh. Version 0.3.4 itself turns a `.glb` so, but shows a `.ply` or
`.obj` as it lies, whatever its axes, and without vertex colours (ResourceManager::loadRenderAssetGeneral).

Replica's meshes (docs/replica.md has its folders) are Z-up (github.com/facebookresearch/habitat-sim, issue 2631). Its
stage config (render_asset `../mesh.ply`) says nothing of that; the dataset config's defaults for stages do.
"""

import json
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from avp_habitat.errors import SceneError
from avp_habitat.scenes.files import SUFFIXES, broken_link

STAGE_CONFIG = ".stage_config.json"
Value = TypeVar("Value")
Vector = tuple[float, float, float]
Axes = tuple[Vector, Vector]
Y_UP: Axes = ((0.0, 1.0, 0.0), (0.0, 0.0, -1.0))
"""Up and front of glTF, of the suite's world, and of a stage config that names neither.

In version 0.3.4 (AbstractObjectAttributes and StageAttributesManager in its sources) this holds for a config whose
render asset is a `.glb` too: only an asset without any config is taken for Z-up because of that suffix.
"""
Z_UP: Axes = ((0.0, 0.0, 1.0), (0.0, 1.0, 0.0))
"""Up and front of Replica, Matterport3D and HM3D."""
REPLICA_MESH = "mesh.ply"
_REPLICA_FILES = ("mesh_semantic.ply", "info_semantic.json", "replica_stage.stage_config.json")
_HABITAT = "habitat"
_FILE_NAME_TAG = "%%CONFIG_NAME_AS_ASSET_FILENAME%%"
_NEUTRAL = {"origin": [0, 0, 0], "scale": [1, 1, 1], "units_to_meters": 1}
_NEUTRAL |= {"translation": [0, 0, 0], "rotation": [1, 0, 0, 0], "uniform_scale": 1, "non_uniform_scale": [1, 1, 1]}


@dataclass(frozen=True)
class Layer:
    """An object of a JSON file; of several layers of attributes, the last one that has a key decides."""

    values: Mapping[str, Any]
    path: Path
    where: str = ""
    """Where in the file, as it is put before a key: `stages.default_attributes.`, say."""

    def error(self, key: str, text: str) -> SceneError:
        """An error that names the file and the key."""
        return SceneError(f"{self.path}: {self.where}{key}: {text}")

    def member(self, key: str, default: Value) -> Value:
        """The object, list or text under a key, or the default; SceneError where it is something else."""
        value = self.values.get(key, default)
        if value is None and isinstance(default, str):
            return default
        if not isinstance(value, type(default)):
            kind = {dict: "an object", list: "a list", str: "a text"}[type(default)]
            raise self.error(key, f"expected {kind}, got {shown(value)}")
        return value

    def cell(self, key: str) -> "Layer":
        """The object under a key, empty where there is none."""
        return Layer(self.member(key, {}), self.path, f"{self.where}{key}.")

    def inside(self, key: str, value: str, folder: Path, root: Path) -> Path:
        """The path that a value stands for, without `..`; SceneError where it leaves `root`, the folder of the data.

        What counts is the path as it is written: links may lead anywhere.
        """
        target = folder / value
        if "\0" in value or not Path(os.path.abspath(target)).is_relative_to(os.path.abspath(root)):
            raise self.error(key, f"{value!r} lies outside of {root}, the folder of its data")
        return Path(os.path.normpath(target))


@dataclass(frozen=True)
class SceneLocation:
    """Where a scene is."""

    name: str
    """As rollouts call it, without folders: a file's name, `room_0`, `builtin:SEED` or `builtin-home:SEED`."""
    asset: Path | None
    """The mesh file that is shown; None for a generated room."""
    up: Vector = Y_UP[0]
    """Unit vector in the asset's coordinates that points up."""
    front: Vector = Y_UP[1]
    """Unit vector in the asset's coordinates, at right angles to `up`, that becomes the world's -Z."""
    chosen_up: str | None = None
    """The axis that the user said points up, None for what the file or its config says."""
    dataset: Path | None = None
    """The scene dataset config that the scene belongs to, None for one that was named without it."""
    scene_id: str | None = None
    """The scene's id there: the handle that the user's id stands for, which no other scene has."""
    objects: int = 0
    """Objects, articulated ones included, that the scene has beyond its stage."""
    files: tuple[Path, ...] = ()
    """The configs that were read: of the dataset, of the scene, of the stage."""


def replica_scene(path: Path) -> Path | None:
    """The folder of the scene that a mesh or stage config of Replica belongs to, None for any other file."""
    folder = Path(os.path.abspath(path)).parent
    if path.name in (_REPLICA_FILES[0], _REPLICA_FILES[2]) and folder.name == _HABITAT:
        folder = folder.parent
    elif path.name != REPLICA_MESH:
        return None
    return folder if is_replica_scene(folder) else None


def is_replica_scene(folder: Path) -> bool:
    """Whether a folder has `habitat/` with at least two of Replica's files in it, or one of them and `mesh.ply`."""
    count = sum((folder / _HABITAT / name).is_file() for name in _REPLICA_FILES)
    return count > 0 and count + (folder / REPLICA_MESH).is_file() > 1


def read_config(path: Path) -> Layer:
    """The object that a JSON file holds; SceneError where it cannot be read, or holds something else."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise SceneError(f"{path}: cannot be read: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        raise SceneError(f"{path}: expected JSON, but it is damaged: {error}") from error
    if not isinstance(content, dict):
        raise SceneError(f"{path}: expected a JSON object, got {shown(content)}")
    return Layer(content, path)


def read_stage(layers: Sequence[Layer], folder: Path, root: Path, *, name: str, axes: Axes = Y_UP) -> tuple[Path, Axes]:
    """The mesh file that a stage of some attributes shows, and its up and front.

    Args:
        layers: the attributes; the last layer is the stage's own.
        folder: that relative paths start from.
        root: folder of the data set, outside of which nothing is read.
        name: of the stage, which stands for a tag that defaults may hold.
        axes: where the attributes name none.

    Raises:
        SceneError: an attribute is missing or cannot be right, or moves or scales the stage.
    """
    expect_unmoved(layers)
    asset = _asset(layers, folder, root, name)
    up, front = _axes(layers, axes)
    if asset.name.endswith("_semantic.ply") and find(layers, "render_asset_type")[0] in (None, "semantic"):
        # Habitat-Sim takes a mesh of such a name for one with semantic labels, and after it has applied the config's
        # axes, it turns the mesh from Z-up to Y-up (ResourceManager and GenericSemanticMeshData in its sources).
        up, front = (0.0 - front[0], 0.0 - front[1], 0.0 - front[2]), up
    return asset, (up, front)


def find(layers: Sequence[Layer], key: str) -> tuple[Any, Layer]:
    """The value of a key and the layer that has it; None and the last layer where none has it."""
    found = [layer for layer in layers if layer.values.get(key) is not None]
    return (found[-1].values[key], found[-1]) if found else (None, layers[-1])


def expect_unmoved(layers: Sequence[Layer]) -> None:
    """Refuse, by a SceneError, attributes of a stage, or of its place in a scene, that move, turn or scale it.

    Habitat-Sim 0.3.4 reads origin, units_to_meters and the stage's place in a scene instance without using them, and
    scales what is seen but not the NavMesh; older versions do not scale. No two simulators would show the same scene.
    """
    for key, neutral in _NEUTRAL.items():
        value, layer = find(layers, key)
        if value is not None and value != neutral:
            text = f"expected {shown(neutral)} or nothing, got {shown(value)}; stages that are moved, turned or "
            raise layer.error(key, text + "scaled are not supported, because versions of Habitat-Sim differ in it")


def shown(value: Any) -> str:
    """A JSON value in one short line."""
    text = json.dumps(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _asset(layers: Sequence[Layer], folder: Path, root: Path, name: str) -> Path:
    value, layer = find(layers, "render_asset")
    if not isinstance(value, str) or Path(value).suffix.lower() not in SUFFIXES:
        text = f"expected the path of a mesh ({', '.join(SUFFIXES)}), got {shown(value)}"
        raise layer.error("render_asset", text)
    asset = layer.inside("render_asset", value.replace(_FILE_NAME_TAG, name), folder, root)
    if not os.path.isfile(asset):
        raise layer.error("render_asset", broken_link(asset) or f"there is no file {asset}")
    return asset


def _axes(layers: Sequence[Layer], default: Axes) -> Axes:
    if all(find(layers, key)[0] is None for key in ("up", "front")):
        return default
    # A config that names one of them gets the other as Habitat-Sim has it, whatever its asset is.
    up, front = (_direction(layers, key, Y_UP[index]) for index, key in enumerate(("up", "front")))
    layer, told = find(layers, "up")[1], f"got up {shown(list(up))} and front {shown(list(front))}"
    if abs(sum(a * b for a, b in zip(up, front, strict=True))) > 1e-5:
        raise layer.error("up and front", f"{told}; expected two directions at right angles; name both")
    if abs(up[1]) > 1 - 1e-5 and front[2] > 1 - 1e-5:
        # It takes +Y to `up`, then -Z to `front`, by the shortest turns (CoordinateFrame in its sources); the half turn
        # between opposite fronts is about an axis at right angles to +Y, which turns `up` over.
        text = f"{told}, which Habitat-Sim shows upside down; expected another front, [0.0, 0.0, -1.0] say"
        raise layer.error("up and front", text)
    return up, front


def _direction(layers: Sequence[Layer], key: str, default: Vector) -> Vector:
    value, layer = find(layers, key)
    if value is None:
        return default
    numbers = isinstance(value, list) and len(value) == 3 and all(isinstance(item, (int, float)) for item in value)
    length = math.hypot(*value) if numbers else 0.0
    if not 0 < length < math.inf:
        raise layer.error(key, f"expected a direction of three numbers, got {shown(value)}")
    return (value[0] / length, value[1] / length, value[2] / length)
