"""How a scene is handed to Habitat-Sim: its own dataset config, or one that is written to a temporary folder."""

import json
import os
from pathlib import Path

from avp_habitat.scenes.location import Frame, SceneLocation
from avp_habitat.scenes.stage_config import Y_UP

_NAME = "scene"
_GLTF = (".glb", ".gltf")


def write_stage(location: SceneLocation, frame: Frame, folder: Path) -> tuple[Path, str]:
    """The dataset config and the id in it by which Habitat-Sim opens a scene.

    A bare `.glb` would be read as Z-up, and Habitat-Sim looks beside a bare asset for a NavMesh and semantics that may
    not fit; a stage config of our own says what is meant. Of a `.ply` or `.obj` Habitat-Sim 0.3.4 shows the first mesh
    only, without vertex colours and not turned by the config's axes, so those are written as `.glb` first, and so is a
    scene that is far from its file's origin, because a renderer's float32 has no millimetres there, and a glTF that it
    would show otherwise than it is meant (`avp_habitat.scenes.gltf.shown_as_it_is`). All of it goes to `folder`, never
    beside the user's files. A scene with objects is opened from its own dataset.

    Args:
        location: of the scene.
        frame: how it lies in the world.
        folder: a temporary one.

    Returns:
        Path of the `.scene_dataset_config.json`, and the scene's id.
    """
    if location.objects and location.dataset is not None and location.scene_id is not None:
        return Path(os.path.abspath(location.dataset)), location.scene_id
    if location.asset is not None and not any(frame.origin) and _is_shown_as_it_is(location.asset):
        asset, (up, front) = os.path.abspath(location.asset), (location.up, location.front)
    else:
        asset, (up, front) = _as_glb(location, folder), Y_UP
    stage = {"render_asset": str(asset), "up": list(up), "front": list(front), "force_flat_shading": True}
    (folder / f"{_NAME}.stage_config.json").write_text(json.dumps(stage), encoding="utf-8")
    dataset = folder / "avp.scene_dataset_config.json"
    dataset.write_text(json.dumps({"stages": {"paths": {".json": ["*.stage_config.json"]}}}), encoding="utf-8")
    return dataset, _NAME


def _is_shown_as_it_is(asset: Path) -> bool:
    from avp_habitat.scenes.files import SceneFiles
    from avp_habitat.scenes.gltf import shown_as_it_is

    return asset.suffix.lower() in _GLTF and shown_as_it_is(SceneFiles(asset))


def _as_glb(location: SceneLocation, folder: Path) -> Path:
    from avp_habitat.scenes.export import export_glb
    from avp_habitat.scenes.loader import load_located

    asset = folder / "room.glb"
    export_glb(load_located(location).mesh, asset)
    return asset
